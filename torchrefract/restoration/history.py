"""The figures of a run that was stopped, kept for the run that goes on with it."""

import csv
import math
from collections.abc import Iterator
from pathlib import Path

from torchrefract._io import replace_file

METRICS, BEFORE = "metrics.csv", "metrics_before.csv"


def metrics_rows(run: Path) -> Iterator[dict[str, str]]:
    """The rows of metrics of a run folder, those of the runs that it goes on with first."""
    for name in (BEFORE, METRICS):
        if (path := run / name).is_file():
            with path.open(newline="") as file:
                yield from csv.DictReader(file)


def carry_over(stopped: Path, run: Path, *, before_epoch: int) -> None:
    """Write the rows of the folder `stopped`, of the epochs below `before_epoch`, into the folder `run`."""
    kept = [row for row in metrics_rows(stopped) if _epoch(row) < before_epoch]
    names = list(dict.fromkeys(name for row in kept for name in row))
    if not kept:
        return
    with replace_file(run / BEFORE) as path, path.open("w", newline="") as file:
        writer = csv.DictWriter(file, names, restval="")
        writer.writeheader()
        writer.writerows(kept)


def _epoch(row: dict[str, str]) -> float:
    # A row that a kill cut short lacks its last cells, and counts for no epoch.
    whole = None not in row.values() and row.get("epoch", "").isdigit()
    return int(row["epoch"]) if whole else math.inf
