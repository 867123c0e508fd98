"""Actors of Ray write the bytes of the local engine, also if one of them is killed."""

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]
COUNT = 300


@pytest.fixture(scope="module", params=["null", "25"], ids=["files", "tars"])
def tar(request) -> str:
    """Return the option of the number of pairs in a tar."""
    pytest.importorskip("ray")  # in its own extra
    return request.param


@pytest.fixture(scope="module")
def complete(tmp_path_factory, words, tar) -> Path:
    """Return a set made by the local engine."""
    out = tmp_path_factory.mktemp("complete") / "out"
    run(words(out, f"count={COUNT}", f"tar={tar}"), workers=0)
    return out


def command(words: tuple[str, ...], *, workers: int, engine: str = "local") -> list[str]:
    return [sys.executable, "-m", "torchrefract.generate", *words, f"workers={workers}", f"engine={engine}"]


def run(words: tuple[str, ...], **options) -> str:
    environment = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    result = subprocess.run(
        command(words, **options), env=environment, capture_output=True, text=True, check=False, timeout=500
    )
    assert result.returncode == 0, result.stderr
    return result.stdout


def actors() -> Iterator[int]:
    """Yield the processes of actors that corrupt frames, of this test's Ray."""
    for path in Path("/proc").glob("[0-9]*"):
        try:
            title = (path / "cmdline").read_bytes()
            if title.startswith(b"ray::MapWorker"):
                yield int(path.name)
        except OSError:
            continue


@pytest.mark.parametrize("workers", [1, 2])
def test_actors_write_the_bytes_of_the_local_engine(tmp_path, words, sums, complete, tar, workers):
    options = words(tmp_path / "out", f"count={COUNT}", f"tar={tar}")
    assert f"{COUNT} in total" in run(options, workers=workers, engine="ray")
    assert sums(tmp_path / "out") == sums(complete)


def test_an_actor_that_is_killed_costs_no_pair(tmp_path, words, sums, complete, tar):
    out = tmp_path / "out"
    environment = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    options = command(words(out, f"count={COUNT}", f"tar={tar}"), workers=2, engine="ray")
    killed = list[int]()
    with subprocess.Popen(options, env=environment, stdout=subprocess.PIPE, text=True) as process:
        end = time.monotonic() + 300
        while process.poll() is None and not killed and time.monotonic() < end:
            if len(list(out.glob("pairs/*/*.clean.png"))) > COUNT // 4 or len(list(out.glob("tars/0*"))) > 2:
                killed = list(actors())[:1]
                for actor in killed:
                    os.kill(actor, signal.SIGKILL)
            time.sleep(0.02)
        output, _ = process.communicate(timeout=300)
    assert killed
    assert f"{COUNT} pairs made, {COUNT} in total" in output
    assert sums(out) == sums(complete)


def test_ray_without_actors_raises(call, words):
    pytest.importorskip("ray")  # in its own extra
    message = call("generate", *words("out"), "engine=ray").message
    assert message == "workers must be at least 1 for engine=ray, which counts its actors, got 0"


@pytest.mark.quick
def test_a_cluster_that_does_not_answer_is_one_line_after_a_bounded_wait(call, words, tmp_path, monkeypatch):
    monkeypatch.setattr("torchrefract.data.pairs.ray_engine._CONNECT_SECONDS", 1.0)
    with socket.create_server(("127.0.0.1", 0)) as free:
        address = f"127.0.0.1:{free.getsockname()[1]}"
    start = time.monotonic()
    outcome = call("generate", *words("out"), "workers=1", "engine=ray", f"engine.address={address}")
    assert outcome.message == (
        f"engine.address must be that of a running cluster of Ray, got {address} (Connection refused, tried for 1 s); "
        "`ray start --head` starts one and prints its address"
    )
    assert outcome.out == f"connecting to Ray at {address}\n"
    assert time.monotonic() - start < 5
    assert not (tmp_path / "out").exists()


def test_a_cluster_that_ray_cannot_join_is_one_line(call, words):
    pytest.importorskip("ray")  # in its own extra
    message = call("generate", *words("out"), "workers=1", "engine=ray", "engine.address=auto").message
    assert message.startswith("engine.address must be that of a running cluster of Ray, got auto (Could not find any ")
