import errno
import json
import re
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
from pictures import files_in, load_picture, save_picture, save_turned

from torchrefract.cameras.calibration.boards import Charuco
from torchrefract.cameras.calibration.synthetic import CAMERA, render_views
from torchrefract.cameras.camera import Camera
from torchrefract.cameras.io import read_covariance, read_opencv
from torchrefract.cli import calibration
from torchrefract.data.pairs.manifest import locked

SMALL = Camera(width=640, height=400, fx=380.0, fy=381.0, cx=322.3, cy=196.6, coefficients=(-0.25, 0.08, 0.003, -0.002))
BOARD = Charuco(squares="6x5", square_mm=30, marker_mm=20, dictionary="DICT_4X4_50")
ON_BOARD = ("images=pictures", "squares=6x5", "square_mm=30", "marker_mm=20", "dictionary=DICT_4X4_50")
OPTIONS = (*ON_BOARD, "lens_model=opencv4")


@pytest.fixture(scope="session")
def rendered_small() -> list[tuple[str, np.ndarray]]:
    """Return six pictures of a board."""
    return [(name, gray) for name, gray, _ in render_views(BOARD, SMALL, count=6)]


@pytest.fixture
def pictures(tmp_path, rendered_small, blank_figures) -> Path:
    """Write six pictures of a board below the folder in which commands run."""
    for name, gray in rendered_small:
        save_picture(tmp_path / "pictures" / name, gray)
    return tmp_path / "pictures"


def covariance_shape(folder: Path) -> tuple[int, ...]:
    covariance = read_covariance(folder / "camera.yaml")
    return () if covariance is None else covariance.shape


def read_report(tmp_path: Path) -> str:
    return (tmp_path / "calibration" / "report.md").read_text()


def test_a_folder_that_another_run_writes_to_is_an_error(call, tmp_path, pictures):
    (tmp_path / "calibration").mkdir()
    with locked("out", tmp_path / "calibration"):
        message = call("calibrate", *OPTIONS).message
    assert message.startswith("out must not be in use, got calibration, which another run writes to")
    assert not any((tmp_path / "calibration").iterdir())


def test_rendered_pictures_on_a_full_disk_raise(tmp_path, monkeypatch):
    def fail(path: Path, data: bytes) -> int:
        raise OSError(errno.ENOSPC, "No space left on device", str(path))

    monkeypatch.setattr(Path, "write_bytes", fail)
    with pytest.raises(OSError, match="No space left on device"):
        calibration._rendered(BOARD, tmp_path / "rendered")


def test_the_camera_of_rendered_pictures_is_recovered(call, tmp_path, monkeypatch):
    exact = CAMERA.resized(width=640, height=400)
    monkeypatch.setattr(calibration, "render_views", partial(render_views, camera=exact, count=6))
    outcome = call("calibrate")
    assert outcome.err == ""
    assert outcome.out.startswith("calibration/camera.yaml: opencv5 from 6 views in 6 pictures, error 0.0")
    camera = read_opencv(tmp_path / "calibration" / "camera.yaml")
    for name in ("fx", "fy", "cx", "cy"):
        assert getattr(camera, name) == pytest.approx(getattr(exact, name), rel=1e-3)
    assert camera.coefficients == pytest.approx(exact.coefficients, rel=1e-2)
    assert (camera.width, camera.height, camera.model) == (640, 400, "opencv")
    assert "6 views of 6 pictures" in read_report(tmp_path)
    written = {path.name for path in (tmp_path / "calibration").iterdir()}
    figures = {"coverage.png", "residuals.png", "uncertainty.png"}
    assert written == {"camera.yaml", "report.md", "detections.jsonl", "rendered"} | figures


@pytest.mark.usefixtures("blank_figures")
def test_a_camera_of_the_division_model_is_recovered_written_and_rectifies(call, tmp_path):
    exact = replace(SMALL, coefficients=(-0.25,), model="division")
    for name, gray, _ in render_views(BOARD, exact, count=5):
        save_picture(tmp_path / "pictures" / name, gray)
    outcome = call("calibrate", *ON_BOARD, "lens_model=division")
    assert outcome.out.startswith("calibration/camera.yaml: division from 5 views"), outcome.message
    camera = read_opencv(tmp_path / "calibration" / "camera.yaml")
    assert camera.model == "division"
    assert (camera.fx, camera.fy) == pytest.approx((exact.fx, exact.fy), rel=5e-3)
    assert camera.coefficients == pytest.approx(exact.coefficients, rel=2e-2)
    assert covariance_shape(tmp_path / "calibration") == (5, 5)
    assert call("rectify", "input=pictures", "camera=calibration/camera.yaml").code == 0
    assert (tmp_path / "rectified" / "view_00.png").is_file()


def test_views_of_a_still_board_count_once(call, pictures, rendered_small):
    noise = np.random.default_rng(0)
    for k in range(4):
        gray = rendered_small[0][1] + noise.normal(0, 2, rendered_small[0][1].shape)
        save_picture(pictures / f"z{k}.png", gray.clip(0, 255).astype(np.uint8))
    outcome = call("calibrate", *OPTIONS)
    assert "opencv4 from 6 views in 10 pictures" in outcome.out, outcome.message
    still = f"shows the board where {rendered_small[0][0]} does"
    assert f"not used: z0.png ({still}), z1.png ({still}), z2.png ({still}) and 1 more\n" in outcome.out
    assert "warning" not in outcome.err
    assert still in read_report(pictures.parent)


@pytest.mark.usefixtures("blank_figures")
def test_pictures_that_were_turned_before_they_were_saved_are_warned_of(call, tmp_path):
    for k, (name, gray, _) in enumerate(render_views(BOARD, replace(SMALL, cx=360.0, cy=165.0), count=6)):
        save_picture(tmp_path / "pictures" / name, np.rot90(gray, 2 * (k % 2)))
    outcome = call("calibrate", *OPTIONS, "drop_share=0")
    assert re.search(r"warning: an error of \d\.\d+ px rms is high: .* turned before they were saved", outcome.err)


def test_markers_of_another_size_than_stated_are_an_error(call, pictures):
    message = call("calibrate", *OPTIONS, "marker_mm=12").message
    assert re.match(r"marker_mm must be the side of the markers, about (19|20)\S* mm in the pictures", message)


def test_unusable_pictures_are_reported_with_a_reason(call, pictures, tmp_path, monkeypatch):
    gray = load_picture(pictures / "view_04.png")
    save_picture(pictures / "blurred.png", cv2.GaussianBlur(gray, (0, 0), 8))
    save_picture(pictures / "mirrored.png", np.ascontiguousarray(gray[:, ::-1]))
    save_picture(pictures / "odd.png", cv2.resize(gray, (320, 200)))
    (pictures / "empty.png").touch()
    (pictures / "dead.png").symlink_to("gone.png")
    monkeypatch.setattr(Camera, "coverage", lambda _: 0.75)
    outcome = call("calibrate", *OPTIONS)
    assert outcome.code == 0
    report = read_report(tmp_path)
    assert "| blurred.png | no board found; it is blurred, its sharpest edges are " in report
    assert "| mirrored.png | mirrored: flipped from left to right it shows " in report
    assert "| odd.png | 320 x 200 px, other pictures have 640 x 400 px |" in report
    assert "| empty.png | unreadable: pictures/empty.png is empty (0 bytes) |" in report
    assert "| dead.png | unreadable: pictures/dead.png cannot be opened (No such file or directory) |" in report
    line = "The model folds back inside the frame: 25.0% of it has no ray."
    assert outcome.err.startswith(f"warning: {line}")
    assert f"- {line}" in report


def test_pictures_are_calibrated_as_stored_whatever_their_exif_orientation(call, pictures, tmp_path):
    for k, path in enumerate(sorted(pictures.iterdir())):
        save_turned(path, load_picture(path), (1, 3, 6)[k % 3])
    outcome = call("calibrate", *OPTIONS)
    camera = read_opencv(tmp_path / "calibration" / "camera.yaml")
    assert (camera.width, camera.height) == (640, 400)
    for name in ("fx", "fy", "cx", "cy"):
        assert getattr(camera, name) == pytest.approx(getattr(SMALL, name), rel=5e-3)
    line = "4 of 6 files have a tag that turns them for display (EXIF orientation, or rotation of a video): view_01"
    assert outcome.out.startswith(line)
    assert line in read_report(tmp_path)


def test_a_bent_view_is_dropped_and_reported(call, pictures, tmp_path):
    gray = load_picture(pictures / "view_00.png")
    x, y = np.meshgrid(np.arange(640, dtype=np.float32), np.arange(400, dtype=np.float32))
    bent = cv2.remap(gray, x, (y - 8 * np.sin(x / 60)).astype(np.float32), cv2.INTER_CUBIC)
    save_picture(pictures / "bent.png", bent)
    outcome = call("calibrate", *OPTIONS)
    assert "bent.png dropped: its error is " in outcome.out
    assert "| bent.png | dropped: its error is " in read_report(tmp_path)


def test_an_interrupted_detection_continues_and_another_board_starts_anew(pictures, tmp_path, monkeypatch):
    files, cache = sorted(pictures.iterdir()), tmp_path / "detections.jsonl"
    first = list(calibration.detect_all(files, BOARD, cache))
    lines = cache.read_text().splitlines(keepends=True)
    cache.write_text("".join(lines[:4]) + lines[4][:40])  # interrupted while writing the fourth picture
    names, detect = [], calibration.detect
    monkeypatch.setattr(calibration, "detect", lambda *args, name: names.append(name) or detect(*args, name=name))
    second = list(calibration.detect_all(files, BOARD, cache))
    assert names == [file.name for file in files[3:]]
    for before, after in zip(first, second, strict=True):
        np.testing.assert_array_equal(before.view.corners, after.view.corners)
    names.clear()
    list(calibration.detect_all(files[:2], replace(BOARD, square_mm=60, marker_mm=40), cache))
    assert names == [file.name for file in files[:2]]


def test_a_failed_calibration_names_the_board_and_sets_earlier_results_aside(call, pictures, tmp_path):
    folder = tmp_path / "calibration"
    folder.mkdir()
    for name in ("camera.yaml", "coverage.png", "residuals.png"):
        (folder / name).write_text(name)
    message = call("calibrate", *OPTIONS, "squares=5x6").message
    assert message.startswith("images must show the board (board=charuco squares=5x6 ")
    assert "in at least 4 pictures, got 0. view_0" in message
    assert re.search(r"shows \d+ markers of DICT_4X4_50, .* corners as on a board of squares=6x5", message)
    report = read_report(tmp_path)
    assert "The calibration failed: images must show the board" in report
    assert "| view_05.png | 0 | no board found |" in report
    assert "`camera_before.yaml` is the camera of an earlier calibration." in report
    before = ["camera_before.yaml", "coverage_before.png", "residuals_before.png"]
    assert files_in(folder) == sorted([*before, "report.md", "detections.jsonl"])
    assert (folder / "camera_before.yaml").read_text() == "camera.yaml"


def test_a_failed_fit_keeps_the_detections(call, pictures, tmp_path, monkeypatch):
    def without_result(objects, images, size, matrix, vector, **_):
        zeros = [np.zeros((3, 1)) for _ in objects]
        return 0.0, np.full((3, 3), np.nan), vector, zeros, zeros

    monkeypatch.setattr(cv2, "calibrateCamera", without_result)
    message = call("calibrate", *OPTIONS).message
    assert message.startswith("views must be enough for the model opencv4, got 6 that fit no camera")
    assert "The calibration failed: views must be enough for the model opencv4" in read_report(tmp_path)
    lines = (tmp_path / "calibration" / "detections.jsonl").read_text().splitlines()[1:]
    for line in lines:
        _, ((_, ids, _), *_) = json.loads(line)
        assert len(ids) >= 6


def test_pictures_of_many_sizes_are_rejected(call, pictures):
    for k, path in enumerate(sorted(pictures.iterdir())[:4]):
        save_picture(path, np.zeros((100 + k, 200), np.uint8))
    message = call("calibrate", *OPTIONS).message
    assert message.startswith("images must be of one size, since they are of one camera, got 2 of 640 x 400, 1 of ")


@pytest.mark.quick
@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("images=none",), "images must be an existing folder of pictures, got none"),
        (("images=.",), "images must be a folder that holds .jpg, .jpeg, .png, .webp, .bmp, got ."),
        (("images=cameras",), ".webp, .bmp, got cameras, whose folders are not searched; give one of them"),
        (("lens_model=opencv7",), "lens_model must be one of auto, opencv0, .*, division, got 'opencv7'"),
        (("drop_share=2",), "drop_share must be a number in .*, got 2"),
        (("dictionary=DICT",), "board: dictionary must be one of DICT_.*, got 'DICT'"),
        (
            ("board=chessboard", "marker_mm=3"),
            "an option must be one of images, lens_model, drop_share, out, board, squares, square_mm, got marker_mm",
        ),
    ],
)
def test_invalid_options_are_one_line_of_error(call, options, message, tmp_path):
    (tmp_path / "cameras" / "left").mkdir(parents=True)
    assert re.search(message, call("calibrate", *options).message)


@pytest.mark.usefixtures("blank_figures")
def test_edge_rays_of_real_pictures_are_near_the_published_camera(call, shared_data, tmp_path):
    board = ("squares=4x5", "square_mm=54", "marker_mm=40.5", "dictionary=DICT_4X4_1000")
    folder = shared_data / "charuco" / "caliscope_cam0"
    assert call("calibrate", f"images={folder}", *board, "out=out").code == 0
    camera = read_opencv(tmp_path / "out" / "camera.yaml")
    numbers = json.loads((folder.parent / "reference.json").read_text())[folder.name]["published"]
    pinhole = {key: numbers[key] for key in ("fx", "fy", "cx", "cy")}
    published = Camera(width=1280, height=720, **pinhole, coefficients=tuple(numbers["dist_k1k2p1p2k3"]))
    grid = published.grid(17)
    pixels = camera.project(published.unproject(grid).points)
    assert pixels.valid.all()
    assert (pixels.points - grid).norm(dim=1).max() < 100
    assert camera.coverage() == 1
    assert covariance_shape(tmp_path / "out") == (4 + len(camera.coefficients),) * 2


@pytest.mark.usefixtures("blank_figures")
def test_real_pictures_give_the_camera_of_opencv(call, shared_data, tmp_path):
    folder = shared_data / "charuco" / "opencv_tutorial"
    options = ("squares=5x7", "marker_mm=11", "dictionary=DICT_6X6_250", "lens_model=opencv5", "out=out")
    assert call("calibrate", f"images={folder}", *options).code == 0
    reference = json.loads((folder.parent / "reference.json").read_text())["opencv_tutorial"]
    camera = read_opencv(tmp_path / "out" / "camera.yaml")
    # Two standard deviations of a fit to so few corners.
    assert camera.fx == pytest.approx(reference["recomputed_opencv_5param"]["fx"], rel=0.03)
    assert "Used: 5 views" in (tmp_path / "out" / "report.md").read_text()
