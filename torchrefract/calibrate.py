"""Calibrate a camera from pictures of a board: `python -m torchrefract.calibrate images=pictures squares=11x8`.

Writes camera.yaml, which `rectify` and `LensDistortion.from_camera` read, and report.md, which lists all pictures.
An interrupted run continues.

Options:
    images=DIR              folder of pictures of the board; default: synthetic, rendered pictures as a trial
    board=charuco           or chessboard
    squares=11x8            squares of the board, columns x rows
    square_mm=22            side of a square, mm, measured on the print
    marker_mm=14            side of a marker, mm
    dictionary=NAME         of the markers, such as DICT_5X5_250
    lens_model=auto         chosen by held-out views; or opencv0 ... opencv14 (number of coefficients), fisheye,
                            division
    drop_share=0.25         largest share of the views that may be dropped
    out=calibration         output folder

Examples:
    python -m torchrefract.calibrate images=pictures squares=11x8 square_mm=22 marker_mm=14 dictionary=DICT_5X5_250
    python -m torchrefract.calibrate images=pictures board=chessboard squares=10x7 square_mm=25 out=front
"""

from torchrefract.cli.entry import command

main = command("calibrate", __doc__, "calibration:calibrate")

if __name__ == "__main__":
    main()
