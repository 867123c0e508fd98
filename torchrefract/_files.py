"""Files that are there whole or not at all."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from uuid import uuid4


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A name beside `path` to write to; its file takes the place of `path` if the block succeeds, else it goes.

    Who reads `path` meanwhile finds the old file. The name has the suffix of `path`, since writers pick a format by it.

    Args:
        path: the file to write, in a folder that exists.
    """
    # Not tempfile: its files can be read by their owner only, and so could the result.
    temporary = path.with_name(f".{path.stem}-{uuid4().hex[:8]}{path.suffix}")
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
