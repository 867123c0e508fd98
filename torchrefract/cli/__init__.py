"""Shared code of the command-line entry points."""
