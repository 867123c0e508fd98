"""A training on two nodes, each started by torchrun as on a machine of its own."""

import os
import socket
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest

from torchrefract.data.pairs import PairedFolder

pytest.importorskip("webdataset")  # in its own extra
ROOT = Path(__file__).parents[2]
# Runs the command, and writes the keys of each batch.
SCRIPT = """
import os
from torchrefract.restoration.module import Restoration
from torchrefract.train import main

def noted(name):
    step = getattr(Restoration, name)
    def run(self, batch, index):
        with open(f"{name}-{os.environ['RANK']}.txt", "a") as file:
            file.writelines(f"{key}\\n" for key in batch.key.tolist())
        return step(self, batch, index)
    setattr(Restoration, name, run)

noted("training_step")
noted("validation_step")
main()
"""


def test_two_nodes_train_on_each_pair_once_and_validate_each_once(tars, small, tmp_path):
    (tmp_path / "torchrefract_train.py").write_text(SCRIPT)
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    words = ["+task=undistort", "data=pairs", f"data.root={tars}", "data.buffer=8", "data.batch_size=3"]
    words += ["data.workers=1", "trainer=ddp", "trainer.accelerator=cpu", "trainer.devices=1", "trainer.num_nodes=2"]
    words += [word for word in small if not word.startswith("data.")] + ["trainer.max_epochs=1"]
    agent = [sys.executable, "-m", "torch.distributed.run", "--nnodes=2", "--nproc-per-node=1"]
    agent += ["--master-addr=127.0.0.1", f"--master-port={port}"]
    environment = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", "GLOO_SOCKET_IFNAME": "lo"}
    options = {
        "cwd": tmp_path,
        "env": environment,
        "stdout": subprocess.PIPE,
        "stderr": subprocess.STDOUT,
        "text": True,
    }
    nodes = [
        subprocess.Popen([*agent, f"--node-rank={rank}", "torchrefract_train.py", *words, "run_dir=run"], **options)
        for rank in range(2)
    ]
    try:
        output = [node.communicate(timeout=200)[0] for node in nodes]
    finally:
        for node in nodes:
            node.kill()
    assert [node.returncode for node in nodes] == [0, 0], "\n".join(output)
    for name, split in (("training_step", "train"), ("validation_step", "val")):
        expected = Counter(row.key for row in PairedFolder(tars, split=split).rows())
        parts = [(tmp_path / f"{name}-{rank}.txt").read_text().splitlines() for rank in range(2)]
        assert all(parts)
        assert Counter(int(key) for part in parts for key in part) == expected
        assert len(expected) == {"train": 16, "val": 7}[split]
    assert (tmp_path / "run" / "last.ckpt").is_file()
