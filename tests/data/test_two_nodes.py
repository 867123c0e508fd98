"""A training on two nodes, each started as torchrun starts it on a machine of its own."""

import multiprocessing
import os
import socket
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
import torch
from torch.distributed.launcher.api import LaunchConfig, elastic_launch

from torchrefract.data.pairs import PairedFolder
from torchrefract.restoration.module import Restoration
from torchrefract.train import main

pytest.importorskip("webdataset")  # in its own extra
STEPS = ("training_step", "validation_step")


def train(words: list[str]) -> None:
    """Run the command, and write the keys of each batch."""

    def noted(name: str) -> Any:
        step = getattr(Restoration, name)

        def run(self, batch, index):
            with Path(f"{name}-{os.environ['RANK']}.txt").open("a") as file:
                file.writelines(f"{key}\n" for key in batch.key.tolist())
            return step(self, batch, index)

        return run

    for name in STEPS:
        setattr(Restoration, name, noted(name))
    sys.argv = ["torchrefract.train", *words]
    main()


def run_node(rank: int, port: int, folder: Path, words: list[str]) -> None:
    """Run torchrun's agent of a node of one process, which is forked and so has imported everything."""
    os.chdir(folder)
    os.environ |= {"GLOO_SOCKET_IFNAME": "lo", "OMP_NUM_THREADS": "1"}
    torch.set_num_threads(1)
    config = LaunchConfig(
        min_nodes=2,
        max_nodes=2,
        nproc_per_node=1,
        rdzv_backend="static",
        rdzv_endpoint=f"127.0.0.1:{port}",
        rdzv_configs={"rank": rank},
        run_id="none",
        start_method="fork",
    )
    elastic_launch(config, train)(words)


def test_two_nodes_train_on_each_pair_once_and_validate_each_once(tars, small, tmp_path):
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    words = ["+task=undistort", "data=pairs", f"data.root={tars}", "data.buffer=8", "data.batch_size=3"]
    words += ["data.workers=1", "trainer=ddp", "trainer.accelerator=cpu", "trainer.devices=1", "trainer.num_nodes=2"]
    words += [word for word in small if not word.startswith("data.")] + ["trainer.max_epochs=1", "run_dir=run"]
    fork = multiprocessing.get_context("fork")
    nodes = [fork.Process(target=run_node, args=(rank, port, tmp_path, words)) for rank in range(2)]
    for node in nodes:
        node.start()
    for node in nodes:
        node.join(timeout=200)
        node.kill()
    assert [node.exitcode for node in nodes] == [0, 0]
    for name, split in zip(STEPS, ("train", "val"), strict=True):
        expected = Counter(row.key for row in PairedFolder(tars, split=split).rows())
        parts = [(tmp_path / f"{name}-{rank}.txt").read_text().splitlines() for rank in range(2)]
        assert all(parts)
        assert Counter(int(key) for part in parts for key in part) == expected
        assert len(expected) == {"train": 16, "val": 7}[split]
    assert (tmp_path / "run" / "last.ckpt").is_file()
