"""A training on two nodes, each started by torchrun as on a machine of its own."""

import importlib
import os
import socket
from collections import Counter
from collections.abc import Callable
from typing import Any

import pytest

from torchrefract.data.pairs import PairedFolder

pytest.importorskip("webdataset")  # in its own extra


def noting(name: str, step: Callable[..., Any]) -> Callable[..., Any]:
    """Return a step of Lightning's that writes the keys of its batch first."""

    def noted(self, batch: Any, index: int) -> Any:
        with open(f"{name}-{os.environ['RANK']}.txt", "a") as file:
            file.writelines(f"{key}\n" for key in batch.key.tolist())
        return step(self, batch, index)

    return noted


def train_and_note_keys() -> None:
    """Run the command, and write the keys of each batch."""
    restoration = importlib.import_module("torchrefract.restoration.module").Restoration
    for name in ("training_step", "validation_step"):
        setattr(restoration, name, noting(name, getattr(restoration, name)))
    importlib.import_module("torchrefract.train").main()


def start_node(*words: str) -> None:
    """Do what torchrun does, but fork the process of the training, which then need not import everything again."""
    run = importlib.import_module("torch.distributed.run")
    config, _, _ = run.config_from_args(run.parse_args([*words, "torchrefract.train"]))
    config.start_method = "fork"
    run.elastic_launch(config, train_and_note_keys)()


@pytest.mark.filterwarnings("ignore:.*multi-threaded, use of fork:DeprecationWarning")
def test_two_nodes_train_on_each_pair_once_and_validate_each_once(tars, small, tmp_path, fork, monkeypatch):
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    words = ["+task=undistort", "data=pairs", f"data.root={tars}", "data.buffer=8", "data.batch_size=3"]
    words += ["data.workers=1", "trainer=ddp", "trainer.accelerator=cpu", "trainer.devices=1", "trainer.num_nodes=2"]
    words += [word for word in small if not word.startswith("data.")] + ["trainer.max_epochs=1", "run_dir=run"]
    agent = ["--nnodes=2", "--nproc-per-node=1", "--master-addr=127.0.0.1", f"--master-port={port}"]
    monkeypatch.setenv("GLOO_SOCKET_IFNAME", "lo")
    nodes = [fork(start_node, *agent, f"--node-rank={rank}", argv=words, cwd=tmp_path) for rank in range(2)]
    try:
        for node in nodes:
            node.join(timeout=200)
    finally:
        for node in nodes:
            node.kill()
    assert [node.exitcode for node in nodes] == [0, 0], (tmp_path / "err.txt").read_text()
    for name, split in (("training_step", "train"), ("validation_step", "val")):
        expected = Counter(row.key for row in PairedFolder(tars, split=split).rows())
        parts = [(tmp_path / f"{name}-{rank}.txt").read_text().splitlines() for rank in range(2)]
        assert all(parts)
        assert Counter(int(key) for part in parts for key in part) == expected
        assert len(expected) == {"train": 16, "val": 7}[split]
    assert (tmp_path / "run" / "last.ckpt").is_file()
