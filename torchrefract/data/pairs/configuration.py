"""The configuration of an output folder: config.json, and a copy of it for each of several shards."""

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from torchrefract._io import make_folder, matching_files, read_bytes, remove_file, write_file
from torchrefract._validation import UsageError

CONFIG = "config.json"
_SHARD_CONFIGS = "config-[0-9]*-of-[0-9]*.json"
_SHOWN = 6  # differences in a message


def shard_suffix(shard: int, shards: int) -> str:
    """Return the end of the names of a shard's files; empty for a single shard."""
    return "" if shards == 1 else f"-{shard:05d}-of-{shards:05d}"


def claim(
    out: Path,
    settings: Mapping[str, Any],
    *,
    count: int = 0,
    about: Mapping[str, Any] | None = None,
    earlier: Mapping[str, Any] | None = None,
    suffix: str = "",
) -> dict[str, Any]:
    """Create an output folder, or check that it has the same settings, and write its config.json.

    Args:
        settings: everything that determines the content, of types that JSON has.
        count: number of results, which a later run may raise; 0 if the settings decide it.
        about: further entries of config.json that do not change the content.
        earlier: values of settings that folders of earlier versions do not state.
        suffix: of a shard, which gets a copy of config.json, so that `check_shards` can compare those of shards that
            were made in several folders.

    Returns:
        the previous content of config.json; empty for a new folder.

    Raises:
        UsageError: the folder has other settings or other content, or `count` is lower than before.
        OSError: the folder cannot be written.
    """
    make_folder(out)
    new = json.loads(json.dumps(settings))
    path, previous = out / CONFIG, {}
    # List the folder before testing for config.json, because another shard may be writing to it.
    others = sorted(file.name for file in (out.iterdir() if out.is_dir() else ()) if not file.name.startswith("."))
    if path.is_file():
        previous = read_config(path)
        for config in (previous, *map(read_config, shard_configs(out))):
            if different := differences({**(earlier or {}), **config.get("settings", {})}, new, "there", "here"):
                raise UsageError(
                    f"out must be a folder of the same configuration, got {out}, where {different}; choose another "
                    "folder"
                )
            if count < config.get("count", 0):
                raise UsageError(f"count must be at least that of the pairs in {out}, {config['count']}, got {count}")
    elif others:
        raise UsageError(f"out must be a new folder or one of this command, got {out}, which holds {others[0]}")
    document = {"settings": new, "count": count, **(about or {})}
    for target in (path, path.with_name(f"config{suffix}.json")) if suffix else (path,):
        if document != previous or not target.is_file():
            write_file(target, json.dumps(document, indent=2) + "\n")
    return previous


def check_shards(out: Path, settings: Mapping[str, Any], count: int) -> int:
    """Return the highest number of pairs that config.json, with these settings and count, or a shard states.

    Raises:
        UsageError: shards have other settings, as those that were made in several folders and copied into one.
    """
    for path in shard_configs(out):
        config = read_config(path)
        if different := differences(config.get("settings", {}), settings, f"in {path.name}", f"in {CONFIG}"):
            raise UsageError(
                f"out must hold shards of one configuration, got {out}, where {different}; make each set in a folder "
                "of its own"
            )
        count = max(count, config.get("count", 0))
    return count


def shard_configs(out: Path) -> list[Path]:
    """Return the configurations of the shards of a folder, sorted."""
    return matching_files(out, _SHARD_CONFIGS)


def remove_shard_config(manifest: Path) -> None:
    """Remove the configuration of the shard of a manifest, if there is one."""
    path = manifest.with_name(manifest.name.replace("manifest", "config", 1).removesuffix("l"))
    if path in shard_configs(path.parent):
        remove_file(path)


def read_config(path: Path) -> dict[str, Any]:
    """Read a config.json; raise UsageError if it is damaged."""
    try:
        config = json.loads(read_bytes(path))
    except ValueError:
        config = None
    if not isinstance(config, dict) or not _has_valid_values(config):
        raise UsageError(f"out must be a folder with a valid {CONFIG}, got {path}, which is damaged")
    return config


def _has_valid_values(config: Mapping[str, Any]) -> bool:
    return isinstance(config.get("settings", {}), dict) and isinstance(config.get("count", 0), int)


def differences(first: Any, second: Any, of_first: str, of_second: str) -> str:
    """Describe how settings differ; empty if they are equal."""
    before, after = dict(flatten(first)), dict(flatten(second))
    different = [name for name in before | after if before.get(name) != after.get(name)]
    shown = [
        f"{name} is {before.get(name)} {of_first} and {after.get(name)} {of_second}" for name in different[:_SHOWN]
    ]
    return ", ".join(shown) + (f", and {len(different) - _SHOWN} more" if len(different) > _SHOWN else "")


def flatten(value: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the names, joined by dots, and the values of nested mappings."""
    if isinstance(value, Mapping):
        for name, part in value.items():
            yield from flatten(part, f"{prefix}.{name}" if prefix else str(name))
    else:
        yield prefix, value
