"""The manifests of shards become one, with each pair once."""

import json
import shutil

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
    assert sorted((tmp_path / "out" / "manifest.jsonl").read_text().splitlines()) == lines
    assert (tmp_path / "out" / "README.md").is_file()


@pytest.mark.parametrize("name", ["seed", "scene"])
def test_shards_of_another_seed_or_scene_in_one_folder_are_an_error(call, words, tmp_path, name):
    """Machines without a common disk may write shards with other options, which are copied together afterwards."""
    for shard in (0, 1):
        options = words(f"out{shard}", "shards=2", f"shard={shard}")
        if shard and name == "scene":
            options = words(f"out{shard}", "shards=2", f"shard={shard}", scene="paper_weather")
        assert call("generate", *options, *(["seed=7"] if shard and name == "seed" else [])).code == 0
    shutil.copytree(tmp_path / "out1", tmp_path / "out0", dirs_exist_ok=True)
    message = call("merge", "out=out0").message
    assert message.startswith("out must hold pairs of one configuration, got 6 of another seed or scene: 0, 2, 4 ")


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
