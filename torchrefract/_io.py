"""Paths on this machine and in object stores, atomic file writes, and the folder of the configuration files."""

import csv
import errno
import hashlib
import io
import logging
import os
import re
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from fnmatch import fnmatchcase
from functools import partial
from pathlib import Path
from typing import Any, TypeVar, cast
from uuid import uuid4

_T = TypeVar("_T")

_PAUSES = (1.0, 4.0, 16.0)  # seconds, before each further try of a store

_ONE_SLASH = re.compile(r"((?:s3a?|gs|gcs|az|abfss?|hf|https?|memory|file):)/(?!/)", re.IGNORECASE)

_PACKAGE = Path(__file__).parent
# A wheel carries conf/ inside the package; a checkout and an editable install have it beside the package.
CONFIG_DIR = str(next((d for d in (_PACKAGE / "conf", _PACKAGE.parent / "conf") if d.is_dir()), _PACKAGE / "conf"))


def config_names(group: str) -> list[str]:
    """Return the names of the configuration files of a group, sorted."""
    return sorted(path.stem for path in Path(CONFIG_DIR, group).glob("*.yaml"))


def as_path(text: str | Path) -> Path:
    """Return the path of a file or folder: of an address such as s3://bucket/folder, one with pathlib's methods.

    Addresses are those of fsspec; its package for the kind of store must be installed, as s3fs for s3://.

    Raises:
        ValueError: fsspec has no such kind of address, or lacks its package, or the address has one slash alone.
    """
    if isinstance(text, str) and (match := _ONE_SLASH.match(text)):
        raise ValueError(
            f"an address must have two slashes behind its scheme, got {text}; write {match[1]}//{text[match.end() :]}"
        )
    if isinstance(text, Path) or is_remote(text) or "://" not in text:
        return Path(text).expanduser() if isinstance(text, str) else text
    from upath import UPath  # noqa: PLC0415  # only the extra "train" has it

    logging.getLogger("fsspec").setLevel(logging.WARNING)  # it notes each file that gcsfs opens
    try:
        # Other machines write to the same folder, so a listing must not be remembered.
        path = UPath(text, use_listings_cache=False)
        is_local = "file" in path.fs.protocol
    except ImportError as error:
        raise ValueError(f"{text} needs another package: {error} (pip install 'torchrefract[remote]')") from error
    except ValueError as error:
        raise ValueError(f"a path must be one on this machine or an address of fsspec, got {text} ({error})") from error
    return Path(path.path) if is_local else cast(Path, path)


def is_remote(path: Any) -> bool:
    """Return True if a path of `as_path` lies in a store of fsspec."""
    return bool(getattr(path, "protocol", ""))


def store_of(path: Path) -> Any:
    """Return the file system of a path in a store; a forked process, as a worker of a DataLoader, gets a new one."""
    store = cast(Any, path)
    if getattr(store.fs, "_pid", None) in (None, os.getpid()):
        return store.fs
    return type(store.fs)(**store.storage_options)  # fsspec keeps one in each process


def retried(call: Callable[[], _T], path: Path) -> _T:
    """Call a function that uses a store; wait and try again, three times at most, if it fails for another reason than
    a missing file or permission.

    Raises:
        FileNotFoundError, PermissionError, OSError: with number, reason and path, whatever the store raises.
    """
    for pause in (*_PAUSES, None):
        try:
            return call()
        except FileNotFoundError as error:
            raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), str(path)) from error
        except PermissionError as error:
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path)) from error
        except Exception as error:  # stores have errors of their own for lost connections
            reason = getattr(error, "strerror", None) or " ".join(str(error).split()) or type(error).__name__
            if pause is None:
                raise OSError(errno.EIO, f"{reason}, after {len(_PAUSES) + 1} tries", str(path)) from error
            print(f"{path}: {reason}; trying again in {pause:.0f} s", file=sys.stderr, flush=True)
            time.sleep(pause)
    raise AssertionError("the last try returns or raises")


def read_bytes(path: Path) -> bytes:
    """Read a file on this machine or in a store; errors are those of `retried`."""
    if not is_remote(path):
        return path.read_bytes()
    return retried(lambda: store_of(path).cat_file(cast(Any, path).path), path)


def file_digest(path: Path) -> str:
    """Return the SHA-256 digest of a file on this machine."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def matching_files(folder: Path, pattern: str) -> list[Path]:
    """Return the files of a folder whose names match a pattern, sorted; stores would take the folder's for one, too."""
    try:
        return sorted(path for path in folder.iterdir() if fnmatchcase(path.name, pattern))
    except (FileNotFoundError, NotADirectoryError):  # a store has no empty folders
        return []


def sizes_in_store(root: Path) -> dict[str, int]:
    """Return the size of each file of a folder in a store by its name relative to it, without hidden files."""
    start, sizes = cast(Any, root).path.rstrip("/"), dict[str, int]()
    folders = [start]
    while folders:  # fsspec's `walk` leaves out a folder whose listing fails, in silence
        folder = folders.pop()
        for info in retried(partial(store_of(root).ls, folder, detail=True), root):
            path = info["name"].rstrip("/")
            name = path[len(start) :].lstrip("/")
            if path == folder or "/." in f"/{name}":  # some stores list a folder in itself
                continue
            if info["type"] == "directory":
                folders.append(path)
            else:
                sizes[name] = info["size"]
    return sizes


def relative_name(path: Path, root: Path) -> str:
    """Return the name of a file in a folder, with forward slashes."""
    if is_remote(path):  # `relative_to` takes a millisecond there
        return str(path)[len(str(root).rstrip("/")) :].lstrip("/")
    return path.relative_to(root).as_posix()


def remove_file(path: Path) -> None:
    """Remove a file; in a store, `unlink` would take brackets in its name for a pattern."""
    retried(lambda: store_of(path).rm_file(cast(Any, path).path), path) if is_remote(path) else path.unlink()


@contextmanager
def local_file(path: Path) -> Iterator[Path]:
    """Yield a path on this machine with the content of a file, which is copied from a store by `retried`."""
    if not is_remote(path):
        yield path
        return
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder, path.name)
        retried(lambda: store_of(path).get_file(cast(Any, path).path, str(copy)), path)
        yield copy


def make_folder(path: Path) -> None:
    """Create a folder with its parents; stores have none. Raises NotADirectoryError if a file has its name."""
    if is_remote(path):
        return
    try:
        path.mkdir(parents=True, exist_ok=True)
    except FileExistsError as error:
        raise NotADirectoryError(errno.ENOTDIR, os.strerror(errno.ENOTDIR), str(path)) from error


def make_writable_folder(path: Path) -> None:
    """Create a folder of this machine with its parents; raise OSError if no file can be created in it."""
    make_folder(path)
    try:
        tempfile.TemporaryFile(dir=path).close()
    except OSError as error:
        error.filename = str(path)  # not of the temporary file
        raise


@contextmanager
def replace_file(path: Path, *, alone: bool = False) -> Iterator[Path]:
    """Yield a temporary path; move it to `path` if the block succeeds, otherwise delete it.

    Readers of `path` find the old file until the move. For a path in a store, the temporary file lies on this machine
    and is uploaded by `retried`. The temporary name keeps the suffix of `path`, because writers choose a format by it.

    Args:
        path: the file to write, in an existing folder.
        alone: True if no other process writes the same file. The temporary name is then fixed, so that the next run
            overwrites what a killed one left.
    """
    if is_remote(path):
        with tempfile.TemporaryDirectory() as folder:
            yield (temporary := Path(folder, path.name))
            retried(lambda: store_of(path).put_file(str(temporary), cast(Any, path).path), path)
        return
    # tempfile creates files that only their owner can read. A digest is no longer than a long name may be.
    unique = hashlib.sha256(os.fsencode(path.name)).hexdigest()[:32] if alone else uuid4().hex
    temporary = path.with_name(f".{unique}{path.suffix}")
    try:
        yield temporary
        os.replace(temporary, path)
    except OSError as error:
        if error.filename in (None, str(temporary)):  # that of a full disk names no file
            error.filename = str(path)
        raise
    finally:
        temporary.unlink(missing_ok=True)


def write_file(path: Path, content: str | bytes, *, alone: bool = False) -> None:
    """Replace a file by a text in UTF-8, with bytes of names that are no Unicode escaped, or by bytes.

    See `replace_file`.
    """
    with replace_file(path, alone=alone) as temporary:
        if isinstance(content, str):
            temporary.write_text(content, encoding="utf-8", errors="backslashreplace")
        else:
            temporary.write_bytes(content)


def write_csv(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Replace a file by a table with a column for each name in a row; see `replace_file`."""
    names = dict.fromkeys(name for row in rows for name in row)
    with replace_file(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(names), restval="")
        writer.writeheader()
        writer.writerows(rows)


def write_figure(path: Path, figure: Any, *, dpi: float | None = None) -> None:
    """Replace a file by a figure of matplotlib, whose errors of a full disk would not say so; see `replace_file`."""
    stream = io.BytesIO()
    figure.savefig(stream, format=path.suffix[1:], dpi=dpi or "figure")
    write_file(path, stream.getvalue())
