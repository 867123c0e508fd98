"""A Parquet table of the pairs of a set, for queries by pandas, DuckDB and the like."""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from torchrefract._io import replace_file
from torchrefract.data.pairs.manifest import PairRow

TABLE = "pairs.parquet"
_BATCH = 10_000  # rows that are Python objects at a time


class PairTable:
    """Collects the rows of a set: one for each pair, with a column for each quantity that an effect draws.

    Args:
        settings: in config.json of the set.
    """

    def __init__(self, settings: Mapping[str, Any]):
        self._severity = settings["scene"].get("severity")
        self._rows, self._tables = list[dict[str, Any]](), list[pa.Table]()

    def collect(self, rows: Iterable[PairRow]) -> Iterator[PairRow]:
        """Yield rows of a manifest, and add those that have a pair to the table."""
        for row in rows:
            if not row.skipped:
                self._rows.append(self._columns(row))
            if len(self._rows) == _BATCH:
                self._flush()
            yield row

    def write(self, out: Path) -> None:
        """Write the table into the folder of the set, sorted by number; several shards may do so at the same time."""
        self._flush()
        table = pa.concat_tables(self._tables, promote_options="permissive").sort_by("number")
        drawn = sorted(name for name in table.column_names if "." in name)
        table = table.select([name for name in table.column_names if "." not in name] + drawn)
        # PyArrow would take a relative path with a colon for an address.
        with replace_file(out / TABLE) as temporary, temporary.open("wb") as stream:
            pq.write_table(table, stream, row_group_size=_BATCH)

    def _flush(self) -> None:
        if self._rows:
            names = dict.fromkeys(name for row in self._rows for name in row)
            self._tables.append(pa.table({name: [row.get(name) for row in self._rows] for name in names}))
            self._rows = []

    def _columns(self, row: PairRow) -> dict[str, Any]:
        path = next(iter(row.files.values())).path
        values = {
            "number": row.number,
            "name": row.name,
            "key": row.key,
            "seed": row.seed,
            "source": row.source,
            "frame": row.frame,
            "drive": row.drive,
            "split": row.split,
            "scene": row.scene,
            "severity": self._severity,
            "height": row.height,
            "width": row.width,
            "effects": [str(effect["effect"]) for effect in row.effects],
            "path": path if path.endswith(".tar") else path.partition(".")[0],
            "bytes": sum(file.bytes for file in row.files.values()),
        }
        seen = Counter[str]()
        for effect in row.effects:
            name = str(effect["effect"])
            seen[name] += 1
            prefix = name if seen[name] == 1 else f"{name}{seen[name]}"
            values |= {f"{prefix}.{key}": _number(value) for key, value in effect.items() if key != "effect"}
        return values


def _number(value: Any) -> Any:
    """Return the numbers of a parameter; a manifest has words for infinite ones, because JSON has none."""
    if isinstance(value, list):
        return [_number(item) for item in value]
    return float(value) if isinstance(value, str) else value
