"""The commands `calibrate`, `rectify` and `make_board`."""

import json
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
from omegaconf import DictConfig
from torch import Tensor

from torchrefract._io import make_folder, make_writable_folder, replace_file, write_figure, write_file
from torchrefract._validation import UsageError, check_choice, check_number, first_names
from torchrefract.cameras.calibration.boards import Board, Charuco, board_page
from torchrefract.cameras.calibration.choice import AUTO
from torchrefract.cameras.calibration.detection import (
    Detection,
    View,
    describe_other_board,
    detect,
    edge_width,
    explain_failure,
    has_enough_corners,
    measure_marker,
)
from torchrefract.cameras.calibration.fit import LENS_MODELS, MIN_VIEWS
from torchrefract.cameras.calibration.report import (
    CAMERA_FILE,
    REPORT_FILE,
    Calibration,
    calibrate_camera,
    camera_warnings,
    describe_corners,
    write_failure,
    write_report,
)
from torchrefract.cameras.calibration.synthetic import CAMERA, NUM_VIEWS, render_views
from torchrefract.cameras.calibration.uncertainty import MAX_DEVIATION_PX, Crop, certain_part
from torchrefract.cameras.camera import Camera
from torchrefract.cameras.io import read_camera, read_covariance, read_opencv, write_opencv
from torchrefract.cli.options import claim_out, make, naming, read_option
from torchrefract.cli.progress import Skipped, check_none_lost, print_warning, progress
from torchrefract.data import media
from torchrefract.data.images import (
    EXTENSIONS,
    UnreadableImageError,
    describe_folders,
    files_in,
    image_header,
    is_lost,
    pixels_of,
    read_image,
)
from torchrefract.data.pairs.manifest import locked
from torchrefract.data.video import convert_video
from torchrefract.fields.rectification import camera_flow, zoom_to_crop
from torchrefract.warping.warp import warp

_SYNTHETIC = "synthetic"
_STILL_PX = 0.5  # between corners of two views of a still board
_HIGH_RMS = 1e-3  # widths of the frame; the errors of fits to real boards are below
_MIN_USABLE = MIN_VIEWS + 1  # views, so that each can be left out of the fit
_MAX_REASONS = 300  # characters
_CACHE_VERSION = 5  # of detections.jsonl; lines of other versions are ignored
_MIN_SAME_SIZE = 0.75  # share of the pictures
_MAX_MARKER_ERROR = 0.15  # of the side of a marker; blur shrinks it by some percent
_NUM_DIAGNOSED = 3  # pictures in which another board is searched if the expected one is missing
_BOARD_FORMATS = (".pdf", ".png")


def make_board(cfg: DictConfig) -> None:
    """Write a board as PDF or PNG."""
    board, out = make(cfg, "board"), Path(str(cfg.out))
    dpi = read_option(cfg, "dpi", check_number, low=20.0, high=2400.0)
    margin = read_option(cfg, "margin_mm", check_number, low=0.0, high=1000.0)
    if out.suffix.lower() not in _BOARD_FORMATS:
        raise UsageError(f"out must end in {' or '.join(_BOARD_FORMATS)}, got {out}")
    try:
        make_folder(out.parent)
        write_figure(out, board_page(board, margin_mm=margin), dpi=dpi)
    except OSError as error:
        raise UsageError(f"{out} could not be written: {error.strerror}") from error
    width, height = board.size_mm
    print(f"{out}: {board.describe()}, {width:g} x {height:g} mm; print it at 100 % and measure the ruler below it")


def calibrate(cfg: DictConfig) -> None:
    """Detect the board in pictures, fit the camera, and write camera.yaml and report.md.

    Detections are kept in detections.jsonl, so that an interrupted run continues.
    """
    board = make(cfg, "board")
    model = read_option(cfg, "lens_model", check_choice, choices=(AUTO, *LENS_MODELS))
    max_drop_share = read_option(cfg, "drop_share", check_number, low=0.0, high=0.9)
    out = Path(str(cfg.out))
    with naming("out"):
        make_writable_folder(out)
    with locked("out", out):
        is_synthetic = str(cfg.images) == _SYNTHETIC
        files = _rendered(board, out / "rendered") if is_synthetic else find_pictures(str(cfg.images))
        _calibrate(files, board, out, model=model, max_drop_share=max_drop_share)


def _calibrate(files: Sequence[Path], board: Board, out: Path, *, model: str, max_drop_share: float) -> None:
    if turned := media.describe_turned(files):
        print(turned)
    search = detect_all(files, board, out / "detections.jsonl")
    detections = list(progress(search, "detecting the board", count=len(files)))
    paths = {file.name: file for file in files}
    try:
        size = _common_size(detections)
        detections = _reject_repeated([_reject_other_size(detection, size) for detection in detections])
        _check_count(detections, paths, board)
        _check_marker(detections, paths, board)
        calibration = calibrate_camera(detections, board, model=model, size=size, max_drop_share=max_drop_share)
    except (UsageError, ValueError) as error:
        write_failure(board, detections, str(error), out)
        raise UsageError(f"{error} ({out / REPORT_FILE} lists all pictures)") from error
    write_opencv(out / CAMERA_FILE, calibration.fit.camera, covariance=calibration.fit.covariance)
    write_report(calibration, lambda name: read_gray(paths[name]), out)
    if turned:
        with (out / REPORT_FILE).open("a", encoding="utf-8") as stream:
            stream.write(f"\n\n{turned}.\n")
    _print_summary(calibration, out)


def find_pictures(folder: str | Path) -> list[Path]:
    """Return the pictures of a folder, sorted by name; raise UsageError if it does not exist or holds none."""
    if not (folder := Path(folder)).is_dir():
        raise UsageError(f"images must be an existing folder of pictures, got {folder}")
    if not (files := files_in(folder)):
        remedy = describe_folders(folder)
        raise UsageError(f"images must be a folder that holds {', '.join(EXTENSIONS)}, got {folder}{remedy}")
    return files


def read_gray(path: Path) -> np.ndarray:
    """Read a picture (H, W), uint8, as it is stored, in the frame of the sensor; OpenCV converts it to gray."""
    return cv2.cvtColor(pixels_of(read_image(path, upright=False)), cv2.COLOR_RGB2GRAY)


def detect_all(files: Sequence[Path], board: Board, cache: Path) -> Iterator[Detection]:
    """Detect a board in pictures that the cache, a file of JSON lines, does not hold for this board and file."""
    key = f"{_CACHE_VERSION}, OpenCV {cv2.__version__}, {board.describe()}"
    cached = _read_cache(cache)
    with cache.open("a", encoding="utf-8") as stream:
        for file in files:
            stat = file.stat() if file.exists() else None
            stamp = f"{key}, {stat.st_size} {stat.st_mtime_ns}" if stat else key
            if (detection := cached.get((file.name, stamp))) is None:
                detection = _detect_in_file(file, board)
                # The line before may be incomplete, if its run was interrupted.
                stream.write("\n" + json.dumps([stamp, detection], default=np.ndarray.tolist))
                stream.flush()
            yield detection


def _read_cache(path: Path) -> dict[tuple[str, str], Detection]:
    """Return cached detections by name and stamp; an incomplete line of an interrupted run is ignored."""
    cached = {}
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines() if path.is_file() else ():
        try:
            stamp, ((name, ids, corners), size, edge_width_px, problem) = json.loads(line)
        except (ValueError, TypeError):
            continue
        view = View(name, np.array(ids, dtype=int), np.array(corners, dtype=np.float64).reshape(-1, 2))
        cached[name, stamp] = Detection(view, (size[0], size[1]), edge_width_px, problem)
    return cached


def _detect_in_file(file: Path, board: Board) -> Detection:
    try:
        gray = read_gray(file)
    except UnreadableImageError as error:
        return Detection(View(file.name, np.empty(0, dtype=int), np.empty((0, 2))), (0, 0), 0.0, f"unreadable: {error}")
    view = detect(gray, board, name=file.name)
    problem = "" if has_enough_corners(view, board) else explain_failure(gray, view, board)
    return Detection(view, (gray.shape[1], gray.shape[0]), edge_width(gray), problem)


def _common_size(detections: Sequence[Detection]) -> tuple[int, int]:
    """Return the width and height of nearly all pictures, or raise UsageError."""
    counts = Counter(detection.size for detection in detections if detection.size != (0, 0))
    if not counts:
        first = detections[0].problem
        raise UsageError(f"images must hold a readable picture, got {len(detections)} files without one: {first}")
    (size, count), *_ = counts.most_common()
    if count < _MIN_SAME_SIZE * counts.total():
        sizes = ", ".join(f"{count} of {width} x {height}" for (width, height), count in counts.most_common())
        raise UsageError(f"images must be of one size, since they are of one camera, got {sizes} (width x height)")
    return size


def _reject_other_size(detection: Detection, size: tuple[int, int]) -> Detection:
    if detection.problem or detection.size == size:
        return detection
    width, height = detection.size
    return detection._replace(problem=f"{width} x {height} px, other pictures have {size[0]} x {size[1]} px")


def _reject_repeated(detections: Sequence[Detection]) -> list[Detection]:
    """Mark views that repeat an earlier one, as frames of a still board: they would count as independent evidence."""
    views, result = list[View](), list[Detection]()
    for detection in detections:
        same = [] if detection.problem else [o.name for o in views if _motion_px(detection.view, o) < _STILL_PX]
        if same:
            detection = detection._replace(problem=f"shows the board where {same[0]} does")  # noqa: PLW2901 - a new value
        elif not detection.problem:
            views.append(detection.view)
        result.append(detection)
    return result


def _motion_px(view: View, other: View) -> float:
    """Return the largest distance between corners of two views; inf if they share less than half of them."""
    _, i, j = np.intersect1d(view.ids, other.ids, return_indices=True)
    if 2 * len(i) < max(len(view.ids), len(other.ids)):
        return np.inf
    return float(np.linalg.norm(view.corners[i] - other.corners[j], axis=1).max())


def _check_count(detections: Sequence[Detection], paths: dict[str, Path], board: Board) -> None:
    """Raise UsageError if too few pictures show the board, with the likely cause."""
    failed = [detection for detection in detections if detection.problem]
    if (count := len(detections) - len(failed)) >= _MIN_USABLE:
        return
    parts = [f"images must show the board ({board.describe()}) in at least {_MIN_USABLE} pictures, got {count}"]
    for detection in sorted((d for d in failed if d.size != (0, 0)), key=lambda d: d.edge_width_px)[:_NUM_DIAGNOSED]:
        if other := describe_other_board(read_gray(paths[detection.view.name]), board):
            parts.append(f"{detection.view.name} shows {other}")
            break
    reasons = "; ".join(f"{detection.view.name}: {detection.problem}" for detection in failed)
    if reasons:
        parts.append(reasons if len(reasons) <= _MAX_REASONS else f"{reasons[:_MAX_REASONS]} …")
    raise UsageError(". ".join(parts))


def _check_marker(detections: Sequence[Detection], paths: dict[str, Path], board: Board) -> None:
    """Raise UsageError if the markers of a ChArUco board have another size in the pictures, relative to the squares."""
    if not isinstance(board, Charuco):
        return
    views = sorted((d.view for d in detections if not d.problem), key=lambda view: -len(view.ids))[:_NUM_DIAGNOSED]
    sides = [measure_marker(read_gray(paths[view.name]), view, board) for view in views]
    side = float(np.nanmedian(sides)) if np.isfinite(sides).any() else board.marker_mm
    if abs(side / board.marker_mm - 1) > _MAX_MARKER_ERROR:
        raise UsageError(
            f"marker_mm must be the side of the markers, about {side:.3g} mm in the pictures if square_mm = "
            f"{board.square_mm:g} is right, got {board.marker_mm:g}"
        )


def _rendered(board: Board, folder: Path) -> list[Path]:
    """Return pictures of the board by a known camera; they are rendered unless the folder holds them already."""
    marker, content = folder / "rendered.txt", f"{board.describe()}\n{CAMERA}\n"
    if not marker.is_file() or marker.read_text(encoding="utf-8") != content:
        folder.mkdir(exist_ok=True)
        for name, picture, _ in progress(render_views(board), "rendering", count=NUM_VIEWS):
            # cv2.imwrite would not say that a disk is full.
            write_file(folder / name, cv2.imencode(".png", picture)[1].tobytes())
        write_file(marker, content)
    return find_pictures(folder)


def _print_summary(calibration: Calibration, out: Path) -> None:
    for name, reason in calibration.dropped.items():
        print(f"{name} dropped: {reason}")
    if unused := [
        f"{detection.view.name} ({detection.problem})" for detection in calibration.detections if detection.problem
    ]:
        print(f"not used: {first_names(unused)}")
    if calibration.fit.rms > _HIGH_RMS * calibration.fit.camera.width:
        print_warning(
            f"an error of {calibration.fit.rms:.2f} px rms is high: the board may be bent, or the pictures of several "
            "cameras or zooms, cropped, or turned before they were saved; look at the views in the report"
        )
    for message in camera_warnings(calibration.fit.camera):
        print_warning(message)
    print(
        f"{out / CAMERA_FILE}: {calibration.fit.model} from {len(calibration.views)} views in "
        f"{len(calibration.detections)} pictures, error {calibration.fit.rms:.3f} px rms, of held-out views "
        f"{calibration.held_out_rms:.3f} px rms; standard deviation of rectified corners, px: "
        f"{describe_corners(calibration.fit)}; see {out / REPORT_FILE}"
    )


class _Rectifier:
    """Rectifies frames of a camera, of any size with the ratio of its sides; keeps a part of them if one is given."""

    def __init__(self, camera: Camera, zoom: float, part: Crop | None):
        self.camera, self.part = camera, part
        self.sizes = set[tuple[int, int]]()  # (width, height) of the frames so far
        self._flow = lru_cache(maxsize=2)(lambda h, w: camera_flow(camera.resized(width=w, height=h), zoom=zoom)[0])

    def write(self, file: Path, path: Path) -> None:
        """Write the rectified picture or video of a file to a path."""
        if media.is_video(file):
            convert_video(file, path, change=lambda frames: map(pixels_of, map(self._rectify, frames)), upright=False)
        else:
            frame = read_image(file, upright=False)[None].contiguous()
            media.write_picture(self._rectify(frame), path, source=file, upright=False)

    def is_complete(self, file: Path, target: Path) -> bool:
        """Return True if the output of a file is newer, and has the size of the part that is kept."""
        if self.part is None or media.is_video(file):
            return media.is_complete(file, target)
        with suppress(UnreadableImageError):
            size = self.part.size(image_header(file).size[1], self.camera.width)
            return not media.is_older(target, file) and image_header(target).size == size
        return False

    def _rectify(self, frame: Tensor) -> Tensor:
        """Rectify a frame (1, 3, H, W) in [0, 1] to (3, H, W)."""
        height, width = frame.shape[2:]
        result = warp(frame, self._flow(height, width), interpolation="bicubic")[0][0]
        self.sizes.add((width, height))
        return result if self.part is None else self.part.of(result, self.camera.width)


def rectify(cfg: DictConfig) -> None:
    """Rectify pictures and videos that are not in the output folder yet, and write the camera of the results."""
    source, out = Path(str(cfg.input)), Path(str(cfg.out))
    zoom = _read_zoom(cfg)
    with naming("camera"):
        camera = read_camera(str(cfg.camera), name=cfg.camera_name)
        covariance = read_covariance(str(cfg.camera))
        if cfg.crop:
            zoom = max(zoom, zoom_to_crop(camera))
        _, exists, pinhole = camera_flow(camera, zoom=zoom)
    part, pinhole = _part_to_keep(cfg, camera, covariance, pinhole)
    files = media.find_media(source, out=out)
    _claim_for_cameras(out, source, {"lens.yaml": camera, CAMERA_FILE: pinhole})
    if not exists.all():
        share = 1 - exists.double().mean().item()
        print_warning(f"the camera's model folds back inside the frame: {share:.1%} of it stays black")
    for message in filter(None, (media.describe_turned(files), *media.describe_losses(files, upright=False))):
        print_warning(message)

    rectifier, num_existing, skipped = _Rectifier(camera, zoom, part), 0, Skipped()
    with locked("out", out):
        for file in progress(files, "rectifying", count=len(files)):
            target = out / media.output_name(file).name
            try:
                if rectifier.is_complete(file, target):
                    num_existing += 1
                    continue
                with replace_file(target, alone=True) as path:
                    rectifier.write(file, path)
            except ValueError as error:
                named = f"{error}" if isinstance(error, UnreadableImageError) else f"{file}: {error}"
                skipped.add(named, is_lost=is_lost(error))
    counts = skipped.summarize("rectified", total=len(files), existing=num_existing)
    _warn_of_other_sizes(rectifier.sizes, camera, out / CAMERA_FILE)
    print(f"{out}: {counts}; camera of the results: {out}/{CAMERA_FILE}")
    check_none_lost(skipped.lost)


def _read_zoom(cfg: DictConfig) -> float:
    """Return the option `zoom`; raise UsageError if `crop` would ignore it."""
    zoom = read_option(cfg, "zoom", check_number, low=0.05, high=20.0)
    if cfg.crop and zoom < 1:
        raise UsageError(
            f"zoom must be at least 1 beside crop=true, which never zooms out, got {zoom:g}; leave one of them out"
        )
    return zoom


def _part_to_keep(
    cfg: DictConfig, camera: Camera, covariance: np.ndarray | None, pinhole: Camera
) -> tuple[Crop | None, Camera]:
    """Return the part of rectified frames that is certain enough, None for all, and its camera; warn of the rest."""
    if covariance is not None:
        deviation, crop = certain_part(camera, covariance, pinhole)
        if deviation > MAX_DEVIATION_PX and not cfg.crop:
            print_warning(
                f"the rectified position has a standard deviation of up to {deviation:.1f} px; in the middle "
                f"{crop.width} x {crop.height} px it is at most {MAX_DEVIATION_PX:g} px: crop=true keeps these only"
            )
        elif cfg.crop and deviation > MAX_DEVIATION_PX:
            return crop, pinhole.cropped(**crop._asdict())
    return None, pinhole


def _claim_for_cameras(out: Path, source: Path, cameras: Mapping[str, Camera]) -> None:
    """Create the output folder with the files of cameras; raise UsageError if it is of another input or camera."""
    folder = source if source.is_dir() else source.parent
    with naming("out"):
        claim_out(out, {"input": str(folder.resolve())})
    for name, camera in cameras.items():
        _write_camera(out / name, camera)


def _warn_of_other_sizes(sizes: Iterable[tuple[int, int]], camera: Camera, path: Path) -> None:
    """Warn of frames, of sizes (width, height), that are not of the size that the file with their camera states."""
    others = [f"{w} x {h}" for w, h in sorted(sizes) if (w, h) != (camera.width, camera.height)]
    if others:
        print_warning(
            f"{path} is the camera of frames of {camera.width} x {camera.height} px; for those of {', '.join(others)} "
            "px scale its numbers, as camera.resized does"
        )


def _write_camera(path: Path, camera: Camera) -> None:
    """Write a camera unless the file holds it already; raise UsageError if it holds another one."""
    if not path.is_file():
        try:
            write_opencv(path, camera)
        except ValueError as error:  # a polynomial of Metashape with k4
            raise UsageError(str(error)) from error
        return
    with naming("out"):
        existing = read_opencv(path)
    if existing != camera:
        raise UsageError(
            f"out must be a folder of the same camera and zoom, got {path.parent} with another {path.name}"
        )
