"""Files in object stores: their bytes, and writing that fails."""

import hashlib
import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from fsspec.implementations.memory import MemoryFileSystem

from torchrefract._io import as_path


def digests(folder: str | Path) -> dict[str, str]:
    """Return the checksum of each file of a folder, on disk or in a store, hidden ones included."""
    path: Any = as_path(folder)
    if isinstance(folder, Path):
        files = {file.relative_to(path).as_posix(): file.read_bytes() for file in path.rglob("*") if file.is_file()}
    else:
        files = {name.split(path.path)[1].lstrip("/"): path.fs.cat_file(name) for name in path.fs.find(path.path)}
    return {name: hashlib.sha256(data).hexdigest() for name, data in sorted(files.items())}


@contextmanager
def failing_writes(error: BaseException, *, suffix: str = "", times: float = math.inf) -> Iterator[list[str]]:
    """Let the first writes to memory:// of names with a suffix fail; yield the names, to which those are added."""
    put, failed = MemoryFileSystem.put_file, list[str]()

    def put_or_fail(self: Any, source: str, target: str, **more: Any) -> None:
        if target.endswith(suffix) and len(failed) < times:
            failed.append(target)
            raise error
        put(self, source, target, **more)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(MemoryFileSystem, "put_file", put_or_fail)
        yield failed
