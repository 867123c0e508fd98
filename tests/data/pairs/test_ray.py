"""Actors of Ray write the bytes of the local engine, also if one of them is killed."""

import os
import signal
import socket
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from processes import running
from stores import digests

COUNT = 300


@pytest.fixture(scope="module", params=["null", "25"], ids=["files", "tars"])
def tar(request) -> str:
    """Return the option of the number of pairs in a tar."""
    pytest.importorskip("ray")  # in its own extra
    return request.param


@pytest.fixture(scope="module")
def complete(tmp_path_factory, spawn, words, tar) -> Path:
    """Return a set made by the local engine."""
    out = tmp_path_factory.mktemp("complete") / "out"
    outcome = spawn(*GENERATE, *words(out, f"count={COUNT}", f"tar={tar}"), cwd=out.parent)
    assert outcome.code == 0, outcome.err
    return out


GENERATE = ("-m", "torchrefract.generate")


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
def test_actors_write_the_bytes_of_the_local_engine(tmp_path, spawn, words, complete, tar, workers):
    options = words(tmp_path / "out", f"count={COUNT}", f"tar={tar}", "engine=ray", workers=workers)
    assert f"{COUNT} in total" in spawn(*GENERATE, *options, cwd=tmp_path).out
    assert digests(tmp_path / "out") == digests(complete)


def test_an_actor_that_is_killed_costs_no_pair(tmp_path, words, complete, tar):
    out = tmp_path / "out"
    options = words(out, f"count={COUNT}", f"tar={tar}", "engine=ray", workers=2)
    killed = list[int]()
    with running(*GENERATE, *options, stdout=subprocess.PIPE) as process:
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
    assert digests(out) == digests(complete)


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
