"""Calibrations with real pictures of boards beside OpenCV's own, a planted bad view, and how straight lines get.

python benchmarks/calibration.py FOLDER [--sets caliscope_cam0 …] [--out benchmarks/results/calibration.json]

FOLDER holds charuco/ and chessboard/, each with a reference.json, such as ../shared/data. "plain" is
cv2.calibrateCamera on the corners as OpenCV's detectors give them, in all pictures of the stated size. Held-out errors
are of five folds, px rms over corners. Bad views are planted in place of a good one, one at a time: a picture bent over
the width of its board, by a hundredth of the frame's width in the middle, as by a sheet that hangs through; corners as
in a picture enlarged by a tenth about its middle; one corner 5 px off; two corners beside one another swapped; and the
picture mirrored. Straight: corners of a row or column off
the line through them, px rms, found in the pictures, and found again in the rectified ones, of those found in both.
"""

import argparse
import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from torchrefract.fields.rectifying import camera_flow

from torchrefract._io import replace_file
from torchrefract._tensor import to_float, to_uint8
from torchrefract.board_views import pictures_of, read_gray
from torchrefract.calibration_report import camera_of
from torchrefract.cameras.calibration.boards import Board, Charuco, Chessboard
from torchrefract.cameras.calibration.detection import SEARCH, View, detect, is_enough
from torchrefract.cameras.calibration.fit import Fit, fit, held_out, rms
from torchrefract.cameras.calibration.outliers import drop_outliers
from torchrefract.cameras.calibration.straightness import straightness
from torchrefract.cameras.models import Camera
from torchrefract.warping.warp import warp

_SAG = 0.01  # of the width of the frame
_STILL = 0.7  # of the corners
_LARGER, _OFF = 1.1, (3.0, 4.0)  # px
_MODEL = "opencv5"


@dataclass
class Row:
    """What a set of pictures came to; px unless it says otherwise."""

    name: str
    pictures: int
    views: int
    dropped: list[str]
    corners: int
    rms: float
    held: float
    fx: float
    fy: float
    cx: float
    cy: float
    coefficients: list[float]
    plain_views: int
    plain_rms: float
    plain_held: float
    reference_fx_percent: float | None  # of the published camera, where there is one
    planted: dict[str, str]  # by what is bad: "named", "missed", or why it is no view
    bent: float
    straight: float


def board_of(entry: dict[str, Any]) -> Board:
    """The board of a set, as its reference.json describes it."""
    if "board" in entry:
        b = entry["board"]
        size = {"square_mm": 1000 * b["square_m"], "marker_mm": 1000 * b["marker_m"]}
        return Charuco(squares=f"{b['squares_x']}x{b['squares_y']}", dictionary=b["dictionary"], **size)
    columns, rows = entry["pattern_inner_corners"]
    return Chessboard(squares=f"{columns + 1}x{rows + 1}", square_mm=1000 * entry.get("square_m", 0.025))


def measure(name: str, entry: dict[str, Any], folder: Path) -> Row:
    """The figures of one set."""
    board, pictures = board_of(entry), {path.name: read_gray(path) for path in pictures_of(folder)}
    size = (entry["image_size"][0], entry["image_size"][1])
    pictures = {name: gray for name, gray in pictures.items() if gray.shape == size[::-1]}
    views = [view for view in (detect(gray, board, name=n) for n, gray in pictures.items()) if is_enough(view, board)]
    kept = drop_outliers(views, board, model=_MODEL, size=size)
    plain_views = [view for view in (_plain(gray, board, n) for n, gray in pictures.items()) if is_enough(view, board)]
    plain = fit(plain_views, board, model=_MODEL, size=size)
    planted = _plant(views, pictures, board, size)
    fx, fy, cx, cy, *coefficients = kept.fitted.lens.numbers.tolist()
    published = entry.get("published")
    bent, straight = _straight(kept.views, pictures, board, camera_of(kept.fitted, size))
    return Row(
        name, len(pictures), len(kept.views), list(kept.dropped), sum(len(view.ids) for view in kept.views),
        kept.fitted.rms, _held(kept.views, board, kept.fitted, size), fx, fy, cx, cy, coefficients,
        len(plain_views), plain.rms, _held(plain_views, board, plain, size),
        100 * (fx / published["fx"] - 1) if published else None, planted, bent, straight,
    )  # fmt: skip


def _held(views: list[View], board: Board, fitted: Fit, size: tuple[int, int]) -> float:
    return rms(np.concatenate(held_out(views, board, fitted, size=size)))


def _plain(gray: np.ndarray, board: Board, name: str) -> View:
    """OpenCV's corners; of an inverted board those in the negative."""
    ids, corners = None, None
    if isinstance(board, Charuco):
        for picture in (gray, 255 - gray):
            corners, ids, _, _ = cv2.aruco.CharucoDetector(board.opencv(False)).detectBoard(picture)
            if ids is not None:
                break
    else:
        found, corners = cv2.findChessboardCornersSB(gray, board.inner, flags=SEARCH)
        ids = np.arange(len(corners)) if found else None
    if ids is None or corners is None:
        return View(name, np.empty(0, dtype=int), np.empty((0, 2)))
    return View(name, ids.ravel(), corners.reshape(-1, 2).astype(np.float64))


def _plant(views: list[View], pictures: dict[str, np.ndarray], board: Board, size: tuple[int, int]) -> dict[str, str]:
    """What each bad view comes to, in place of the first one that is still found when its picture is bent."""
    for view in views:
        bent = detect(_bent(pictures[view.name], view), board, name=view.name)
        if len(bent.ids) >= _STILL * len(view.ids):
            mirrored = np.ascontiguousarray(pictures[view.name][:, ::-1])
            bad = {"bent": bent, **bad_corners(view, size), "mirrored": detect(mirrored, board, name=view.name)}
            return {what: _fate(one, views, board, size) for what, one in bad.items()}
    return {}


def bad_corners(view: View, size: tuple[int, int]) -> dict[str, View]:
    """A view as of an enlarged picture, with one corner off, and with two corners swapped."""
    middle, k = (np.array(size) - 1) / 2, len(view.ids) // 2
    off, swapped = view.corners.copy(), view.corners.copy()
    off[k] += _OFF
    swapped[[k, k + 1]] = swapped[[k + 1, k]]
    large = middle + _LARGER * (view.corners - middle)
    return {
        "enlarged": view._replace(corners=large),
        "one off": view._replace(corners=off),
        "swapped": view._replace(corners=swapped),
    }


def _fate(bad: View, views: list[View], board: Board, size: tuple[int, int]) -> str:
    if not is_enough(bad, board):
        return "no view"
    among = [bad if view.name == bad.name else view for view in views]
    return "named" if bad.name in drop_outliers(among, board, model=_MODEL, size=size).dropped else "missed"


def _bent(gray: np.ndarray, view: View) -> np.ndarray:
    height, width = gray.shape
    x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    left, right = view.corners[:, 0].min(), view.corners[:, 0].max()
    across = ((2 * x - left - right) / (right - left)).clip(-1, 1)
    sag = (_SAG * width * (1 - across**2)).astype(np.float32)
    return cv2.remap(gray, x, y - sag, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)


def _straight(views: list[View], pictures: dict[str, np.ndarray], board: Board, camera: Camera) -> tuple[float, float]:
    """How straight corners are before and after, of those found in both."""
    flow, pairs = camera_flow(camera)[0], []
    for view in views:
        image = to_float(torch.from_numpy(pictures[view.name])[None, None])
        rectified = to_uint8(warp(image, flow, interpolation="bicubic")[0])
        again = detect(rectified[0, 0].numpy(), board, name=view.name)
        both, before, after = np.intersect1d(view.ids, again.ids, return_indices=True)
        pairs.append((View(view.name, both, view.corners[before]), View(view.name, both, again.corners[after])))
    first, then = zip(*pairs, strict=True)
    return straightness(first, board), straightness(then, board)


def _show(row: Row) -> str:
    reference = "" if row.reference_fx_percent is None else f"{row.reference_fx_percent:+.2f} %"
    return (
        f"{row.name:16} {row.views:2}/{row.pictures:2} {row.corners:5} {row.rms:7.3f} {row.held:7.3f} "
        f"{row.plain_views:6} {row.plain_rms:6.3f} {row.plain_held:7.3f} {row.fx:8.1f} {reference:>9} "
        f"{row.bent:7.3f} {row.straight:8.3f}  {', '.join(f'{what} {fate}' for what, fate in row.planted.items())}"
    )


def main() -> None:
    """Measure, print and save."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path, help="with charuco/ and chessboard/")
    parser.add_argument("--sets", nargs="*", help="their names, all")
    parser.add_argument(
        "--out", type=Path, default=Path(__file__).parent / "results" / "calibration.json", help="the JSON"
    )
    args = parser.parse_args()
    print("plain: OpenCV's corners, all views; bent, straight: before and after rectification; px rms")
    print(f"{'set':16} views corners   rms    held  plain    rms    held       fx published    bent straight bad views")
    rows = []
    for kind in ("charuco", "chessboard"):
        entries = json.loads((args.folder / kind / "reference.json").read_text(encoding="utf-8"))
        for name, entry in entries.items():
            if not args.sets or name in args.sets:
                rows.append(measure(name, entry, args.folder / kind / name))
                print(_show(rows[-1]), flush=True)
    args.out.parent.mkdir(parents=True, exist_ok=True)
    with replace_file(args.out) as temporary:
        temporary.write_text(json.dumps([asdict(row) for row in rows], indent=2) + "\n", encoding="utf-8")
    print(f"written to {args.out}")


if __name__ == "__main__":
    main()
