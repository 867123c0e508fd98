"""Accuracy of cameras: calibration from real pictures, and inversion and conversion of published lenses.

    python benchmarks/calibration.py boards FOLDER [--sets caliscope_cam0 ...] [--out RESULTS.json]
    python benchmarks/calibration.py lenses LENSES.json [--step PX] [--out RESULTS.json] [--table LENSES.csv]

`boards` calibrates with the pictures of FOLDER, which holds charuco/ and chessboard/, each with a reference.json.
The lens model is the one that `calibrate` chooses. "OpenCV" is cv2.calibrateCamera, with its five coefficients, of the
corners of OpenCV's detectors in all pictures; "four" is the same without k3, of the corners of this library. Held-out
errors are of five folds. All errors are in px rms over corners. "edge" is the largest distance over the frame, px,
between where the camera and the published one show a ray, "nearest" the least that any model has from which `calibrate`
chooses, as only the published camera can tell; "folded" is the share of the frame without a ray. Bad views are planted
in place of a good one, one at a time: a picture bent over the width of its board by up to a hundredth of the frame's
width; corners of a picture enlarged by a tenth; one corner 5 px off; two neighboring corners swapped; the mirrored
picture. They are searched as `calibrate` does before it chooses the lens model. "lines" is the distance of corners of
one row or column from a straight line, in the pictures and after `rectify`.

`lenses` unprojects the pixels of each lens and puts the rays into OpenCV's forward formula. "wrong" is the share of
pixels that are off by more than 1e-6 px and not marked: `valid` marks pixels of this library, -1e6 those of OpenCV's
fisheye. OpenCV and kornia run with their defaults; kornia has no fisheye. Pixels of a fisheye beyond 85 degrees count
for this library only. LENSES.json is a list of rows with id, camera, lens, model (opencv5, rational8, thin-prism12,
fisheye4), width, height, fx, fy, cx, cy, coeffs, source_repo, source_path, commit and licence. `--table` writes the
CSV of `read_lenses`, without share-alike rows.
"""

import argparse
import contextlib
import csv
import importlib
import itertools
import json
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from timing import write_json
from torch import Tensor

from torchrefract._io import replace_file
from torchrefract._tensor import to_float, to_uint8
from torchrefract.cameras.calibration.boards import Board, Charuco, Chessboard
from torchrefract.cameras.calibration.choice import AUTO, CANDIDATES, is_one_to_one
from torchrefract.cameras.calibration.detection import SEARCH_FLAGS, Detection, View, detect, has_enough_corners
from torchrefract.cameras.calibration.fit import PRIORS, Fit, cross_validate, drop_outliers, fit_camera, rms
from torchrefract.cameras.calibration.report import FIRST_MODEL, FIRST_PRIOR, calibrate_camera, straightness
from torchrefract.cameras.camera import Camera
from torchrefract.cameras.conversion import Conversion, convert
from torchrefract.cameras.lens_database import COLUMNS
from torchrefract.cli.calibration import find_pictures, read_gray
from torchrefract.fields.rectification import camera_flow
from torchrefract.warping.warp import warp

OPENCV_MODEL = "opencv5"
MAX_ERROR_PX = 1e-6
_MODELS = {"opencv5": "opencv", "rational8": "opencv", "thin-prism12": "opencv", "fisheye4": "fisheye"}
_MAX_RESIDUAL_PX = 1.0  # of a polynomial in the table
_DROP_SHARE = 0.25  # as `calibrate` has it
_EDGE_GRID = 17  # points along each side of the frame
_ZERO = np.zeros(3)


class BoardRow(NamedTuple):
    """Results of a set of pictures; errors in px rms."""

    name: str
    model: str
    pictures: int
    views: int
    corners: int
    error: float
    held_out: float
    opencv_views: int
    opencv_error: float
    opencv_held_out: float
    four_held_out: float
    edge_px: float | None  # largest distance from the published camera
    nearest_px: float | None  # the same, of the nested model that comes nearest to it
    folded: float  # share of the frame
    lines: float
    rectified_lines: float
    fx: float
    published_fx_percent: float | None  # difference from the published camera
    planted: dict[str, str]  # by kind of bad view: "dropped", "missed" or "no view"


class LensRow(NamedTuple):
    """Results of a lens; the largest error in px and the share of wrong pixels of each library."""

    name: str
    model: str
    invalid: float  # share of the frame that is marked
    ours_px: float
    ours_wrong: float
    opencv_px: float
    opencv_wrong: float
    kornia_px: float | None
    kornia_wrong: float | None


def board_from_entry(entry: Mapping[str, Any]) -> Board:
    """Create the board that an entry of reference.json describes."""
    if "board" in entry:
        b = entry["board"]
        size = {"square_mm": 1000 * b["square_m"], "marker_mm": 1000 * b["marker_m"]}
        return Charuco(squares=f"{b['squares_x']}x{b['squares_y']}", dictionary=b["dictionary"], **size)
    columns, rows = entry["pattern_inner_corners"]
    return Chessboard(squares=f"{columns + 1}x{rows + 1}", square_mm=1000 * entry.get("square_m", 0.025))


def camera_from_entry(entry: Mapping[str, Any], size: tuple[int, int]) -> Camera:
    """Create the camera of (width, height) px that a calibration in reference.json describes."""
    pinhole = {name: entry[name] for name in ("fx", "fy", "cx", "cy")}
    return Camera(width=size[0], height=size[1], **pinhole, coefficients=tuple(entry["dist_k1k2p1p2k3"]))


def measure_board(name: str, entry: Mapping[str, Any], folder: Path) -> BoardRow:
    """Calibrate with the pictures of a folder, with this library and with OpenCV alone."""
    board, size = board_from_entry(entry), (entry["image_size"][0], entry["image_size"][1])
    pictures = {path.name: read_gray(path) for path in find_pictures(folder)}
    pictures = {name: gray for name, gray in pictures.items() if gray.shape == size[::-1]}

    def usable(detector: Callable[..., View]) -> list[View]:
        views = (detector(gray, board, name=name) for name, gray in pictures.items())
        return [view for view in views if has_enough_corners(view, board)]

    def fit_and_validate(views: Sequence[View], model: str) -> tuple[Fit, float]:
        fit = fit_camera(views, board, model=model, size=size)
        return fit, rms(np.concatenate(cross_validate(views, board, fit)))

    views, opencv_views = usable(detect), usable(opencv_detect)
    detections = [Detection(view, size, 0.0, "") for view in views]
    calibration = calibrate_camera(detections, board, model=AUTO, size=size, max_drop_share=_DROP_SHARE)
    kept, fit = calibration.views, calibration.fit
    camera, published = fit.camera, entry.get("published")
    opencv_fit, opencv_held_out = fit_and_validate(opencv_views, OPENCV_MODEL)
    return BoardRow(
        name, f"{fit.model}, {fit.prior}", len(pictures), len(kept), sum(len(view.ids) for view in kept),
        fit.rms, calibration.held_out_rms, len(opencv_views), opencv_fit.rms, opencv_held_out,
        fit_and_validate(kept, "opencv4")[1], edge_distance(camera, published) if published else None,
        nearest_edge(kept, board, size, published) if published else None,
        1 - camera.coverage(),
        *_line_errors(kept, pictures, board, camera),
        camera.fx, 100 * (camera.fx / published["fx"] - 1) if published else None,
        _plant(views, pictures, board, size),
    )  # fmt: skip


def edge_distance(camera: Camera, published: Mapping[str, Any]) -> float:
    """Return the largest distance over the frame, px, between where a camera and a published one show a ray."""
    other = camera_from_entry(published, (camera.width, camera.height))
    pixels = other.grid(_EDGE_GRID)
    rays, has_ray, _ = other.unproject(pixels)
    shown, valid, _ = camera.project(rays)
    distance = torch.where(valid, (shown - pixels).norm(dim=1), torch.inf)
    return distance[has_ray].max().item()


def nearest_edge(views: Sequence[View], board: Board, size: tuple[int, int], published: Mapping[str, Any]) -> float:
    """Return the least `edge_distance` of the models that `calibrate` chooses from."""
    distances = []
    for model, prior in itertools.product(CANDIDATES, PRIORS[1:]):
        with contextlib.suppress(ValueError):  # views that do not fit the model
            camera = fit_camera(views, board, model=model, size=size, prior=prior).camera
            distances += [edge_distance(camera, published)] if is_one_to_one(camera) else []
    return min(distances)


def opencv_detect(gray: np.ndarray, board: Board, *, name: str) -> View:
    """Detect corners by OpenCV alone; an inverted ChArUco board is detected in the negative."""
    ids, corners = None, None
    if isinstance(board, Charuco):
        for picture in (gray, 255 - gray):
            corners, ids, _, _ = cv2.aruco.CharucoDetector(board.to_opencv(legacy=False)).detectBoard(picture)
            if ids is not None:
                break
    else:
        has_board, corners = cv2.findChessboardCornersSB(gray, board.num_corners, flags=SEARCH_FLAGS)
        ids = np.arange(len(corners)) if has_board else None
    if ids is None or corners is None:
        return View(name, np.empty(0, dtype=int), np.empty((0, 2)))
    return View(name, ids.ravel(), corners.reshape(-1, 2).astype(np.float64))


def bad_corners(view: View, size: tuple[int, int]) -> dict[str, View]:
    """Return a view enlarged by a tenth, with one corner 5 px off, and with two corners swapped."""
    middle, k = (np.array(size) - 1) / 2, len(view.ids) // 2
    off, swapped = view.corners.copy(), view.corners.copy()
    off[k] += (3.0, 4.0)
    swapped[[k, k + 1]] = swapped[[k + 1, k]]
    corners = {"enlarged": middle + 1.1 * (view.corners - middle), "one off": off, "swapped": swapped}
    return {kind: view._replace(corners=values) for kind, values in corners.items()}


def _plant(views: list[View], pictures: dict[str, np.ndarray], board: Board, size: tuple[int, int]) -> dict[str, str]:
    """Replace a view by each kind of bad view, the first one that is still detected in its bent picture."""
    for view in views:
        bent = detect(_bend(pictures[view.name], view), board, name=view.name)
        if len(bent.ids) < 0.7 * len(view.ids):
            continue
        mirrored = detect(np.ascontiguousarray(pictures[view.name][:, ::-1]), board, name=view.name)
        results = {}
        for kind, bad in {"bent": bent, **bad_corners(view, size), "mirrored": mirrored}.items():
            mixed = [bad if view.name == bad.name else view for view in views]
            if not has_enough_corners(bad, board):
                results[kind] = "no view"
            else:
                dropped = drop_outliers(mixed, board, model=FIRST_MODEL, size=size, prior=FIRST_PRIOR).dropped
                results[kind] = "dropped" if bad.name in dropped else "missed"
        return results
    return {}


def _bend(gray: np.ndarray, view: View) -> np.ndarray:
    height, width = gray.shape
    x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    left, right = view.corners[:, 0].min(), view.corners[:, 0].max()
    t = ((2 * x - left - right) / (right - left)).clip(-1, 1)
    sag = (0.01 * width * (1 - t**2)).astype(np.float32)
    return cv2.remap(gray, x, y - sag, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)


def _line_errors(
    views: Sequence[View], pictures: dict[str, np.ndarray], board: Board, camera: Camera
) -> tuple[float, float]:
    """Return the straightness of corners in the pictures and in rectified ones, of those detected in both."""
    flow, before, after = camera_flow(camera)[0], [], []
    for view in views:
        image = to_float(torch.from_numpy(pictures[view.name])[None, None])
        rectified = to_uint8(warp(image, flow, interpolation="bicubic")[0])
        again = detect(rectified[0, 0].numpy(), board, name=view.name)
        ids, i, j = np.intersect1d(view.ids, again.ids, return_indices=True)
        before.append(View(view.name, ids, view.corners[i]))
        after.append(View(view.name, ids, again.corners[j]))
    return straightness(before, board), straightness(after, board)


def camera_from_row(row: Mapping[str, Any]) -> Camera:
    """Create the camera of a row of the JSON table."""
    fx, fy, cx, cy = (float(row[name]) for name in ("fx", "fy", "cx", "cy"))
    width, height = int(row["width"]), int(row["height"])
    coefficients, model = tuple(row["coeffs"]), _MODELS[row["model"]]
    return Camera(width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy, coefficients=coefficients, model=model)


def measure_lens(name: str, camera: Camera, *, step: int) -> LensRow:
    """Invert a lens over its frame, at pixels `step` apart."""
    axes = [torch.arange(0, size, step, dtype=torch.float64) for size in (camera.width, camera.height)]
    pixels = torch.cartesian_prod(*axes)
    rays, valid, _ = camera.unproject(pixels)
    errors = forward_error(camera, rays.numpy(), pixels.numpy())[valid.numpy()]
    in_front = ~valid.numpy() | (rays[:, 2] > np.cos(np.radians(85))).numpy()
    opencv = _other_errors(camera, pixels, in_front, opencv_undistort)
    kornia = (None, None)
    if camera.model == "opencv":
        kornia = _other_errors(camera, pixels, in_front, kornia_undistort)
    wrong = float((errors > MAX_ERROR_PX).sum() / len(pixels))
    return LensRow(name, camera.model, 1 - valid.double().mean().item(), float(errors.max()), wrong, *opencv, *kornia)


def forward_error(camera: Camera, rays: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Return (N,), px, the distance of rays (N, 3) from pixels by OpenCV's formulas; inf instead of NaN."""
    if camera.model == "fisheye":
        radius = np.hypot(rays[:, 0], rays[:, 1])
        theta = np.arctan2(radius, rays[:, 2])
        theta_d = theta * (1 + sum(k * theta ** (2 * i) for i, k in enumerate(camera.coefficients, start=1)))
        scale = np.divide(theta_d, radius, out=np.ones_like(theta_d), where=radius > 0)
        projected = scale[:, None] * rays[:, :2] * [camera.fx, camera.fy] + [camera.cx, camera.cy]
    else:
        vector = np.array(camera.coefficients)
        projected = cv2.projectPoints(rays, _ZERO, _ZERO, np.array(camera.matrix), vector)[0][:, 0]
    return np.nan_to_num(np.linalg.norm(projected - pixels, axis=1), nan=np.inf)


def opencv_undistort(camera: Camera, pixels: Tensor) -> np.ndarray:
    """Undistort pixels to (N, 2), on the plane z = 1, by OpenCV with its defaults."""
    undistort = cv2.fisheye.undistortPoints if camera.model == "fisheye" else cv2.undistortPoints
    return undistort(pixels.numpy()[:, None], np.array(camera.matrix), np.array(camera.coefficients))[:, 0]


def kornia_undistort(camera: Camera, pixels: Tensor) -> np.ndarray:
    """Undistort pixels to (N, 2), on the plane z = 1, by kornia with its defaults."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # kornia imports deprecated modules
        calibration = importlib.import_module("kornia.geometry.calibration")
    matrix, vector = torch.tensor([camera.matrix]).double(), torch.tensor([camera.coefficients]).double()
    return calibration.undistort_points(pixels[None], matrix, vector, torch.eye(3).double()[None])[0].numpy()


def _other_errors(
    camera: Camera, pixels: Tensor, in_front: np.ndarray, undistort: Callable[[Camera, Tensor], np.ndarray]
) -> tuple[float, float]:
    points = undistort(camera, pixels)
    answered = in_front & ~(points == -1e6).all(axis=1)
    rays = np.concatenate([np.nan_to_num(points, nan=1e6), np.ones((len(points), 1))], axis=1)
    errors = forward_error(camera, rays, pixels.numpy())[answered]
    return float(errors.max()), float((errors > MAX_ERROR_PX).sum() / len(pixels))


def write_table(path: Path, rows: Sequence[Mapping[str, Any]], polynomials: Mapping[str, Conversion]) -> None:
    """Write the CSV of `read_lenses`, without share-alike rows."""
    with replace_file(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        writer.writeheader()
        for row in rows:
            if row["id"] in polynomials and "SA" not in row["licence"].split()[0].split("-"):
                writer.writerow(_csv_row(row, polynomials[row["id"]]))


def _csv_row(row: Mapping[str, Any], polynomial: Conversion) -> dict[str, Any]:
    numbers = {name: row[name] for name in ("width", "height", "fx", "fy", "cx", "cy")}
    texts = {name: row[name] or "" for name in ("id", "camera", "lens", "licence")}
    source = f"{row['source_repo']}@{row['commit']}: {row['source_path']}"
    lens = {"model": _MODELS[row["model"]], "coefficients": json.dumps(row["coeffs"])}
    fit = {"polynomial12": "", "residual_px": "", "covered": ""}
    if polynomial.max_px > MAX_ERROR_PX:  # otherwise the polynomial has the same coefficients in another order
        is_close = polynomial.max_px <= _MAX_RESIDUAL_PX and polynomial.covered == 1
        fit["polynomial12"] = json.dumps(polynomial.camera.coefficients) if is_close else ""
        fit |= {"residual_px": f"{polynomial.max_px:.4g}", "covered": f"{polynomial.covered:.4f}"}
    return texts | numbers | lens | fit | {"source": source}


def run_boards(args: argparse.Namespace) -> list[dict[str, Any]]:
    """Measure and print the sets of pictures."""
    print("px rms over corners; OpenCV: its detectors and all views; lines: in the pictures, and rectified")
    print(
        f"{'set':16} {'model':20} views corners  error held-out | OpenCV held-out | four held-out   edge nearest "
        "folded |  lines rectified       fx published planted"
    )
    rows = []
    for kind in ("charuco", "chessboard"):
        entries = json.loads((args.folder / kind / "reference.json").read_text(encoding="utf-8"))
        for name, entry in entries.items():
            if args.sets and name not in args.sets:
                continue
            row = measure_board(name, entry, args.folder / kind / name)
            published = "" if row.published_fx_percent is None else f"{row.published_fx_percent:+.2f} %"
            planted = ", ".join(f"{kind}: {result}" for kind, result in row.planted.items())
            edge, nearest = ("" if px is None else f"{px:.1f}" for px in (row.edge_px, row.nearest_px))
            print(
                f"{name:16} {row.model:20} {row.views:2}/{row.pictures:2} {row.corners:7} {row.error:6.3f} "
                f"{row.held_out:8.3f} | {row.opencv_error:6.3f} {row.opencv_held_out:8.3f} | {row.four_held_out:13.3f} "
                f"{edge:>6} {nearest:>7} {row.folded:6.1%} | {row.lines:6.3f} {row.rectified_lines:9.3f} "
                f"{row.fx:8.1f} {published:>9} {planted}",
                flush=True,
            )
            rows.append(row._asdict())
    return rows


def run_lenses(args: argparse.Namespace) -> list[dict[str, Any]]:
    """Measure and print the inverse and the conversions of each lens."""
    table = json.loads(args.lenses.read_text(encoding="utf-8"))
    cameras = {row["id"]: camera_from_row(row) for row in table if row["fx"] and row["coeffs"]}
    print(f"{len(cameras)} lenses with focal length and coefficients, {len(table) - len(cameras)} rows without")
    print(
        f"{'lens':26} {'model':8} {'invalid':>8} {'ours px':>8} {'wrong':>6} | {'OpenCV px':>9} {'wrong':>6} | "
        f"{'kornia px':>9} {'wrong':>6} | to opencv px, to polynomial12 px"
    )
    rows, polynomials, results = [], dict[str, Conversion](), []
    for name, camera in cameras.items():
        row = measure_lens(name, camera, step=args.step)
        polynomials[name] = convert(camera, to="polynomial12")
        opencv_px = convert(camera, to="opencv", count=max(8, len(camera.coefficients))).max_px
        kornia = f"{row.kornia_px:9.2g} {row.kornia_wrong:6.1%}" if row.kornia_px is not None else " " * 16
        print(
            f"{name:26} {row.model:8} {row.invalid:8.2%} {row.ours_px:8.1e} {row.ours_wrong:6.1%} | "
            f"{row.opencv_px:9.2g} {row.opencv_wrong:6.1%} | {kornia} | {opencv_px:.2g}, {polynomials[name].max_px:.2g}"
        )
        rows.append(row)
        results.append(row._asdict() | {"to_opencv_px": opencv_px, "to_polynomial12_px": polynomials[name].max_px})
    with_kornia = [row for row in rows if row.kornia_px is not None]
    print(
        f"lenses with wrong pixels that are not marked: ours {sum(row.ours_wrong > 0 for row in rows)} and OpenCV "
        f"{sum(row.opencv_wrong > 0 for row in rows)} of {len(rows)}, kornia "
        f"{sum((row.kornia_wrong or 0) > 0 for row in with_kornia)} of {len(with_kornia)}"
    )
    if args.table is not None:
        write_table(args.table, table, polynomials)
    return results


def main() -> None:
    """Run a subcommand, print its table, and write it as JSON if `--out` is given."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    commands = parser.add_subparsers(required=True)
    boards = commands.add_parser("boards", help="calibrate with real pictures")
    boards.add_argument("folder", type=Path, help="with charuco/ and chessboard/")
    boards.add_argument("--sets", nargs="*", help="names of the sets; default: all")
    boards.set_defaults(run=run_boards)
    lenses = commands.add_parser("lenses", help="invert and convert published lenses")
    lenses.add_argument("lenses", type=Path, help="table of lenses, JSON")
    lenses.add_argument("--step", type=int, default=8, help="px between pixels; default: 8")
    lenses.add_argument("--table", type=Path, help="CSV to write")
    lenses.set_defaults(run=run_lenses)
    for command in (boards, lenses):
        command.add_argument("--out", type=Path, help="JSON to write")
    args = parser.parse_args()
    results = args.run(args)
    if args.out is not None:
        write_json(args.out, results)


if __name__ == "__main__":
    main()
