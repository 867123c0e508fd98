import gc
import importlib
import logging
import math
import os
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import torch
from torch import Tensor

from torchrefract.cameras.projection import undistort

# Files of slow tests, the slowest first, which would leave one process of pytest-xdist alone if they ran last.
SLOW_FILES = (
    *("effects/test_contract.py", "test_train.py", "effects/test_compose.py", "test_calibrate.py"),
    *("cli/test_preview.py", "test_export.py", "test_examples.py", "test_package.py", "benchmarks/test_table1.py"),
    "robustness/test_run_options.py",
)


def pytest_addoption(parser) -> None:
    """Add `--extremes`, which selects how many cases of the stability contract run."""
    parser.addoption("--extremes", choices=["part", "full"], default="part", help="full: many cases, large frames")


def pytest_configure() -> None:
    """Use one thread in each process of pytest-xdist and its children, so that they do not compete."""
    if "PYTEST_XDIST_WORKER" in os.environ:
        torch.set_num_threads(1)
        os.environ["OMP_NUM_THREADS"] = "1"


def pytest_collection_modifyitems(items) -> None:
    """Put slow files first: pytest-xdist gives files to its processes in this order."""
    tests = Path(__file__).parent
    order = {tests / name: number for number, name in enumerate(SLOW_FILES)}
    items.sort(key=lambda item: order.get(item.path, len(order)))


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Iterator[None]:
    """Hide the million objects of libraries and tests from the garbage collector, which would find none to free."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.collect()
        gc.freeze()
        gc.enable()


def pytest_unconfigure() -> None:
    """Show all objects to the garbage collector again, since libraries in C++ report what it leaves at the end."""
    gc.unfreeze()


@pytest.fixture(scope="session")
def full_extremes(request) -> bool:
    """Return True if all cases of tests/extremes run."""
    return request.config.getoption("--extremes") == "full"


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Return the folder of real frames and lenses next to a developer's checkout, or skip the test."""
    folder = Path(__file__).parents[1].parent / "shared" / "data"
    if not folder.is_dir():
        pytest.skip(f"needs the real frames, and {folder} does not exist")
    return folder


@pytest.fixture
def file_limit() -> Callable[[int], Any]:
    """Return a context manager in which writing to a file fails after some bytes, as on a full disk."""
    resource = pytest.importorskip("resource", reason="Windows has no such limit")

    @contextmanager
    def limit(num_bytes: int) -> Iterator[None]:
        before = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (num_bytes, before[1]))
        try:
            yield
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, before)

    return limit


@pytest.fixture
def memory(monkeypatch) -> Iterator[Any]:
    """Return the empty store memory://, without pauses before further tries."""
    monkeypatch.setattr("torchrefract._io._PAUSES", (0.0, 0.0, 0.0))
    store: Any = importlib.import_module("fsspec").filesystem("memory")
    yield store
    store.rm("/", recursive=True)


@pytest.fixture(scope="session")
def s3() -> Iterator[dict[str, str]]:
    """Start a server of the S3 protocol with the empty s3://bucket; return the environment that names it."""
    why = "moto and s3fs are in the extra test-stores"
    pytest.importorskip("s3fs", reason=why)
    server = pytest.importorskip("moto.server", reason=why).ThreadedMotoServer(port=0)
    server.start()
    host, port = server.get_host_and_port()
    environment = {"AWS_ENDPOINT_URL": f"http://{host}:{port}", "AWS_ACCESS_KEY_ID": "a", "AWS_SECRET_ACCESS_KEY": "b"}
    with empty_bucket("s3", environment | {"AWS_DEFAULT_REGION": "us-east-1"}) as environment:
        yield environment
    server.stop()


@pytest.fixture(scope="session")
def gs() -> Iterator[dict[str, str]]:
    """Start a server of Google's protocol with the empty gs://bucket; return the environment that names it."""
    why = "gcp-storage-emulator and gcsfs are in the extra test-stores"
    pytest.importorskip("gcp_storage_emulator", reason=why)
    with socket.create_server(("localhost", 0)) as free:
        port = free.getsockname()[1]
    # gcsfs asks Google for the kind of each bucket, whatever the server is, unless this is false when it is imported.
    environment = {"STORAGE_EMULATOR_HOST": f"http://localhost:{port}", "GCSFS_EXPERIMENTAL_ZB_HNS_SUPPORT": "false"}
    environment |= {"NO_GCE_CHECK": "true"}  # google.auth looks for a server of Google's machines otherwise
    command = [sys.executable, "-m", "gcp_storage_emulator", "start", f"--port={port}", "--in-memory"]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as server:
        while server.poll() is None and not is_served(port):
            time.sleep(0.05)
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv("GCSFS_EXPERIMENTAL_ZB_HNS_SUPPORT", "false")
            pytest.importorskip("gcsfs", reason=why)
        with empty_bucket("gs", environment):
            yield environment
        server.terminate()


def is_served(port: int) -> bool:
    """Return True if a server of this machine accepts connections."""
    with socket.socket() as client:
        return client.connect_ex(("localhost", port)) == 0


@contextmanager
def empty_bucket(protocol: str, environment: dict[str, str]) -> Iterator[dict[str, str]]:
    """Set an environment, and create the bucket of this name in the server that it names."""
    with pytest.MonkeyPatch.context() as patch:
        for name, value in environment.items():
            patch.setenv(name, value)
        fsspec: Any = importlib.import_module("fsspec")
        fsspec.filesystem(protocol, use_listings_cache=False).mkdir("bucket")
        yield environment


@pytest.fixture(scope="session", autouse=True)
def _equal_scenes_are_rendered_once() -> Iterator[None]:
    """Keep small road scenes, of which the data sets of trainings render a few again and again."""
    module = importlib.import_module("torchrefract.data.road_scenes.render")
    render = module.render_road_scenes

    @lru_cache
    def kept(key: int, *size: int, seed: int) -> tuple[Tensor, Tensor]:
        return render(torch.tensor([key]), *size, seed=seed)

    def render_once(keys: Tensor, height: int, width: int, *, seed: int = 0) -> tuple[Tensor, ...]:
        if len(keys) > 1 or height * width > 64 * 128:
            return render(keys, height, width, seed=seed)
        return tuple(value.clone() for value in kept(int(keys), height, width, seed=seed))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "render_road_scenes", render_once)
        yield


@pytest.fixture(autouse=True)
def fresh_compiler(request) -> Iterator[None]:
    """Reset the compiler after tests of graphs: it compiles the shared code of `forward` for eight effects at most."""
    yield
    if "graph" in request.node.name:
        torch.compiler.reset()


@pytest.fixture(autouse=True)
def same_number_of_threads() -> Iterator[None]:
    """Restore the number of threads, which changes the order of sums, after each test."""
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


@pytest.fixture
def oracle() -> Callable[..., None]:
    """Return a function that compares a tensor with that of an independent reference."""

    def agree(
        name: str, actual: Tensor, expected: Tensor, tolerance: float, *, unit: str = "px", scale: float = 1.0
    ) -> None:
        assert actual.shape == expected.shape
        assert actual.isfinite().all()
        error = ((actual.double() - expected.double()).abs() * scale).amax().item()
        assert error <= tolerance, f"{name}: {error:.2e} {unit}, tolerance {tolerance:g}"

    return agree


@pytest.fixture
def on_threads() -> Callable[[int], None]:
    """Return the function that sets the number of threads; `same_number_of_threads` restores it."""
    return torch.set_num_threads


@pytest.fixture
def waves() -> Callable[..., Tensor]:
    """Return a function that computes a smooth flow (1, 2, H, W), float64, at points (x, y)."""

    def flow(x: Tensor, y: Tensor, amplitude_px: float, length: float, phase: float = 0.3) -> Tensor:
        u = amplitude_px * torch.sin(x / length + phase) * torch.cos(y / length - phase)
        v = amplitude_px * torch.cos(x / length - 2 * phase) * torch.sin(y / length + 1)
        return torch.stack([u, v])[None]

    return flow


@pytest.fixture
def pixels() -> Callable[[int, int], tuple[Tensor, Tensor]]:
    """Return a function that gives the pixel coordinates x and y of a frame, each (H, W), float64."""

    def axes(height: int, width: int) -> tuple[Tensor, Tensor]:
        rows, columns = torch.arange(height).double(), torch.arange(width).double()
        y, x = torch.meshgrid(rows, columns, indexing="ij")
        return x, y

    return axes


@pytest.fixture(scope="session")
def drive() -> Callable[..., list[Tensor]]:
    """Return a function that draws frames (3, 270, 480) of straight strokes through a lens.

    The lens is k1 and k2 relative to the half diagonal of the frame; `strokes` (N, 2, 2), px of the rectified frame,
    are the same in all frames if given, else random ones that pass the middle at some distance.
    """
    height, width = 270, 480
    half_diagonal, center = math.hypot(height, width) / 2, torch.tensor([(width - 1) / 2, (height - 1) / 2]).double()
    y, x = torch.meshgrid(torch.arange(height).double(), torch.arange(width).double(), indexing="ij")
    pixels = (torch.stack([x, y], dim=-1).reshape(1, -1, 2) - center) / half_diagonal

    @lru_cache
    def rectified(k1: float, k2: float) -> Tensor:
        lens = torch.tensor([[k1, k2, 0.0, 0.0]], dtype=torch.float64)
        return (undistort(pixels, lens, model="opencv").points[0] * half_diagonal + center).view(height, width, 2)

    @lru_cache
    def draw(numbers: tuple[float, float], count: int, strokes: Tensor | None = None) -> list[Tensor]:
        random, frames, points = torch.Generator().manual_seed(0), list[Tensor](), rectified(*numbers)
        for _ in range(count):
            angle, offset, start = torch.rand(3, 9, 1, generator=random, dtype=torch.float64) * math.pi
            along = torch.cat([angle.cos(), angle.sin()], dim=1) * half_diagonal
            middle = center + along.flip(1) * torch.tensor([-1.0, 1.0]) * (offset / 4 - 0.4)
            ends = torch.stack([middle - along * start / 4, middle + along / 2], dim=1)
            ends = ends if strokes is None else strokes.double()
            gray = torch.full((height, width), 0.4, dtype=torch.float64)
            for i, (first, last) in enumerate(ends):
                length = (last - first).norm()
                u, v = (last - first) / length
                across = (points - first) @ torch.stack([-v, u])
                position = (points - first) @ torch.stack([u, v]) / length
                gray += (
                    (0.4 - 0.6 * (i % 2))
                    * (across + 0.5).clamp(0, 1)
                    * (8.5 - across).clamp(0, 1)
                    * ((position > 0) & (position < 1))
                )
            frames.append(gray.clamp(0, 1).float().expand(3, -1, -1))
        return frames

    return draw


@pytest.fixture
def blank_figures(monkeypatch) -> None:
    """Save empty files in place of figures, whose drawing takes longer than all else that some commands do."""

    def save(_: Any, target: Any, **__: Any) -> None:
        if isinstance(target, str | os.PathLike):
            Path(target).touch()

    monkeypatch.setattr("matplotlib.figure.Figure.savefig", save)


class Outcome(NamedTuple):
    """The exit code and the output of a command."""

    code: int
    out: str
    err: str

    @property
    def message(self) -> str:
        """Return the error message, a single line."""
        assert self.code == 1, self.out + self.err
        (line,) = self.err.splitlines()
        assert line.startswith("error: "), line
        return line.removeprefix("error: ")

    @property
    def folder(self) -> Path:
        """Return the run folder, which the line before the verdict names."""
        assert self.code == 0, self.out + self.err
        return Path(self.out.splitlines()[-2].rsplit(": ", 1)[0])


class Trained(NamedTuple):
    """A finished training and its command line."""

    words: tuple[str, ...]
    outcome: Outcome
    folder: Path


@pytest.fixture(scope="session")
def small() -> tuple[str, ...]:
    """Return arguments of a training that takes seconds."""
    data = ("data.train_count=8", "data.val_count=4", "data.batch_size=2", "data.size=[32,64]", "data.workers=0")
    return (*data, "trainer.max_epochs=2", "model=resunet", "model.network.encoder=tu-test_resnet")


@pytest.fixture(scope="session")
def spawn() -> Callable[..., Outcome]:
    """Return a function that runs Python in a new process, on one thread, in a given folder."""

    def run(*words: str, cwd: Path) -> Outcome:
        environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[1]), "OMP_NUM_THREADS": "1"}
        done = subprocess.run(
            [sys.executable, *words], cwd=cwd, env=environment, capture_output=True, text=True, timeout=300, check=False
        )
        return Outcome(done.returncode, done.stdout, done.stderr)

    return run


@pytest.fixture(scope="session")
def trained(tmp_path_factory, spawn, small) -> Trained:
    """Run a training of two epochs by its command."""
    words = ("+task=undistort", *small)
    outcome = spawn("-m", "torchrefract.train", *words, cwd=tmp_path_factory.mktemp("trained"))
    return Trained(words, outcome, outcome.folder)


@pytest.fixture(scope="session")
def known_model(tmp_path_factory) -> Callable[..., Path]:
    """Return a function that writes a checkpoint whose model gives a constant output."""

    def write(task: str, answer: tuple[float, ...], *, size: tuple[int, int] = (32, 64)) -> Path:
        checkpoints = importlib.import_module("torchrefract.restoration.checkpoints")
        network = {"_target_": "torchrefract.restoration.models.coordconv.ResUNet", "_partial_": True}
        model = {
            "_target_": "torchrefract.restoration.module.Restoration",
            "task": {"_target_": f"torchrefract.restoration.tasks.{task.capitalize()}"},
            "network": network | {"encoder": "tu-test_resnet"},
        }
        weights = importlib.import_module("hydra.utils").instantiate(model).state_dict()
        # The last layer is zero but for its bias.
        weights["network.network.segmentation_head.0.bias"][:] = torch.tensor(answer)
        content = {"state_dict": weights, "task": task, "flows": (torch.zeros(0), torch.zeros(0))}
        content |= {"config": {"model": model}, "data": {"size": [*size]}, "licenses": {"data": "CC0"}}
        path = tmp_path_factory.mktemp("known") / "best.ckpt"
        checkpoints.AtomicCheckpointIO().save_checkpoint(content, path)
        return path

    return write


@pytest.fixture(scope="session")
def shifted(known_model) -> Path:
    """Return a model whose flow points 1/16 of the width to the right and 1/32 of the height up."""
    limit = 0.25  # of Undistort, in widths and heights
    return known_model("undistort", (math.atanh(1 / 16 / limit), math.atanh(-1 / 32 / limit)))


@pytest.fixture(scope="session")
def undecided(tmp_path_factory) -> Path:
    """Return a diffusion model whose flow points right by 0 widths with a standard deviation of 1/20."""
    checkpoints = importlib.import_module("torchrefract.restoration.checkpoints")
    restoration = "torchrefract.restoration"
    network = {"_target_": f"{restoration}.models.denoiser.LensDenoiser", "_partial_": True, "lenses": 2}
    model = {"_target_": f"{restoration}.flow_diffusion.FlowDiffusion", "network": network, "components": 1}
    model["task"] = {"_target_": f"{restoration}.tasks.Undistort"}
    weights = importlib.import_module("hydra.utils").instantiate(model).state_dict()
    weights["components"][0, 0] = 1 / 20  # of the constant polynomial; an untrained network knows no more
    content = {"state_dict": weights, "task": "undistort", "flows": (torch.zeros(0), torch.zeros(0))}
    content |= {"config": {"model": model}, "data": {"size": [32, 64]}, "licenses": {}}
    path = tmp_path_factory.mktemp("undecided") / "best.ckpt"
    checkpoints.AtomicCheckpointIO().save_checkpoint(content, path)
    return path


@pytest.fixture(scope="session")
def brighter(known_model) -> Path:
    """Return a model that adds 0.2 to red and subtracts 0.1 from blue."""
    return known_model("deweather", (0.2, 0.0, -0.1))


@pytest.fixture
def call(monkeypatch, tmp_path, capsys, on_threads) -> Iterator[Callable[..., Outcome]]:
    """Return a function that runs a command in this process, on one thread, in the folder of the test."""
    for name in ("HYDRA_FULL_ERROR", "PL_GLOBAL_SEED", "PL_SEED_WORKERS", "TORCHREFRACT_FIRST_PROCESS"):
        monkeypatch.setenv(name, "")  # restored after the test
    monkeypatch.chdir(tmp_path)
    on_threads(1)
    # A slow machine would print lines of progress between the lines that tests compare.
    monkeypatch.setattr(importlib.import_module("torchrefract.cli.progress"), "_MESSAGE_INTERVAL", 3600.0)
    # Hydra composes the configuration once more to read hydra.mode, which no command sets; that takes 0.1 s.
    monkeypatch.setattr("hydra._internal.hydra.Hydra.get_mode", lambda *_, **__: None)
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
