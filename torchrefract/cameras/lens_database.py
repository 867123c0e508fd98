"""A table of real lenses: numbers that others have published, each with its source."""

import csv
import json
from pathlib import Path
from typing import NamedTuple

from torchrefract.cameras.camera import Camera

COLUMNS = (
    *("id", "camera", "lens", "model", "width", "height", "fx", "fy", "cx", "cy", "coefficients"),
    *("polynomial12", "residual_px", "covered", "source", "licence"),
)
_SHIPPED = Path(__file__).with_name("lenses.csv")


class Lens(NamedTuple):
    """A row of the table.

    name: of the row.
    title: camera and lens, in words.
    camera: as it was published.
    polynomial: the same in "polynomial12", where one comes near to it.
    residual_px: how far apart the two show a ray of the frame at most, px; of the nearest where `polynomial` is None.
    source: the repository and the file in it that the numbers are from.
    licence: that the source states.
    """

    name: str
    title: str
    camera: Camera
    polynomial: Camera | None
    residual_px: float
    source: str
    licence: str


def read_lenses(path: str | Path | None = None) -> tuple[Lens, ...]:
    """The lenses of a table, a CSV with the columns `COLUMNS`.

    Args:
        path: of the table; None is the one of the package, with dashcams, phones, action, car and robot cameras.

    Raises:
        ValueError: a table without these columns or without rows; a row that is no lens, NaN included.
    """
    path = _SHIPPED if path is None else Path(path)
    try:
        with path.open(newline="", encoding="utf-8") as file:
            reader = csv.DictReader(file)
            missing = [name for name in COLUMNS if name not in (reader.fieldnames or ())]
            if missing:
                raise ValueError(f"path must hold the columns {', '.join(COLUMNS)}, got {path} without {missing[0]}")
            lenses = tuple(_lens(path, row) for row in reader)
    except (csv.Error, UnicodeDecodeError) as error:
        raise ValueError(f"path must hold a table as CSV in UTF-8, got {path}: {error}") from error
    if not lenses:
        raise ValueError(f"path must hold lenses, got {path} without rows")
    return lenses


def _lens(path: Path, row: dict[str, str]) -> Lens:
    title = " ".join(filter(None, (row["camera"], row["lens"])))
    try:
        camera = _camera(row, row["model"], row["coefficients"])
        near = row["model"] == "polynomial12" or not row["residual_px"]
        # What is no fit is another order of the same numbers.
        polynomial = _camera(row, "polynomial12", json.dumps(camera.polynomial())) if near else None
        if row["polynomial12"]:
            polynomial = _camera(row, "polynomial12", row["polynomial12"])
        residual = float(row["residual_px"] or 0.0)
        if not residual >= 0:
            raise ValueError(f"residual_px must be at least 0, got {residual}")
    except (TypeError, ValueError, OverflowError, RecursionError) as error:  # the last of lists in lists
        raise ValueError(f"path must hold lenses, got {path} with the row {row['id']}: {str(error)[:400]}") from error
    return Lens(row["id"], title, camera, polynomial, residual, row["source"], row["licence"])


def _camera(row: dict[str, str], model: str, coefficients: str) -> Camera:
    fx, fy, cx, cy = (float(row[name]) for name in ("fx", "fy", "cx", "cy"))
    numbers = tuple(json.loads(coefficients))
    width, height = int(row["width"]), int(row["height"])
    return Camera(width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy, coefficients=numbers, model=model)
