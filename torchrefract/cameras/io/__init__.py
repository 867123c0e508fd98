"""Cameras read from and written to the files of other programs; YAML needs the `calibration` extra."""
