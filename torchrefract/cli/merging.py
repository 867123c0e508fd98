"""The command that joins the manifests of the shards of a set, and checks that the set has each pair once."""

import json
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from torchrefract._io import as_path, read_bytes, remove_file
from torchrefract._validation import UsageError, check_flag, first_names
from torchrefract.cli.generation import list_unreadable
from torchrefract.cli.options import disk_errors, naming, read_option
from torchrefract.data.images import opened
from torchrefract.data.pairs.card import summarize, write_card
from torchrefract.data.pairs.configuration import check_shards, shard_configs
from torchrefract.data.pairs.manifest import Manifest, find_manifests, locked_shard, scan_rows


def merge(cfg: DictConfig) -> None:
    """Join the manifests of a set; raise UsageError if it lacks a pair, or has one twice or of other options."""
    with naming("out"):
        out = as_path(str(cfg.out))
    verify = read_option(cfg, "verify", check_flag)
    settings, count, license_text = _configuration(out)
    with disk_errors(out), locked_shard(out, 0, 1):
        count = check_shards(out, settings, count)
        num_rows = _count_lines(out)
        _check_configuration(out, settings, count)
        manifest = Manifest(out, 0, 1)
        complete, _ = manifest.open(lambda number: number < count, verify=verify, is_repaired=lambda _: False)
        draws = Counter((row.seed, row.key) for row, _ in scan_rows([manifest.path], lambda row: not row.skipped))
        rows = (row for row, _ in scan_rows([manifest.path], lambda _: True))
        summary = summarize(rows, settings=settings)
        list_unreadable(summary.skipped)
        print(
            f"{out}: {summary.splits.total()} of {count} pairs, {len(summary.skipped)} frames are unreadable, "
            f"{num_rows - len(complete)} rows dropped that repeat others or lack their files"
        )
        if missing := [str(number) for number in range(count) if number not in complete]:
            raise UsageError(
                f"out must hold {count} pairs, got {len(missing)} missing: {first_names(missing)}; the same commands "
                "of generate make them"
            )
        if repeated := [str(key) for (_, key), times in draws.items() if times > 1]:
            raise UsageError(f"out must hold each draw once, got pairs that share the keys {first_names(repeated)}")
        write_card(out, summary, settings=settings, license_text=license_text)
        for path in shard_configs(out):
            remove_file(path)


def _configuration(out: Path) -> tuple[dict[str, Any], int, str]:
    """Return the settings, the number of pairs and the license in config.json."""
    try:
        document = json.loads(read_bytes(out / "config.json"))
        settings = document["settings"]
        _ = settings["scene"]["name"], settings["seed"]  # an error if there is none
        return settings, int(document["count"]), str(document["license"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UsageError(f"out must be a folder of generate with a valid config.json, got {out}") from error


def _check_configuration(out: Path, settings: Mapping[str, Any], count: int) -> None:
    """Raise UsageError if rows are of another seed or scene, as of shards that were copied without their options."""
    rows = (row for row, _ in scan_rows(find_manifests(out), lambda row: row.number < count, skip_invalid=True))
    expected = settings["scene"]["name"], settings["seed"]
    # The seed of a draw holds that of the set in its upper bits, see `draw_of`.
    if other := [str(row.number) for row in rows if (row.scene, row.seed >> 32) != expected]:
        raise UsageError(
            f"out must hold pairs of one configuration, got {len(other)} of another seed or scene: "
            f"{first_names(sorted(other, key=int))}; make each set in a folder of its own"
        )


def _count_lines(out: Path) -> int:
    count = 0
    for path in find_manifests(out):
        with opened(path) as stream:
            count += sum(1 for _ in stream)
    return count
