"""Messages of running commands: progress, warnings, and the files that they skip."""

import sys
import threading
import time
import warnings
from collections.abc import Iterable, Iterator, Sequence
from itertools import islice
from typing import TypeVar

from rich.console import Console
from rich.progress import track
from torch import nn

from torchrefract._validation import UsageError
from torchrefract.fields.corridor import CorridorDepth

_T = TypeVar("_T")

_MESSAGE_INTERVAL = 10.0  # seconds between two lines of progress outside a terminal


def print_warning(message: str) -> None:
    """Print a warning to the user as one line."""
    print(f"warning: {message}", file=sys.stderr)


def warn_of_assumed_depth(effect: nn.Module, *, option: str = "depth") -> None:
    """Print that a part of the effect assumes the depth of frames, for a command without the option of depth maps.

    It takes the place of the warning of the effect, which names the argument of a function.
    """
    for part in effect.modules():
        source = getattr(getattr(part, "medium", part), "depth", None)
        if isinstance(source, CorridorDepth):
            warnings.filterwarnings("ignore", "depth is that of a road")  # the line below says it once
            print_warning(
                f"{type(part).__name__} assumes the depth of a road between walls; depth maps, as estimate_depth "
                f"writes them, are better: {option}=...; a camera that looks down needs horizon=..., taken as "
                f"{source.horizon:g}"
            )
            return


def progress(items: Iterable[_T], name: str, *, count: int) -> Iterator[_T]:
    """Yield `count` items; show a progress bar in a terminal, and print a line each ten seconds elsewhere."""
    console = Console(stderr=True)
    if console.is_terminal:
        yield from track(items, name, total=count, console=console, transient=True)
        return
    done, finished = 0, threading.Event()

    def report() -> None:
        start = time.monotonic()
        while not finished.wait(_MESSAGE_INTERVAL):
            seconds = time.monotonic() - start
            left = f", about {seconds * (count - done) / done:.0f} s left" if done else ""
            print(f"{name}: {done} of {count}, {seconds:.0f} s{left}", file=sys.stderr, flush=True)

    threading.Thread(target=report, daemon=True).start()
    try:
        for item in items:
            yield item
            done += 1
    finally:
        finished.set()


def batches(items: Iterable[_T], size: int) -> Iterator[list[_T]]:
    """Yield up to `size` items in a row, as itertools.batched of Python 3.12 does."""
    rest = iter(items)
    while batch := list(islice(rest, size)):
        yield batch


class Skipped:
    """The files or frames of an input that a command skips, by the errors that name them."""

    def __init__(self):
        self.errors, self.lost = list[str](), list[str]()  # all, and those of files that vanished

    def add(self, error: str, *, is_lost: bool = False) -> None:
        """Print an error and note it; an exception would keep frames and open files until the end."""
        print(f"skipped: {error}", file=sys.stderr)
        self.errors.append(error)
        self.lost += [error] if is_lost else []

    def summarize(self, verb: str, *, total: int, existing: int, name: str = "input") -> str:
        """Return how many files were converted; raise UsageError if all were skipped.

        Args:
            verb: what the command does to a file, as "restored".
            total: number of files.
            existing: number of those that were converted before.
            name: of the option that gives the input.
        """
        if len(self.errors) == total:
            raise UsageError(f"{name} must hold a file that can be {verb}, got {self.errors[0]}")
        num_made = total - existing - len(self.errors)
        return f"{num_made} {verb}, {existing} already existed, {len(self.errors)} skipped"


def check_none_lost(lost: Sequence[str], *, name: str = "input") -> None:
    """Raise UsageError if files of the input could not be opened, as those that vanish during a run.

    Args:
        lost: the error of each such file.
        name: option that names the input.
    """
    if lost:
        more = f" and {len(lost) - 1} more" if lost[1:] else ""
        raise UsageError(
            f"{name} must stay unchanged during a run, got {lost[0]}{more}; the same command tries them again"
        )
