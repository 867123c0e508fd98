"""Addresses of object stores as options of the commands, and one line for errors of disks and stores."""

import errno
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from torchrefract._validation import UsageError

_REMOTE_OUTPUT = re.compile(r"\+*(out|run_dir|hydra\.(?:run|sweep)\.dir)=['\"]?([A-Za-z][\w+.-]*://.*?)['\"]?$")
_REMOTE_INPUT = re.compile(r"(input|source|images?|labels|depth|camera|base)=['\"]?([A-Za-z][\w+.-]*://.*?)['\"]?$")
_REMOTE_OPTIONS = {
    "generate": ("source", "out", "depth"),
    "degrade": ("source", "out", "depth"),
    "estimate_depth": ("source", "out"),
    "merge": ("out",),
    "train": ("run_dir",),
    "eval": ("run_dir",),
}
_DISK_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


def check_addresses(name: str, arguments: list[str]) -> None:
    """Raise UsageError if an option is an address, of which pathlib would make a path in a folder such as "s3:".

    Those of `_REMOTE_OPTIONS` may be addresses.
    """
    allowed = _REMOTE_OPTIONS.get(name, ())
    for argument in arguments:
        if (match := _REMOTE_OUTPUT.match(argument)) and match[1] not in allowed:
            raise UsageError(
                f"{match[1]} must be a path on this machine, got {match[2]}; write to a folder and copy it, or mount "
                "the storage"
            )
        if (match := _REMOTE_INPUT.match(argument)) and match[1] not in allowed:
            raise UsageError(
                f"{match[1]} must be a path on this machine, got {match[2]}; copy it to a folder, or mount the storage"
            )


def check_memory(workers: int, **paths: Path) -> None:
    """Raise UsageError if processes would share a path in memory://, by the name of its option."""
    for name, path in paths.items():
        if workers and "memory" in getattr(path, "protocol", ""):
            raise UsageError(f"workers must be 0 for {name}={path}, because each process has its memory, got {workers}")


@contextmanager
def disk_errors(out: Path) -> Iterator[None]:
    """Turn errors of the disk into messages for the user; files that are written stay."""
    try:
        yield
    except OSError as error:
        if error.errno in _DISK_FULL:
            raise UsageError(
                f"out must have enough space, got {os.strerror(error.errno).lower()} for {error.filename or out}; "
                "existing files are complete, and the same command continues"
            ) from error
        raise UsageError(
            f"out must be a folder that can be written to, got {out} ({error.strerror or error})"
        ) from error
    except KeyboardInterrupt:
        print("stopped; the same command continues")
        raise SystemExit(130) from None
