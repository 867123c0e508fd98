import importlib
import logging
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import pytest
import torch
from torch import Tensor


def pytest_addoption(parser) -> None:
    """How much of the stability contract is tried: a part in minutes, or all of it."""
    parser.addoption("--extremes", choices=["part", "full"], default="part", help="full: many cases, large frames")


def pytest_configure() -> None:
    """Of several processes each keeps to one thread, as do those that it starts: none waits for another's threads."""
    if "PYTEST_XDIST_WORKER" in os.environ:
        torch.set_num_threads(1)
        os.environ["OMP_NUM_THREADS"] = "1"


@pytest.fixture(scope="session")
def full_extremes(request) -> bool:
    """Whether all cases of tests/extremes are asked for."""
    return request.config.getoption("--extremes") == "full"


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real frames and lenses that lies beside the checkout of a developer."""
    folder = Path(__file__).parents[1].parent / "shared" / "data"
    if not folder.is_dir():
        pytest.skip(f"needs the real frames, and {folder} does not exist")
    return folder


@pytest.fixture(autouse=True)
def fresh_compiler(request) -> Iterator[None]:
    """All effects share the code of `forward`, and a process compiles the same code for eight kinds of them at most."""
    yield
    if "graph" in request.node.name:
        torch.compiler.reset()


@pytest.fixture(autouse=True)
def threads_of_its_own() -> Iterator[None]:
    """What a test sets, as the benchmarks do, the next one does not find: sums differ with the number of threads."""
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


class Agreement(NamedTuple):
    """How far something is from an independent oracle at most, and how far it may be."""

    error: float
    bar: float
    unit: str


_ORACLES = pytest.StashKey[dict[str, Agreement]]()


def keep(config: pytest.Config, what: str, found: Agreement) -> None:
    """Of all that is told of one oracle, the largest error is kept."""
    kept = config.stash.setdefault(_ORACLES, {})
    if what not in kept or found.error > kept[what].error:
        kept[what] = found


@pytest.fixture
def oracle(request) -> Callable[..., None]:
    """Asserts that two tensors agree within a bar, and keeps the largest error for the summary of the run."""

    def agree(what: str, found: Tensor, expected: Tensor, bar: float, *, unit: str = "px", scale: float = 1.0) -> None:
        assert found.shape == expected.shape
        assert found.isfinite().all()
        error = ((found.double() - expected.double()).abs() * scale).amax().item()
        keep(request.config, what, Agreement(error, bar, unit))
        assert error <= bar, f"{what}: {error:.2e} {unit}, bar {bar:g}"

    return agree


def pytest_sessionfinish(session) -> None:
    """One of several processes hands what its oracles said to the one that sums up."""
    if hasattr(session.config, "workeroutput"):
        told = {what: tuple(found) for what, found in session.config.stash.get(_ORACLES, {}).items()}
        session.config.workeroutput["oracles"] = told


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node) -> None:
    """Collects what the oracles of one process said; one that was killed says nothing."""
    for what, found in getattr(node, "workeroutput", {}).get("oracles", {}).items():
        keep(node.config, what, Agreement(*found))


def pytest_terminal_summary(terminalreporter, config) -> None:
    """What the oracles said, each with its largest error."""
    kept = config.stash.get(_ORACLES, {})
    if kept:
        terminalreporter.section("largest error against each oracle")
        for what, found in sorted(kept.items()):
            terminalreporter.write_line(f"{what:74} {found.error:8.1e} {found.unit:3} (bar {found.bar:g})")


@pytest.fixture
def on_threads() -> Callable[[int], None]:
    """Sets the number of torch's threads, which `threads_of_its_own` sets back."""
    return torch.set_num_threads


@pytest.fixture
def waves() -> Callable[..., Tensor]:
    """A smooth flow (1, 2, H, W), fp64, at the points (x, y): amplitude_px sin(x / length), mixed over both axes."""

    def flow(x: Tensor, y: Tensor, amplitude_px: float, length: float, phase: float = 0.3) -> Tensor:
        u = amplitude_px * torch.sin(x / length + phase) * torch.cos(y / length - phase)
        v = amplitude_px * torch.cos(x / length - 2 * phase) * torch.sin(y / length + 1)
        return torch.stack([u, v])[None]

    return flow


@pytest.fixture
def pixels() -> Callable[[int, int], tuple[Tensor, Tensor]]:
    """The whole coordinates x and y of a frame, each (H, W), fp64."""

    def axes(height: int, width: int) -> tuple[Tensor, Tensor]:
        rows, columns = torch.arange(height).double(), torch.arange(width).double()
        y, x = torch.meshgrid(rows, columns, indexing="ij")
        return x, y

    return axes


class Outcome(NamedTuple):
    """What a command left behind."""

    code: int
    out: str
    err: str

    @property
    def message(self) -> str:
        """The one line of an error that the user can mend."""
        assert self.code == 1, self.out + self.err
        (line,) = self.err.splitlines()
        assert line.startswith("error: "), line
        return line.removeprefix("error: ")

    @property
    def folder(self) -> Path:
        """The run folder, as the last line tells it."""
        assert self.code == 0, self.out + self.err
        return Path(self.out.splitlines()[-1].rsplit(": ", 1)[0])


class Trained(NamedTuple):
    """A finished training, and the words that asked for it."""

    words: tuple[str, ...]
    outcome: Outcome
    folder: Path


@pytest.fixture(scope="session")
def small() -> tuple[str, ...]:
    """The words that make a training a matter of seconds."""
    data = ("data.train_count=32", "data.val_count=16", "data.batch_size=8", "data.size=[32,64]", "data.workers=0")
    return (*data, "trainer.max_epochs=2", "model.network.encoder=tu-mobilenetv3_small_050")


@pytest.fixture(scope="session")
def spawn() -> Callable[..., Outcome]:
    """Runs Python, on one thread, in a process and a folder of its own."""

    def run(*words: str, cwd: Path) -> Outcome:
        environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[1]), "OMP_NUM_THREADS": "1"}
        done = subprocess.run(
            [sys.executable, *words], cwd=cwd, env=environment, capture_output=True, text=True, timeout=300, check=False
        )
        return Outcome(done.returncode, done.stdout, done.stderr)

    return run


@pytest.fixture(scope="session")
def trained(tmp_path_factory, spawn, small) -> Trained:
    """A training of two epochs by the command, as a user would start it."""
    words = ("+task=undistort", *small)
    outcome = spawn("-m", "torchrefract.train", *words, cwd=tmp_path_factory.mktemp("trained"))
    return Trained(words, outcome, outcome.folder)


@pytest.fixture(scope="session")
def known_model(tmp_path_factory) -> Callable[..., Path]:
    """Writes checkpoints of models that answer the same for every pixel, whatever they see."""

    def write(task: str, answer: tuple[float, ...], *, size: tuple[int, int] = (32, 64)) -> Path:
        checkpoints = importlib.import_module("torchrefract.restoration.checkpoints")
        network = {"_target_": "torchrefract.restoration.models.resunet.ResUNet", "encoder": "tu-mobilenetv3_small_050"}
        model = {
            "_target_": "torchrefract.restoration.module.Restoration",
            "task": {"_target_": f"torchrefract.restoration.tasks.{task.capitalize()}"},
            "network": network | {"_partial_": True},
        }
        weights = importlib.import_module("hydra.utils").instantiate(model).state_dict()
        # Its last layer starts at zero.
        weights["network.network.segmentation_head.0.bias"][:] = torch.tensor(answer)
        content = {"state_dict": weights, "task": task, "flows": (torch.zeros(0), torch.zeros(0))}
        content |= {"config": {"model": model}, "data": {"size": [*size]}, "licenses": {"data": "CC0"}}
        path = tmp_path_factory.mktemp("known") / "best.ckpt"
        checkpoints.AtomicCheckpointIO().save_checkpoint(content, path)
        return path

    return write


@pytest.fixture
def call(monkeypatch, tmp_path, capsys, on_threads) -> Iterator[Callable[..., Outcome]]:
    """Runs a command in this process, on one thread, in the test's folder: no start to wait for."""
    for name in ("HYDRA_FULL_ERROR", "PL_GLOBAL_SEED", "PL_SEED_WORKERS"):
        monkeypatch.setenv(name, "")  # what a command sets goes again
    monkeypatch.chdir(tmp_path)
    on_threads(1)
    hydra = importlib.import_module("hydra.core.global_hydra").GlobalHydra.instance()
    handlers = list(logging.root.handlers)

    def run(name: str, *words: str) -> Outcome:
        monkeypatch.setattr(sys, "argv", [f"torchrefract.{name}", *words])
        hydra.clear()
        code = 0
        try:
            importlib.import_module(f"torchrefract.{name}").main()
        except SystemExit as stop:
            code = stop.code if isinstance(stop.code, int) else 1
        finally:
            hydra.clear()
        return Outcome(code, *capsys.readouterr())

    yield run
    # Hydra's log handlers would write to the captured output of this test.
    logging.root.handlers[:] = handlers
