import json
import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from torchrefract.cameras.calibration.boards import Charuco
from torchrefract.cameras.calibration.synthetic import CAMERA, render_views
from torchrefract.cameras.camera import Camera
from torchrefract.cameras.io.opencv import read_opencv

SMALL = Camera(width=640, height=400, fx=380.0, fy=381.0, cx=322.3, cy=196.6, coefficients=(-0.25, 0.08, 0.003, -0.002))
BOARD = Charuco(squares="6x5", square_mm=30, marker_mm=20, dictionary="DICT_4X4_50")
WORDS = (
    "images=pictures",
    "squares=6x5",
    "square_mm=30",
    "marker_mm=20",
    "dictionary=DICT_4X4_50",
    "lens_model=opencv4",
)


@pytest.fixture(scope="session")
def rendered_small() -> list[tuple[str, np.ndarray]]:
    return [(name, gray) for name, gray, _ in render_views(BOARD, SMALL, count=9)]


@pytest.fixture
def pictures(tmp_path, rendered_small) -> Path:
    """Nine pictures of a board, in the folder that commands run in."""
    (tmp_path / "pictures").mkdir()
    for name, gray in rendered_small:
        cv2.imwrite(str(tmp_path / "pictures" / name), gray)
    return tmp_path / "pictures"


def kept(folder: Path) -> dict[str, int]:
    """How many corners were found in each picture."""
    lines = [json.loads(line) for line in (folder / "detections.jsonl").read_text().splitlines()[1:]]
    return {line["name"]: len(line["ids"]) for line in lines}


def test_the_camera_of_the_rendered_board_is_found(call, tmp_path):
    outcome = call("calibrate")
    assert outcome.err == ""
    assert outcome.out.startswith("calibration/camera.yaml: opencv5 of 30 views in 30 pictures, rms 0.05")
    found = read_opencv(tmp_path / "calibration" / "camera.yaml")
    for name in ("fx", "fy", "cx", "cy"):
        assert getattr(found, name) == pytest.approx(getattr(CAMERA, name), rel=1e-3)
    assert found.coefficients == pytest.approx(CAMERA.coefficients, rel=1e-2)
    assert (found.width, found.height, found.model) == (CAMERA.width, CAMERA.height, "opencv")
    report = (tmp_path / "calibration" / "report.md").read_text()
    assert "30 views of 30 pictures" in report
    written = {path.name for path in (tmp_path / "calibration").iterdir()}
    assert written == {"camera.yaml", "report.md", "coverage.png", "residuals.png", "detections.jsonl", "rendered"}


def test_a_run_that_was_stopped_goes_on(call, pictures, tmp_path, monkeypatch):
    assert call("calibrate", *WORDS).code == 0
    first = (tmp_path / "calibration" / "report.md").read_text()
    lines = (tmp_path / "calibration" / "detections.jsonl").read_text().splitlines(keepends=True)
    # Stopped in the middle of the seventh picture.
    (tmp_path / "calibration" / "detections.jsonl").write_text("".join(lines[:7]) + lines[7][:40])
    looked, detect = [], cv2.aruco.CharucoDetector
    monkeypatch.setattr(cv2.aruco, "CharucoDetector", lambda *words: looked.append(1) or detect(*words))
    assert call("calibrate", *WORDS).code == 0
    assert len(looked) == 3 * 2  # of three pictures, in two colors; of five rows both patterns are one
    assert (tmp_path / "calibration" / "report.md").read_text() == first
    assert len(kept(tmp_path / "calibration")) == 9


def test_another_board_is_looked_for_anew(call, pictures, tmp_path):
    assert call("calibrate", *WORDS).code == 0
    assert call("calibrate", *WORDS, "square_mm=60", "marker_mm=40").code == 0
    assert "square_mm=60" in (tmp_path / "calibration" / "report.md").read_text()


def test_a_planted_bad_view_is_named_in_the_report(call, pictures, tmp_path):
    path = str(pictures / "view_04.png")
    gray = np.asarray(cv2.imread(path, cv2.IMREAD_GRAYSCALE))
    x, y = np.meshgrid(np.arange(640, dtype=np.float32), np.arange(400, dtype=np.float32))
    cv2.imwrite(path, cv2.remap(gray, x, y - 10 * np.cos((x - 320) / 100), cv2.INTER_CUBIC))
    outcome = call("calibrate", *WORDS)
    assert outcome.out.startswith("view_04.png dropped: held out it is off by ")
    assert "| view_04.png | dropped: held out it is off by " in (tmp_path / "calibration" / "report.md").read_text()
    found = read_opencv(tmp_path / "calibration" / "camera.yaml")
    assert found.fx == pytest.approx(SMALL.fx, rel=2e-3)


def test_pictures_that_show_no_board_are_named_with_a_reason(call, pictures, tmp_path):
    gray = np.asarray(cv2.imread(str(pictures / "view_04.png"), cv2.IMREAD_GRAYSCALE))
    cv2.imwrite(str(pictures / "blurred.png"), cv2.GaussianBlur(gray, (0, 0), 8))
    cv2.imwrite(str(pictures / "mirrored.png"), gray[:, ::-1])
    cv2.imwrite(str(pictures / "odd.png"), cv2.resize(gray, (320, 200)))
    (pictures / "empty.png").touch()
    (pictures / "dead.png").symlink_to("gone.png")
    assert call("calibrate", *WORDS).code == 0
    report = (tmp_path / "calibration" / "report.md").read_text()
    assert "| blurred.png | no board found; it is blurred, its sharpest edges are " in report
    assert "| mirrored.png | mirrored: flipped from left to right it shows " in report
    assert "| odd.png | 320 x 200 px, others are of 640 x 400 |" in report
    assert "| empty.png | no picture: pictures/empty.png is empty (0 bytes) |" in report
    assert "| dead.png | no picture: pictures/dead.png cannot be opened (No such file or directory) |" in report


def test_a_wrong_definition_says_what_was_found_and_keeps_it(call, pictures, tmp_path):
    message = call("calibrate", *WORDS, "squares=5x6").message
    assert message.startswith("images must show the board (board=charuco squares=5x6 ")
    assert "in 4 pictures at least, got 0. view_0" in message
    assert "corners as on a board of squares=6x5" in message
    report = (tmp_path / "calibration" / "report.md").read_text()
    assert "There is no camera: images must show the board" in report
    assert "| view_08.png | 0 | no board found |" in report
    assert not (tmp_path / "calibration" / "camera.yaml").exists()


def test_a_calibration_that_failed_leaves_no_camera_that_looks_like_its_own(call, pictures, tmp_path):
    assert call("calibrate", *WORDS).code == 0
    out = tmp_path / "calibration"
    before = (out / "camera.yaml").read_text()
    assert call("calibrate", *WORDS, "squares=5x6").code == 1
    assert {path.name for path in out.iterdir()} == {
        "camera_before.yaml", "coverage_before.png", "residuals_before.png", "report.md", "detections.jsonl",
    }  # fmt: skip  # one line
    assert (out / "camera_before.yaml").read_text() == before
    assert "`camera_before.yaml` is of a calibration before." in (out / "report.md").read_text()
    assert call("calibrate", *WORDS).code == 0
    assert (out / "camera.yaml").read_text() == before


def test_a_fit_that_failed_keeps_what_was_found(call, pictures, tmp_path, monkeypatch):
    monkeypatch.setattr(cv2, "calibrateCamera", cameras_that_are_none)
    message = call("calibrate", *WORDS).message
    assert message.startswith("views must be enough for the model opencv4, got 9 that fit no camera")
    report = (tmp_path / "calibration" / "report.md").read_text()
    assert "There is no camera: views must be enough for the model opencv4" in report
    assert min(kept(tmp_path / "calibration").values()) >= 6


def cameras_that_are_none(objects, images, size, matrix, vector, **_):
    still = [np.zeros((3, 1)) for _ in objects]
    return 0.0, np.full((3, 3), np.nan), vector, still, still


def test_a_model_that_folds_inside_the_frame_is_told(call, pictures, tmp_path, monkeypatch):
    # It turns at r = 0.456, and the corner of the frame is at 0.99 focal lengths.
    folding = replace(SMALL, coefficients=(-1.6, 0.0, 0.0, 0.0))
    monkeypatch.setattr("torchrefract.calibrate.camera_of", lambda *_: folding)
    outcome = call("calibrate", *WORDS)
    line = f"The model folds back inside the frame: {1 - folding.coverage():.1%} of it has no ray. Fewer coefficients"
    assert outcome.err.startswith(f"warning: {line}")
    assert f"- {line}" in (tmp_path / "calibration" / "report.md").read_text()


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda gray: gray[:, ::-1], r"view_00.png: mirrored: flipped from left to right it shows \d+ corners"),
        (
            lambda gray: cv2.GaussianBlur(gray, (0, 0), 8),
            r"view_00.png: no board found; it is blurred, its sharpest edges are \d+\.\d px wide",
        ),
        (lambda gray: gray[:150, :150], r"view_\d+.png .* \d of 20 corners, 6 in two rows and columns are needed"),
    ],
    ids=["mirrored", "blurred", "few corners"],
)
def test_pictures_that_are_all_bad_are_told_apart(call, pictures, tmp_path, change, told):
    for path in pictures.iterdir():
        gray = np.asarray(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE))
        cv2.imwrite(str(path), np.ascontiguousarray(change(gray)))
    message = call("calibrate", *WORDS).message
    assert message.startswith("images must show the board (board=charuco squares=6x5 ")
    assert re.search(told, f"{message}\n{(tmp_path / 'calibration' / 'report.md').read_text()}")


def test_the_dictionary_that_would_fit_is_named(call, pictures):
    message = call("calibrate", *WORDS, "dictionary=DICT_6X6_250").message
    told = r"view_0\d.png shows \d+ markers of DICT_4X4_50, from number \d+ to \d+, with \d+ corners as on a board of"
    assert re.search(rf"got 0. {told} squares=6x5", message)


def test_too_few_views_say_how_many_there_are_and_keep_them(call, pictures, tmp_path):
    for path in sorted(pictures.iterdir())[3:]:
        path.unlink()
    message = call("calibrate", *WORDS).message
    assert "in 4 pictures at least, got 3" in message
    assert min(kept(tmp_path / "calibration").values()) >= 6


def test_pictures_of_many_sizes_are_no_camera(call, pictures, tmp_path):
    for k, path in enumerate(sorted(pictures.iterdir())[:4]):
        cv2.imwrite(str(path), np.zeros((100 + k, 200), np.uint8))
    message = call("calibrate", *WORDS).message
    assert message.startswith("images must be of one size, as those of a camera are, got 5 of 640 x 400, 1 of ")
    assert len(kept(tmp_path / "calibration")) == 9


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("images=none",), "images must be a folder of pictures, got none, which is none"),
        (("images=.",), "images must be a folder that holds .jpg, .jpeg, .png, .webp, .bmp, got ."),
        (("lens_model=opencv7",), "lens_model: lens_model must be one of opencv4, opencv5, .*, fisheye, got 'opencv7'"),
        (("drop_share=2",), "drop_share: drop_share must be a number in .*, got 2"),
        (("dictionary=DICT",), "board: dictionary must be one of DICT_.*, got 'DICT'"),
        (
            ("board=chessboard", "marker_mm=3"),
            "an option must be one of images, lens_model, drop_share, out, board, squares, square_mm, got marker_mm",
        ),
        (("model=fisheye",), "an option must be one of images, .*, got model; did you mean lens_model\\?"),
    ],
)
def test_a_wrong_word_is_one_line_of_error(call, words, message):
    assert re.search(message, call("calibrate", *words).message)


@pytest.mark.parametrize(
    ("kind", "name", "words", "views", "fx"),
    [
        ("charuco", "opencv_tutorial", ("squares=5x7", "marker_mm=10", "dictionary=DICT_6X6_250"), 5, 466.8),
        ("charuco", "caliscope_cam0", ("squares=4x5", "marker_mm=16.5", "dictionary=DICT_4X4_1000"), 18, 919.6),
    ],
)
def test_real_pictures_give_the_camera_that_opencv_finds(call, shared_data, tmp_path, kind, name, words, views, fx):
    folder = shared_data / kind / name
    assert call("calibrate", f"images={folder}", *words, "out=out").code == 0
    found = read_opencv(tmp_path / "out" / "camera.yaml")
    reference = json.loads((folder.parent / "reference.json").read_text())[name]["recomputed_opencv_5param"]
    assert reference["fx"] == pytest.approx(fx, abs=0.1)
    assert found.fx == pytest.approx(fx, rel=0.03)  # two deviations of a fit to so few corners
    assert f"Used: {views} views" in (tmp_path / "out" / "report.md").read_text()
