"""A database of real lenses: published calibrations, each with its source."""

import csv
import json
from pathlib import Path
from typing import NamedTuple

from torchrefract.cameras.camera import Camera

COLUMNS = (
    *("id", "camera", "lens", "model", "width", "height", "fx", "fy", "cx", "cy", "coefficients"),
    *("polynomial12", "residual_px", "covered", "source", "licence"),
)
_PACKAGED = Path(__file__).with_name("lenses.csv")


class Lens(NamedTuple):
    """A row of the database."""

    name: str  # unique
    title: str  # camera and lens
    camera: Camera  # as published
    polynomial: Camera | None  # the camera converted to "polynomial12"; None if no polynomial comes close
    residual_px: float  # largest distance between the two over the frame, or of the closest polynomial if it is None
    source: str  # repository and file that the numbers come from
    licence: str  # stated by the source


def read_lenses(path: str | Path | None = None) -> tuple[Lens, ...]:
    """Read a CSV of lenses with the columns `COLUMNS`.

    Args:
        path: of the CSV; None reads the one of the package, with dashcams, phones, action, car and robot cameras.

    Raises:
        ValueError: the file has no such columns or no rows, or a row has an invalid value.
    """
    path = _PACKAGED if path is None else Path(path)
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
    try:
        camera = _camera(row, row["model"], row["coefficients"])
        polynomial = None
        if row["polynomial12"]:
            polynomial = _camera(row, "polynomial12", row["polynomial12"])
        elif row["model"] == "polynomial12" or not row["residual_px"]:  # the same numbers in another order, not a fit
            polynomial = _camera(row, "polynomial12", json.dumps(camera.polynomial()))
        residual = float(row["residual_px"] or 0.0)
        if not residual >= 0:
            raise ValueError(f"residual_px must be at least 0, got {residual}")
    except (TypeError, ValueError, OverflowError, RecursionError) as error:  # json raises the last for deep nesting
        raise ValueError(f"path must hold lenses, got {path} with the row {row['id']}: {str(error)[:400]}") from error
    title = " ".join(filter(None, (row["camera"], row["lens"])))
    return Lens(row["id"], title, camera, polynomial, residual, row["source"], row["licence"])


def _camera(row: dict[str, str], model: str, coefficients: str) -> Camera:
    fx, fy, cx, cy = (float(row[name]) for name in ("fx", "fy", "cx", "cy"))
    numbers = tuple(json.loads(coefficients))
    width, height = int(row["width"]), int(row["height"])
    return Camera(width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy, coefficients=numbers, model=model)
