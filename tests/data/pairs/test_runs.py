"""Whatever is stopped, shared out or damaged, the set is the same in the end."""

import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]
COUNT = 30


def started(
    *words: str, module: tuple[str, ...] = ("torchrefract.generate",), cwd: Path | None = None
) -> subprocess.Popen[str]:
    """A run in a process of its own."""
    environment = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-m", *module, *words]
    return subprocess.Popen(
        command, cwd=cwd, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


def finished(run: subprocess.Popen[str]) -> str:
    out, err = run.communicate(timeout=300)
    assert run.returncode == 0, out + err
    return out


@pytest.fixture(scope="module")
def whole(tmp_path_factory, words) -> Path:
    """The set, made in one go by one process."""
    out = tmp_path_factory.mktemp("whole") / "out"
    finished(started(*words(out, f"count={COUNT}")))
    return out


def is_running(process: str) -> bool:
    status = Path(f"/proc/{process}/stat")
    try:
        return status.read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def children_of(process: int | str) -> list[str]:
    own = Path(f"/proc/{process}/task/{process}/children")
    return own.read_text().split() if own.exists() else []


def family(process: int | str) -> list[str]:
    """All processes that came of one."""
    children = children_of(process)
    return [*children, *(later for child in children for later in family(child))]


def workers_of(process: int) -> set[str]:
    """Those that the process has let a server of it fork."""
    return set(family(process)) - set(children_of(process))


def wait_for(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + 120
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)


def data_of(files: dict[str, str]) -> dict[str, str]:
    """The files but those of the manifest, which several shards have several of."""
    return {name: value for name, value in files.items() if not name.startswith("manifest")}


def lines(out: Path) -> list[str]:
    """The rows of all manifests, put together."""
    return sorted(line for path in out.glob("manifest*.jsonl") for line in path.read_text().splitlines())


@pytest.mark.parametrize(("workers", "kills"), [(0, 2), (2, 2)])
def test_a_run_that_is_killed_ends_as_if_it_never_was(tmp_path, words, sums, whole, workers, kills):
    out, dice = tmp_path / "out", random.Random(workers)
    arguments = words(out, f"count={COUNT}", f"workers={workers}")
    for kill in range(kills):
        before = len(list(out.rglob("*.png")))
        run = started(*arguments)
        # After a pair or more, at any moment of another one.
        while run.poll() is None and len(list(out.rglob("*.png"))) < before + 8:
            time.sleep(0.01)
        if workers and kill % 2 == 0:  # the run itself makes the first pairs
            wait_for(lambda run=run: run.poll() is not None or bool(workers_of(run.pid)))
        time.sleep(dice.uniform(0, 0.1))
        children = family(run.pid)
        run.send_signal(signal.SIGKILL)
        run.communicate()
        # No worker outlives the run, or it would write beside the next one.
        wait_for(lambda children=children: not any(is_running(child) for child in children))
    assert "exist already" in finished(started(*arguments))
    assert sums(out) == sums(whole)


def test_a_worker_that_is_killed_ends_the_run_with_a_reason(tmp_path, words):
    out = tmp_path / "out"
    run = started(*words(out, "count=4000", "workers=1"))
    seen = dict[str, int]()

    def at_work() -> list[str]:
        """Those that have been there for two pairs: in the moment of its birth another one would take its place."""
        there, workers = len(list(out.rglob("*.png"))), workers_of(run.pid)
        return [worker for worker in workers if there > seen.setdefault(worker, there) + 8]

    wait_for(lambda: run.poll() is not None or bool(at_work()))
    for worker in at_work():
        os.kill(int(worker), signal.SIGKILL)
    _, err = run.communicate(timeout=100)
    assert run.returncode == 1, err
    assert err.startswith("error: workers must fit the memory, got 1 of which one was killed")


@pytest.mark.parametrize("shards", [2, 5])
def test_shards_make_the_same_files_in_any_order(call, tmp_path, words, sums, whole, shards):
    for shard in reversed(range(shards)):
        assert call("generate", *words("out", f"count={COUNT}", f"shards={shards}", f"shard={shard}")).code == 0
    out = tmp_path / "out"
    assert data_of(sums(out)) == data_of(sums(whole))
    assert lines(out) == lines(whole)


def test_shards_in_tars_make_the_same_tars(call, tmp_path, words, sums):
    for name, shards in (("one", 1), ("three", 3)):
        for shard in range(shards):
            more = ("count=11", "tar=2", f"shards={shards}", f"shard={shard}")
            assert call("generate", *words(name, *more)).code == 0
    one, three = sums(tmp_path / "one"), sums(tmp_path / "three")
    assert data_of(one) == data_of(three)
    assert sum(name.startswith("tars/") for name in one) == 6


def test_the_shards_of_a_multirun_are_the_set(tmp_path, words, sums, whole):
    out = tmp_path / "out"
    # Hydra leaves a file where it was started.
    finished(started("-m", *words(out, f"count={COUNT}", "shards=2", "shard=0,1"), cwd=tmp_path))
    assert data_of(sums(out)) == data_of(sums(whole))


def test_the_ranks_of_torchrun_are_shards(tmp_path, words, sums, whole):
    out = tmp_path / "out"
    module = ("torch.distributed.run", "--nproc-per-node", "2", "--master-port", "29537", "-m", "torchrefract.generate")
    finished(started(*words(out, f"count={COUNT}"), module=module))
    assert data_of(sums(out)) == data_of(sums(whole))
    assert lines(out) == lines(whole)
    assert {path.name for path in out.glob("manifest*")} == {
        "manifest-00000-of-00002.jsonl",
        "manifest-00001-of-00002.jsonl",
    }


@pytest.mark.parametrize("tar", ["null", "4"])
def test_what_is_damaged_is_found_and_made_again(call, tmp_path, words, sums, tar):
    arguments = words("out", "count=8", f"tar={tar}")
    assert call("generate", *arguments).code == 0
    out = tmp_path / "out"
    before = sums(out)
    altered = out / ("tars/00000000.tar" if tar == "4" else "pairs/00000/00000002.flow.png")
    data = bytearray(altered.read_bytes())
    data[1500] ^= 1
    altered.write_bytes(data)
    assert "8 pairs exist already" in call("generate", *arguments).out
    assert "made again" in call("generate", *arguments, "verify=true").out
    assert sums(out) == before


def test_a_file_that_is_cut_or_gone_is_seen_without_being_read(call, tmp_path, words, sums):
    arguments = words("out", "count=8")
    assert call("generate", *arguments).code == 0
    out = tmp_path / "out"
    before = sums(out)
    os.truncate(out / "pairs/00000/00000001.clean.png", 10)
    (out / "pairs/00000/00000005.valid.png").unlink()
    with (out / "manifest.jsonl").open("a") as manifest:
        manifest.write('{"number":7,"sour')
    outcome = call("generate", *arguments)
    assert "6 pairs exist already" in outcome.out
    assert ": 2 pairs made, 8 in total" in outcome.out
    assert sums(out) == before


def test_a_set_grows_and_its_first_pairs_stay(call, tmp_path, words, sums):
    assert call("generate", *words("out", "count=12")).code == 0
    before = {name: value for name, value in sums(tmp_path / "out").items() if name.startswith("pairs/")}
    outcome = call("generate", *words("out", "count=15"))
    assert "each frame is used up to 2 times, with new keys" in outcome.out
    assert ": 3 pairs made, 15 in total" in outcome.out
    after = sums(tmp_path / "out")
    assert before.items() <= after.items()
    assert len(set(after) - set(before)) == 3 * 6 + 4
    assert "count must be at least" in call("generate", *words("out", "count=12")).message
