"""The command that joins the manifests of the shards of a set, and checks that the set has each pair once."""

import json
from collections import Counter
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from torchrefract._io import as_path, read_bytes
from torchrefract._validation import UsageError, check_flag
from torchrefract.cli.command import naming
from torchrefract.cli.generation import disk_errors, list_unreadable
from torchrefract.data.frames import first_names
from torchrefract.data.images import opened
from torchrefract.data.pairs.card import summarize, write_card
from torchrefract.data.pairs.manifest import Manifest, find_manifests, locked_shard, scan_rows


def merge(cfg: DictConfig) -> None:
    """Join the manifests of a set; raise UsageError if a pair is missing or two pairs have the same draw."""
    with naming("out"):
        out = as_path(str(cfg.out))
    verify = check_flag("verify", cfg.verify)
    settings, count, license_text = _configuration(out)
    with disk_errors(out), locked_shard(out, 0, 1):
        num_rows = _count_lines(out)
        manifest = Manifest(out, 0, 1)
        complete, _ = manifest.open(lambda number: number < count, verify=verify, is_repaired=lambda _: False)
        draws = Counter((row.seed, row.key) for row, _ in scan_rows([manifest.path], lambda row: not row.skipped))
        summary = summarize(row for row, _ in scan_rows([manifest.path], lambda _: True))
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


def _configuration(out: Path) -> tuple[dict[str, Any], int, str]:
    """Return the settings, the number of pairs and the license in config.json."""
    try:
        document = json.loads(read_bytes(out / "config.json"))
        return document["settings"], int(document["count"]), str(document["license"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UsageError(f"out must be a folder of generate with a valid config.json, got {out}") from error


def _count_lines(out: Path) -> int:
    count = 0
    for path in find_manifests(out):
        with opened(path) as stream:
            count += sum(1 for _ in stream)
    return count
