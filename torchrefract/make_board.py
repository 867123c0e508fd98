"""Make a calibration board to print: `python -m torchrefract.make_board out=board.pdf`.

Print it at 100 %, measure the ruler below the board, and fix it to something flat.

Options:
    board=charuco           or chessboard
    squares=11x8            squares of the board, columns x rows
    square_mm=22            side of a square, mm
    marker_mm=14            side of a marker, mm
    dictionary=NAME         of the markers, such as DICT_5X5_250
    out=board.pdf           or .png
    dpi=300                 resolution of a PNG
    margin_mm=10            around the board, mm

Examples:
    python -m torchrefract.make_board squares=11x8 square_mm=22 out=board.pdf
    python -m torchrefract.make_board board=chessboard squares=10x7 square_mm=25 out=chessboard.png
"""

from torchrefract.cli.entry import command

main = command("make_board", __doc__, "calibration:make_board")

if __name__ == "__main__":
    main()
