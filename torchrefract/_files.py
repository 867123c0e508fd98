"""Files that are there whole or not at all."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from uuid import uuid4


@contextmanager
def replacing(path: Path, *, alone: bool = False) -> Iterator[Path]:
    """A name beside `path` to write to; its file takes the place of `path` if the block succeeds, else it goes.

    Who reads `path` meanwhile finds the old file. The name has the suffix of `path`, since writers pick a format by it.

    Args:
        path: the file to write, in a folder that exists.
        alone: no other process writes it meanwhile, so that the name can be the same each time, without that suffix,
            and what a kill has left is written over.
    """
    # Not tempfile: its files can be read by their owner only, and so could the result.
    name = f".{path.name}.part" if alone else f".{path.stem}-{uuid4().hex[:8]}{path.suffix}"
    temporary = path.with_name(name)
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
