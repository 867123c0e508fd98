"""Calibration of a camera from pictures of a board.

`boards` defines boards and `board_page` prints them. `detection` finds corners and `diagnosis` explains why a picture
has none. `fit` estimates the camera, `outliers` drops views that do not fit, `quality` and `report` say how far to
trust the result. `synthetic` renders pictures of a board through a known camera.
"""
