"""Output folders: a folder belongs to one configuration, which config.json in it states."""

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from torchrefract._io import replace_file
from torchrefract._validation import UsageError

_CONFIG = "config.json"
_SHOWN = 6  # differences in a message


def claim(out: Path, settings: Mapping[str, Any], *, count: int, about: Mapping[str, Any]) -> dict[str, Any]:
    """Create an output folder, or check that it has the same settings, and write its config.json.

    Args:
        out: the folder.
        settings: everything that determines the content, of types that JSON has.
        count: number of results; a later run may raise it.
        about: further entries of config.json that do not change the content.

    Returns:
        the previous content of config.json; empty for a new folder.

    Raises:
        UsageError: the folder has other settings or other content, or `count` is lower than before.
        OSError: the folder cannot be written.
    """
    out.mkdir(parents=True, exist_ok=True)
    new = json.loads(json.dumps(settings))
    path, previous = out / _CONFIG, {}
    # List the folder before testing for config.json, because another shard may be writing to it.
    others = sorted(file.name for file in out.iterdir() if not file.name.startswith("."))
    if path.is_file():
        previous = _read(path)
        _check_same(previous.get("settings", {}), new, out)
        if count < previous.get("count", 0):
            raise UsageError(f"count must be at least that of the pairs in {out}, {previous['count']}, got {count}")
    elif others:
        raise UsageError(f"out must be a new folder or one of this command, got {out}, which holds {others[0]}")
    document = {"settings": new, "count": count, **about}
    if document != previous:
        with replace_file(path) as temporary:
            temporary.write_text(json.dumps(document, indent=2) + "\n", encoding="utf-8")
    return previous


def _read(path: Path) -> dict[str, Any]:
    try:
        document = json.loads(path.read_bytes())
    except ValueError:
        document = None
    if not isinstance(document, dict):
        raise UsageError(f"out must be a folder with a valid {path.name}, got {path}, which is damaged")
    return document


def _check_same(previous: Any, new: Any, out: Path) -> None:
    before, after = dict(_flatten(previous)), dict(_flatten(new))
    different = [name for name in before | after if before.get(name) != after.get(name)]
    if different:
        shown = [f"{name} is {before.get(name)} there and {after.get(name)} here" for name in different[:_SHOWN]]
        more = f", and {len(different) - _SHOWN} more" if len(different) > _SHOWN else ""
        raise UsageError(
            f"out must be a folder of the same configuration, got {out}, where {', '.join(shown)}{more}; choose "
            "another folder"
        )


def _flatten(value: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    if isinstance(value, Mapping):
        for name, part in value.items():
            yield from _flatten(part, f"{prefix}.{name}" if prefix else str(name))
    else:
        yield prefix, value
