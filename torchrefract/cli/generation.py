"""How far a long run is: a line that moves where somebody watches, one a minute where nobody does."""

import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from typing import TypeVar

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

_T = TypeVar("_T")
_PAUSE = 60.0  # seconds between lines


def watched(parts: Iterable[Sequence[_T]], *, total: int) -> Iterator[Sequence[_T]]:
    """The parts of so many pairs in all, with the rate and the time that is left."""
    console = Console(stderr=True)
    start = said = time.monotonic()
    done = 0
    columns = (BarColumn(), MofNCompleteColumn(), TextColumn("pairs, {task.fields[rate]}"), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as line:
        task = line.add_task("", total=total, rate="")
        for part in parts:
            yield part
            done += len(part)
            now = time.monotonic()
            rate = done / max(now - start, 1e-9)
            line.update(task, completed=done, rate=f"{rate:.3g} a second")
            if now - said > _PAUSE and not console.is_terminal:
                said = now
                left = (total - done) / rate / 60
                print(f"{done} of {total} pairs, {rate:.3g} a second, {left:.0f} min left", file=sys.stderr, flush=True)
