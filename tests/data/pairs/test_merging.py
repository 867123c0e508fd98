"""The manifests of shards become one, with each pair once."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest

from torchrefract.data.pairs.manifest import locked_shard


def test_shards_are_joined_and_repeats_dropped(call, words, tmp_path):
    options = words("out", "shards=2")
    assert call("generate", *options, "shard=0").code == 0
    message = call("merge", "out=out").message
    assert message == (
        "out must hold 12 pairs, got 6 missing: 1, 3, 5 and 3 more; the same commands of generate make them"
    )
    for shard in (1, 0):
        assert call("generate", *options, f"shard={shard}").code == 0
    manifests = sorted((tmp_path / "out").glob("manifest*"))
    lines = sorted(line for path in manifests for line in path.read_text().splitlines())
    shutil.copy(manifests[0], tmp_path / "out" / "manifest-copy.jsonl")
    (tmp_path / "out" / "pairs" / "00000" / "00000004.flow.png").write_bytes(b"damaged")
    with locked_shard(tmp_path / "out", 1, 2):
        assert call("merge", "out=out").message.startswith("out must not be in use")
    outcome = call("merge", "out=out")
    assert "out: 11 of 12 pairs, 0 frames are unreadable, 7 rows dropped that repeat others or lack" in outcome.out
    assert outcome.message.startswith("out must hold 12 pairs, got 1 missing: 4;")
    assert call("generate", *words("out")).code == 0
    (tmp_path / "out" / "README.md").unlink()
    assert "out: 12 of 12 pairs" in call("merge", "out=out").out
    assert [path.name for path in (tmp_path / "out").glob("manifest*")] == ["manifest.jsonl"]
    assert [path.name for path in (tmp_path / "out").glob("config*")] == ["config.json"]
    assert sorted((tmp_path / "out" / "manifest.jsonl").read_text().splitlines()) == lines
    assert (tmp_path / "out" / "README.md").is_file()


@pytest.fixture
def copied(call, words, frames, tmp_path) -> Callable[..., Path]:
    """Return a function that makes two shards, the second with another option, and copies both into one folder.

    Machines without a common disk write shards into folders of their own.
    """
    shutil.copytree(frames, tmp_path / "frames")
    (tmp_path / "frames" / "drive0" / "000.png").unlink()

    def make(option: str) -> Path:
        others: dict[str, Any] = {"scene": "cheap_dashcam"} if "scene=" in option else {}
        name = option.partition("=")[0]
        others["count"] = {"count": 18, "source": 12}.get(name, 6)
        for shard in (0, 1):
            options = ["shards=2", f"shard={shard}", *([option] if shard else [])]
            given = [word for word in words(f"out{shard}", **others) if not (shard and word.startswith(f"{name}="))]
            assert call("generate", *given, *options).code == 0
        shutil.copytree(tmp_path / "out1", tmp_path / "out0", dirs_exist_ok=True)
        return tmp_path / "out0"

    return make


@pytest.mark.parametrize(
    ("option", "different"),
    [
        ("scene.severity=5", "scene.severity is 3 in config-00000-of-00002.json and 5 in config.json"),
        ("scene.width=96", "scene.width is 192 in config-00000-of-00002.json and 96 in config.json"),
        ("source=frames", "frames is 12 in config-00000-of-00002.json and 11 in config.json, sources is "),
        ("maps=npz", "maps is png in config-00000-of-00002.json and npz in config.json"),
        ("seed=7", "seed is 0 in config-00000-of-00002.json and 7 in config.json"),
    ],
)
def test_shards_of_other_options_in_one_folder_are_an_error(call, words, copied, option, different):
    copied(option)
    start = f"out must hold shards of one configuration, got out0, where {different}"
    assert call("merge", "out=out0").message.startswith(start)
    message = call("generate", *words("out0", "count=6")).message  # must not continue one of them either
    assert message.startswith("out must be a folder of the same configuration, got out0, where ")


def test_shards_of_another_count_are_joined_with_all_their_pairs(call, copied, rows):
    out = copied("count=12")
    assert json.loads((out / "config.json").read_text())["count"] == 12
    assert "out0: 15 of 18 pairs" in call("merge", "out=out0").out
    assert len(rows(out)) == 15


@pytest.mark.parametrize("option", ["seed=7", "scene=paper_weather"])
def test_shards_of_another_seed_or_scene_without_their_options_are_an_error(call, copied, option):
    for path in copied(option).glob("config-*"):
        path.unlink()
    message = call("merge", "out=out0").message
    assert message.startswith("out must hold pairs of one configuration, got 3 of another seed or scene: 0, 2, 4")


def test_the_table_of_pairs_has_a_row_for_each_pair_and_a_column_for_each_drawn_quantity(call, words, tmp_path, rows):
    out = tmp_path / "out"
    options = words("out", "shards=2", "count=6", scene="cheap_dashcam")
    for shard in (0, 1):
        assert call("generate", *options, f"shard={shard}").code == 0
    content = (out / "pairs.parquet").read_bytes()
    (out / "pairs.parquet").unlink()
    assert call("merge", "out=out").code == 0
    assert (out / "pairs.parquet").read_bytes() == content
    table = pq.read_table(out / "pairs.parquet").to_pylist()
    manifest = rows(out)
    for name in ("number", "key", "seed", "source", "frame", "drive", "split", "scene", "height", "width"):
        assert [row[name] for row in table] == [row[name] for row in manifest]
    for row, source in zip(table, manifest, strict=True):
        assert (row["severity"], row["path"]) == (3, f"pairs/00000/{source['number']:08d}")
        assert row["effects"] == [effect["effect"] for effect in source["effects"]]
        drawn = {name: value for name, value in row.items() if "." in name and value is not None}
        assert drawn == {
            f"{effect['effect']}.{name}": value
            for effect in source["effects"]
            for name, value in effect.items()
            if name != "effect"
        }
    assert len({row["LensDistortion.coefficients"][0] for row in table}) == 6


def test_pairs_of_one_draw_are_an_error(call, words, tmp_path, rows):
    assert call("generate", *words("out", "count=3")).code == 0
    first, *others = rows(tmp_path / "out")
    others[1] |= {"key": first["key"], "seed": first["seed"]}
    lines = [json.dumps(row) + "\n" for row in (first, *others)]
    (tmp_path / "out" / "manifest.jsonl").write_text("".join(lines))
    assert (
        call("merge", "out=out").message
        == f"out must hold each draw once, got pairs that share the keys {first['key']}"
    )
    assert call("merge", "out=.").message == "out must be a folder of generate with a valid config.json, got ."
