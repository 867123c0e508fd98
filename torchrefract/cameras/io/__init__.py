"""Readers and writers of camera files: `opencv`, `ros`, `kalibr` and `colmap`; YAML needs the `calibration` extra."""
