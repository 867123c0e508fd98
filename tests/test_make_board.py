import re

import cv2
import numpy as np
import pytest

from torchrefract.cameras.calibration.boards import Charuco, Chessboard
from torchrefract.cameras.calibration.detection import detect


def test_a_pdf_has_the_size_of_the_board_and_its_margins(call, tmp_path):
    outcome = call("make_board", "squares=9x6", "square_mm=20", "margin_mm=8", "out=board.pdf")
    assert outcome.out.startswith("board.pdf: board=charuco squares=9x6 square_mm=20 marker_mm=14 ")
    match = re.search(rb"/MediaBox \[ ([0-9. ]+) \]", (tmp_path / "board.pdf").read_bytes())
    assert match is not None
    left, bottom, right, top = (float(number) / 72 * 25.4 for number in match[1].split())
    # The strip for ruler and text is 12 mm high.
    np.testing.assert_allclose((left, bottom, right, top), (0, 0, 9 * 20 + 16, 6 * 20 + 16 + 12), atol=0.01)


@pytest.mark.quick
def test_a_png_has_its_dots_per_inch(call, tmp_path):
    dpi = 100
    assert call("make_board", "out=board.png", f"dpi={dpi}").code == 0
    gray = cv2.imread(str(tmp_path / "board.png"), cv2.IMREAD_GRAYSCALE)
    view = detect(np.asarray(gray), Charuco())
    assert view.ids.tolist() == list(range(70))
    # The center of the first pixel is half a pixel from the border of the page.
    expected = (Charuco().corners()[:, :2] + 10) * dpi / 25.4 - 0.5
    assert np.abs(view.corners - expected).max() < 1  # the page ends within a pixel
    spacing = (view.corners[-1] - view.corners[0]) / (9, 6)
    np.testing.assert_allclose(spacing, 22 * dpi / 25.4, rtol=1e-3)


@pytest.mark.parametrize(
    ("option", "board"),
    [
        ("inverted=true", Charuco(inverted=True)),
        ("legacy=true", Charuco(legacy=True)),
        ("board=chessboard", Chessboard()),
    ],
)
def test_every_board_is_detected(call, tmp_path, option, board):
    assert call("make_board", option, "out=new/board.png", "dpi=90").code == 0
    gray = np.asarray(cv2.imread(str(tmp_path / "new" / "board.png"), cv2.IMREAD_GRAYSCALE))
    assert len(detect(gray, board).ids) == 70


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("out=board.svg",), "out must end in .pdf or .png, got board.svg"),
        (("dpi=1",), "dpi must be a number in [20, 2400], got 1"),
        (("squares=eleven",), "board: squares must be columns x rows, such as 11x8, got 'eleven'"),
        (("board=circles",), "board must be one of charuco, chessboard, got circles"),
    ],
)
def test_invalid_options_are_one_line_of_error(call, tmp_path, options, message):
    assert call("make_board", *options).message == message
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["board.pdf", "board.png"])
def test_a_full_disk_is_one_line_of_error(call, tmp_path, file_limit, name):
    with file_limit(100):
        outcome = call("make_board", f"out={name}", "dpi=50")
    assert outcome.message == f"{name} could not be written: File too large"
    assert not list(tmp_path.iterdir())
