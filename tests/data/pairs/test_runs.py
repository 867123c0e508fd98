"""A set ends with the same bytes after a kill, in shards and after a repair."""

import os
import signal
from pathlib import Path

import pytest
from processes import running, wait_for
from stores import digests

COUNT = 16


@pytest.fixture(scope="module")
def shared(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("complete") / "out"


@pytest.fixture
def complete(call, words, shared) -> Path:
    """Return a set of one uninterrupted run, which the first test makes."""
    if not shared.exists():
        assert call("generate", *words(shared, f"count={COUNT}")).code == 0
    return shared


def is_running(process: str) -> bool:
    status = Path(f"/proc/{process}/stat")
    try:
        return status.read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def children_of(process: int | str) -> list[str]:
    path = Path(f"/proc/{process}/task/{process}/children")
    return path.read_text().split() if path.exists() else []


def descendants(process: int | str) -> list[str]:
    children = children_of(process)
    return [*children, *(process for child in children for process in descendants(child))]


def workers_of(process: int) -> set[str]:
    """The processes that the fork server of a run has started."""
    return set(descendants(process)) - set(children_of(process))


def without_manifests(files: dict[str, str]) -> dict[str, str]:
    """The checksums of a set without its manifests, of which each shard has one, with a copy of config.json."""
    return {name: value for name, value in files.items() if not name.startswith(("manifest", "config-"))}


def test_a_killed_run_continues_to_the_same_bytes_with_another_number_of_workers(call, tmp_path, words, complete):
    out, arguments = tmp_path / "out", words(tmp_path / "out", f"count={COUNT}")
    with running("-m", "torchrefract.generate", *arguments, "workers=2") as run:
        # Kill it after two pairs, somewhere in a later one.
        wait_for(lambda: len(list(out.rglob("*.png"))) > 8, run)
        processes = descendants(run.pid)
    # A worker that outlived the run could write at the same time as the next run.
    wait_for(lambda: not any(is_running(process) for process in processes))
    assert "exist already" in call("generate", *arguments).out
    assert digests(out) == digests(complete)


def test_a_killed_worker_stops_the_run_with_a_message(tmp_path, words):
    out = tmp_path / "out"
    seen = dict[str, int]()

    def at_work() -> list[str]:
        """Return the workers that have lived for two pairs: the pool replaces one that is killed while it starts."""
        files, workers = len(list(out.rglob("*.png"))), workers_of(run.pid)
        return [worker for worker in workers if files > seen.setdefault(worker, files) + 8]

    with running("-m", "torchrefract.generate", *words(out, "count=4000", "workers=1")) as run:
        wait_for(at_work, run)
        for worker in at_work():
            os.kill(int(worker), signal.SIGKILL)
        _, err = run.communicate(timeout=100)
    assert run.returncode == 1, err
    assert "\nerror: workers must fit the memory, got 1 of which one was killed" in "\n" + err


@pytest.mark.parametrize("way", ["jobs", "multirun", "torchrun"])
def test_shards_make_the_same_files_in_any_order(call, tmp_path, words, complete, monkeypatch, way):
    out, options = tmp_path / "out", words(tmp_path / "out", f"count={COUNT}")
    if way == "multirun":
        assert call("generate", "-m", *options, "shards=2", "shard=0,1").code == 0
    for shard in (1, 0) if way != "multirun" else ():
        if way == "torchrun":
            monkeypatch.setenv("WORLD_SIZE", "2")
            monkeypatch.setenv("RANK", str(shard))
        assert call("generate", *options, *(("shards=2", f"shard={shard}") if way == "jobs" else ())).code == 0
    assert without_manifests(digests(out)) == without_manifests(digests(complete))
    names = {path.name for path in out.glob("manifest*")}
    assert names == {"manifest-00000-of-00002.jsonl", "manifest-00001-of-00002.jsonl"}
    lines, expected = (
        sorted(line for path in folder.glob("manifest*.jsonl") for line in path.read_text().splitlines())
        for folder in (out, complete)
    )
    assert lines == expected


def test_shards_make_the_same_tars(call, tmp_path, words):
    for name, shards in (("one", 1), ("two", 2)):
        for shard in range(shards):
            options = ("count=5", "tar=2", f"shards={shards}", f"shard={shard}")
            assert call("generate", *words(name, *options)).code == 0
    one, two = digests(tmp_path / "one"), digests(tmp_path / "two")
    assert without_manifests(one) == without_manifests(two)
    assert sum(name.startswith("tars/") for name in one) == 3


@pytest.mark.parametrize("tar", ["null", "4"])
def test_verify_makes_damaged_pairs_again(call, tmp_path, words, tar):
    arguments = words("out", "count=6", f"tar={tar}")
    assert call("generate", *arguments).code == 0
    out = tmp_path / "out"
    before = digests(out)
    altered = out / ("tars/00000000.tar" if tar == "4" else "pairs/00000/00000002.flow.png")
    data = bytearray(altered.read_bytes())
    data[1500] ^= 1
    altered.write_bytes(data)
    assert "6 pairs exist already" in call("generate", *arguments).out
    assert "made again" in call("generate", *arguments, "verify=true").out
    assert digests(out) == before


def test_truncated_and_missing_files_are_detected_by_size(call, tmp_path, words):
    arguments = words("out", "count=8")
    assert call("generate", *arguments).code == 0
    out = tmp_path / "out"
    before = digests(out)
    os.truncate(out / "pairs/00000/00000001.clean.png", 10)
    (out / "pairs/00000/00000005.valid.png").unlink()
    with (out / "manifest.jsonl").open("a") as manifest:
        manifest.write('{"number":7,"sour')
    outcome = call("generate", *arguments)
    assert "6 pairs exist already" in outcome.out
    assert ": 2 pairs made, 8 in total" in outcome.out
    assert digests(out) == before


def test_a_larger_count_adds_pairs_and_keeps_the_others(call, tmp_path, words):
    assert call("generate", *words("out", "count=12")).code == 0
    before = {name: value for name, value in digests(tmp_path / "out").items() if name.startswith("pairs/")}
    outcome = call("generate", *words("out", "count=15"))
    assert "each frame is used up to 2 times, with new keys" in outcome.out
    assert ": 3 pairs made, 15 in total" in outcome.out
    after = digests(tmp_path / "out")
    assert before.items() <= after.items()
    added = set(after) - set(before)
    assert len({name for name in added if name.startswith("pairs/")}) == 3 * 6
    assert {name for name in added if not name.startswith("pairs/")} == {
        *("README.md", "config.json", "manifest.jsonl", "pairs.parquet", "parameters.png", "sources.parquet")
    }
    assert "count must be at least" in call("generate", *words("out", "count=12")).message
