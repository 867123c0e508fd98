"""Atomic file writes, and the folder of the configuration files."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from uuid import uuid4

_PACKAGE = Path(__file__).parent
# A wheel carries conf/ inside the package; a checkout and an editable install have it beside the package.
CONFIG_DIR = str(next((d for d in (_PACKAGE / "conf", _PACKAGE.parent / "conf") if d.is_dir()), _PACKAGE / "conf"))


@contextmanager
def replace_file(path: Path, *, alone: bool = False) -> Iterator[Path]:
    """Yield a temporary path; move it to `path` if the block succeeds, otherwise delete it.

    Readers of `path` find the old file until the move. The temporary name keeps the suffix of `path`, because writers
    choose a format by it.

    Args:
        path: the file to write, in an existing folder.
        alone: True if no other process writes the same file. The temporary name is then fixed, so that the next run
            overwrites what a killed one left.
    """
    # tempfile creates files that only their owner can read.
    name = f".{path.stem}.part{path.suffix}" if alone else f".{path.stem}-{uuid4().hex[:8]}{path.suffix}"
    temporary = path.with_name(name)
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
