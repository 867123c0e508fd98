"""Adapters to other libraries, one file for each, imported when used."""
