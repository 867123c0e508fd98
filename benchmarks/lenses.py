"""The inverse of every lens of a table over its whole frame, here and by OpenCV and kornia as they come; conversions.

python benchmarks/lenses.py LENSES.json [--step PX] [--out RESULTS.json] [--table LENSES.csv]

The table is a JSON list of rows with id, camera, lens, model (opencv5, rational8, thin-prism12, fisheye4), width,
height, fx, fy, cx, cy, coeffs, source_repo, source_path, commit and licence; rows without focal length or coefficients
are counted and left out. `--table` writes those of them that are not share-alike as the CSV that the package ships.
"""

import argparse
import csv
import importlib
import json
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from timing import Conditions, count
from torch import Tensor
from torchrefract.cameras.lens_table import COLUMNS

from torchrefract import Camera
from torchrefract._io import replace_file
from torchrefract.cameras.conversion import Conversion, convert

WHAT = (
    "Rays of all pixels of a frame that are a step apart, put into OpenCV's forward formula again: px from the pixel. "
    "'wrong' is the share of the pixels that are off by more than 1e-6 px and not marked: here by `valid`, in OpenCV's "
    "fisheye by -1e6. OpenCV and kornia run with their defaults; kornia has no fisheye inverse. Past 85 degrees from "
    "its axis a fisheye has no plane z = 1 that they could answer on: such pixels count for us alone."
)
BAR_PX = 1e-6
TARGETS = ("opencv", "polynomial12")
_MODELS = {"opencv5": "opencv", "rational8": "opencv", "thin-prism12": "opencv", "fisheye4": "fisheye"}
_KEPT_PX = 1.0  # a polynomial that is farther from its lens is not written into the table
_OPENCV_MARK = -1e6
_ZERO = np.zeros(3)


@dataclass(frozen=True)
class Row:
    """A lens, and what each inverse of it is worth; px."""

    name: str
    model: str
    pixels: int
    invalid: float  # share of the frame that we mark
    largest_px: float  # of ours, where valid
    wrong: float  # share of the frame: ours, wrong and not marked
    opencv_px: float
    opencv_wrong: float
    kornia_px: float | None
    kornia_wrong: float | None


def main() -> None:
    """Print the tables and write them as JSON."""
    args = _arguments()
    rows = json.loads(args.lenses.read_text(encoding="utf-8"))
    cameras = {row["id"]: camera_of(row) for row in rows if row["fx"] and row["coeffs"]}
    print(WHAT)
    print(f"\n{len(cameras)} lenses with focal length and coefficients, {len(rows) - len(cameras)} rows without")
    inverses = [inverse_row(name, camera, step=args.step) for name, camera in cameras.items()]
    print(inverse_table(inverses))
    made = {
        name: {to: convert(camera, to=to) for to in TARGETS if to != camera.model} for name, camera in cameras.items()
    }
    print(conversion_table(made))
    args.out.parent.mkdir(parents=True, exist_ok=True)
    content = {
        "what": WHAT,
        "conditions": asdict(Conditions.now(torch.empty(1), threads=torch.get_num_threads(), repeats=1)),
        "step": args.step,
        "inverses": [asdict(row) for row in inverses],
        "conversions": {name: {to: _told(one) for to, one in to_all.items()} for name, to_all in made.items()},
    }
    with replace_file(args.out) as temporary:
        temporary.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
    print(f"\nwritten to {args.out}")
    if args.table is not None:
        write_table(args.table, rows, made)
        print(f"table written to {args.table}")


def camera_of(row: Mapping[str, Any]) -> Camera:
    """The camera of a row."""
    return Camera(
        width=int(row["width"]),
        height=int(row["height"]),
        fx=float(row["fx"]),
        fy=float(row["fy"]),
        cx=float(row["cx"]),
        cy=float(row["cy"]),
        coefficients=tuple(row["coeffs"]),
        model=_MODELS[row["model"]],
    )


def inverse_row(name: str, camera: Camera, *, step: int) -> Row:
    """What three inverses make of the pixels of a frame."""
    pixels = lattice(camera, step)
    rays, valid, _ = camera.unproject(pixels)
    ours = forward_error(camera, rays.numpy(), pixels.numpy())[valid.numpy()]
    on_plane = ~valid.numpy() | (rays[:, 2] > np.cos(np.radians(85))).numpy()
    theirs = _share(camera, pixels, on_plane, opencv_default)
    kornias = _share(camera, pixels, on_plane, kornia_default) if camera.model == "opencv" else (None, None)
    return Row(
        name,
        camera.model,
        len(pixels),
        1 - valid.double().mean().item(),
        float(ours.max()),
        float((ours > BAR_PX).sum() / len(pixels)),
        *theirs,
        *kornias,
    )


def lattice(camera: Camera, step: int) -> Tensor:
    """(N, 2), px, float64: pixels a step apart, and those of the last row and column."""
    axes = []
    for size in (camera.width, camera.height):
        axis = torch.arange(0, size, step, dtype=torch.float64)
        axes.append(torch.cat([axis, axis.new_tensor([size - 1])]).unique())
    return torch.cartesian_prod(*axes)


def forward_error(camera: Camera, rays: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """(N,), px: how far rays (N, 3) land from pixels, by OpenCV's formulas; inf where that is no number."""
    if camera.model == "fisheye":
        radius = np.hypot(rays[:, 0], rays[:, 1])
        theta = np.arctan2(radius, rays[:, 2])
        bent = theta * (1 + sum(k * theta ** (2 * i) for i, k in enumerate(camera.coefficients, start=1)))
        scale = np.divide(bent, radius, out=np.ones_like(bent), where=radius > 0)
        seen = scale[:, None] * rays[:, :2] * [camera.fx, camera.fy] + [camera.cx, camera.cy]
    else:
        vector = np.array(camera.coefficients)
        seen = cv2.projectPoints(rays, _ZERO, _ZERO, np.array(camera.matrix), vector)[0][:, 0]
    return np.nan_to_num(np.linalg.norm(seen - pixels, axis=1), nan=np.inf)


def opencv_default(camera: Camera, pixels: Tensor) -> np.ndarray:
    """(N, 2), on the plane z = 1, by OpenCV's inverse as it comes."""
    numbers = np.array(camera.matrix), np.array(camera.coefficients)
    undistort = cv2.fisheye.undistortPoints if camera.model == "fisheye" else cv2.undistortPoints
    return undistort(pixels.numpy()[:, None], *numbers)[:, 0]


def kornia_default(camera: Camera, pixels: Tensor) -> np.ndarray:
    """(N, 2), on the plane z = 1, by kornia's inverse as it comes."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of what kornia imports
        calibration = importlib.import_module("kornia.geometry.calibration")

    matrix, vector = torch.tensor([camera.matrix]).double(), torch.tensor([camera.coefficients]).double()
    return calibration.undistort_points(pixels[None], matrix, vector, torch.eye(3).double()[None])[0].numpy()


def _share(
    camera: Camera, pixels: Tensor, on_plane: np.ndarray, inverse: Callable[[Camera, Tensor], np.ndarray]
) -> tuple[float, float]:
    """The largest error of an inverse, px, and the share of the pixels where it is above the bar."""
    points = inverse(camera, pixels)
    # OpenCV's fisheye has a mark too.
    answered = on_plane & ~(points == _OPENCV_MARK).all(axis=1)
    rays = np.concatenate([np.nan_to_num(points, nan=1e6), np.ones((len(points), 1))], axis=1)
    error = forward_error(camera, rays, pixels.numpy())[answered]
    return float(error.max()), float((error > BAR_PX).sum() / len(pixels))


def inverse_table(rows: Sequence[Row]) -> str:
    """One line a lens, the sums below."""
    lines = [
        f"\n{'lens':26} {'model':8} {'invalid':>8} {'px':>8} {'wrong':>6} | {'OpenCV px':>9} {'wrong':>6} | kornia"
    ]
    for row in rows:
        kornia = "" if row.kornia_px is None else f"{row.kornia_px:9.2g} {row.kornia_wrong:6.1%}"
        lines.append(
            f"{row.name:26} {row.model:8} {row.invalid:8.2%} {row.largest_px:8.1e} {row.wrong:6.1%} | "
            f"{row.opencv_px:9.2g} {row.opencv_wrong:6.1%} | {kornia}"
        )
    both = [row for row in rows if row.kornia_px is not None]
    lines.append(
        f"of {len(rows)} lenses wrong somewhere and not marked: {sum(row.wrong > 0 for row in rows)} here, "
        f"{sum(row.opencv_wrong > 0 for row in rows)} by OpenCV; of {len(both)} by kornia "
        f"{sum((row.kornia_wrong or 0) > 0 for row in both)}"
    )
    return "\n".join(lines)


def conversion_table(made: Mapping[str, Mapping[str, Conversion]]) -> str:
    """One line a lens: to each model the largest and the rms distance over the frame, px, and the share covered."""
    lines = [f"\n{'lens':26}" + "".join(f" | {'to ' + to + ' px':>21} {'rms':>8} covered" for to in TARGETS)]
    for name, to_all in made.items():
        cells = [to_all.get(to) for to in TARGETS]
        told = (f" | {c.max_px:21.2g} {c.rms_px:8.1g} {c.covered:7.1%}" if c else f" | {'':38}" for c in cells)
        lines.append(f"{name:26}" + "".join(told))
    return "\n".join(lines)


def write_table(path: Path, rows: Sequence[Mapping[str, Any]], made: Mapping[str, Mapping[str, Conversion]]) -> None:
    """The CSV of `read_lenses`, without the rows that are share-alike."""
    with replace_file(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        writer.writeheader()
        for row in rows:
            if row["id"] in made and "SA" not in row["licence"].split()[0].split("-"):
                writer.writerow(_csv_row(row, made[row["id"]]["polynomial12"]))


def _csv_row(row: Mapping[str, Any], near: Conversion) -> dict[str, Any]:
    numbers = {name: row[name] for name in ("width", "height", "fx", "fy", "cx", "cy")}
    words = {name: row[name] or "" for name in ("id", "camera", "lens", "licence")}
    source = f"{row['source_repo']}@{row['commit']}: {row['source_path']}"
    lens = {"model": _MODELS[row["model"]], "coefficients": json.dumps(row["coeffs"])}
    fit = {"polynomial12": "", "residual_px": "", "covered": ""}
    # What is only put in another order needs no second set of numbers.
    if near.max_px > BAR_PX:
        kept = near.max_px <= _KEPT_PX and near.covered == 1
        fit["polynomial12"] = json.dumps(near.camera.coefficients) if kept else ""
        fit |= {"residual_px": f"{near.max_px:.4g}", "covered": f"{near.covered:.4f}"}
    return words | numbers | lens | fit | {"source": source}


def _told(conversion: Conversion) -> dict[str, Any]:
    return {name: value for name, value in conversion._asdict().items() if name != "camera"} | {
        "coefficients": conversion.camera.coefficients
    }


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("lenses", type=Path, help="the table, JSON")
    parser.add_argument("--step", type=count(1), default=8, help="px between pixels, 8")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results" / "lenses.json", help="the JSON")
    parser.add_argument("--table", type=Path, help="the CSV to write")
    return parser.parse_args()


if __name__ == "__main__":
    main()
