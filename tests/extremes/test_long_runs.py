import copy
import ctypes
import gc
import pickle
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import pytest
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset, get_worker_info

import torchrefract as tr
from torchrefract.effects.base import Effect
from torchrefract.fields import low_modes, modes, spline
from torchrefract.warping import lattice

CAMERA = tr.Camera(width=48, height=32, fx=40, fy=40, cx=23, cy=16, coefficients=(-0.2, 0.05, 0.001, 0.002))
EFFECTS: dict[str, Callable[[], Effect]] = {
    "lens": tr.LensDistortion,
    "turbulence": partial(tr.Turbulence, amplitude_range=(0.1, 0.3), length_range=(6.0, 9.0)),
    "thin plate": tr.ThinPlateSpline,
    "divergence-free": partial(tr.DivergenceFree, amplitude_range=(0.1, 0.5), length_range=(8.0, 12.0)),
    "rectification": partial(tr.Rectification, CAMERA),
    "fog": partial(tr.UniformFog, tolerance=0.5),
    "drifts": tr.HeterogeneousFog,
    "drifts in space": partial(tr.HeterogeneousFog, mode="ray"),
    "flare": tr.LensFlare,
    "compose": lambda: tr.Compose([tr.LensDistortion(), tr.UniformFog(), tr.ThinPlateSpline(), tr.LensFlare()]),
    "one of": lambda: tr.OneOf([tr.LensDistortion(), tr.HeterogeneousFog(), tr.ThinPlateSpline()]),
}
SIZE = (32, 48)
CALLS = {False: 50, True: 3000}  # in a stretch
GROWTH = 0.8  # MB in a stretch: half of what it would be if each call kept an image
THREADS = 8


@pytest.fixture(params=EFFECTS)
def make(request) -> Callable[[], Effect]:
    return EFFECTS[request.param]


def picture(seed: int = 0, *, size: tuple[int, int] = SIZE, batch: int = 1) -> Tensor:
    """(B, 3, H, W), in [0, 1]."""
    return torch.rand(batch, 3, *size, generator=torch.Generator().manual_seed(seed))


class _Allocations(ctypes.Structure):
    """What glibc's mallinfo2 tells, in bytes; of its ten numbers those that lie in use have names."""

    _fields_: ClassVar = [
        (name, ctypes.c_size_t) for name in ("_0", "_1", "_2", "_3", "mapped", "_5", "_6", "used", "_8", "_9")
    ]


def allocated() -> float:
    """The memory that is in use, MB, where the C library tells it; else all that the process has.

    The latter comes and goes by some MB with what is kept free.
    """
    library = ctypes.CDLL(None)
    if hasattr(library, "mallinfo2"):
        library.mallinfo2.restype = _Allocations
        found = library.mallinfo2()
        return (found.mapped + found.used) / 2**20
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) / 1024 for line in lines if line.startswith("VmRSS"))


def tensors() -> int:
    """How many tensors there are."""
    gc.collect()
    # By their types: to ask some of the objects for their class is to be warned of them.
    return sum(issubclass(type(value), Tensor) for value in gc.get_objects())


@pytest.mark.skipif(not Path("/proc/self/status").is_file(), reason="needs a system that tells the memory of a process")
def test_the_memory_does_not_grow_with_the_number_of_calls(make, full_extremes):
    effect, image, grown = make(), picture(), []
    weight = torch.ones((), requires_grad=True)

    def call(key: int) -> None:
        degraded = effect.degrade(image * weight, seed=7, keys=[key])
        degraded.image.sum().backward()
        degraded.valid.sum()
        weight.grad = None

    calls = CALLS[full_extremes]
    for key in range(max(20, 10_000 - 3 * calls if full_extremes else 0)):
        call(key)
    held = tensors()
    # What allocators keep comes in steps; what leaks grows in every stretch.
    for stretch in range(3):
        before = allocated()
        for key in range(calls):
            call(stretch * calls + key)
        grown.append(allocated() - before)
    assert min(grown) < GROWTH, grown
    assert tensors() <= held + 2


def test_what_is_let_go_is_free_at_once(make):
    def use(key: int) -> None:
        degraded = make().degrade(picture(), seed=7, keys=[key])
        maps(degraded)
        assert degraded.restore_residual is None or degraded.folding is not None

    use(0)
    gc.collect()
    gc.disable()
    try:
        gc.set_debug(gc.DEBUG_SAVEALL)
        for key in range(3):
            use(key)
        gc.collect()
        kept = [value for value in gc.garbage if issubclass(type(value), Tensor | tr.Degraded)]
    finally:
        gc.set_debug(0)
        gc.garbage.clear()
        gc.enable()
    assert not kept


def test_new_sizes_and_new_effects_do_not_keep_memory(make):
    image = picture(size=(64, 64))
    make().degrade(image[..., : SIZE[0], : SIZE[1]], seed=7)
    # What waves, lattices and splines are made of is kept for the latest sixteen, eigenvalues for the latest 64: they
    # have been others so far, whatever ran before.
    for i in range(16):
        few = modes.Modes((100 + i, 100), 1, 1)
        modes._places(few, image.device)
        modes._waves(few, (0, 1), (0, 1), 1, image.dtype, image.device)
        modes._sides(few, image.device)
        low_modes._turns(few, 0, 0, image.dtype, image.device)
        lattice._curl_weights(2 + i, (1.0, 1.0), image.dtype, image.device)
        points = picture(i, size=(4, 2))[:, 0].double()
        spline.fit_spline(points, points, points.new_zeros(1))
    for i in range(low_modes._MOST_TABLES):
        few = modes.Modes((100 + 2 * i, 100), 1, 1)
        low_modes.low_eigenvalues(few, image.new_ones(1), kind="exponential", lengths=(1.0, 2.0), nodes=2)
    held = tensors()
    for i in range(24):
        # Plans are kept for a few hundred sizes; nothing else is for more than those sixteen.
        taller = 0 if make is EFFECTS["rectification"] else i
        make().degrade(image[..., : SIZE[0] + taller, : SIZE[1]], seed=7)
    assert tensors() <= held + 2


class Samples(Dataset[dict[str, Any]]):
    """Frames degraded where they are loaded, each told with the worker's number and memory."""

    def __init__(self, effect: Effect, count: int):
        self.effect, self.count = effect, count

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, index: int) -> dict[str, Any]:
        image = self.effect.degrade(picture(index % 16)[0], seed=7, keys=[index]).image
        worker = get_worker_info()
        return {
            "image": image,
            "worker": worker.id if worker else -1,
            "allocated": allocated() if index % 40 < 8 else 0.0,
        }


@pytest.mark.filterwarnings("ignore:.*multi-threaded, use of fork:DeprecationWarning")  # so do loaders on Linux
@pytest.mark.skipif(not Path("/proc/self/status").is_file(), reason="needs a system that tells the memory of a process")
def test_workers_load_the_samples_of_one_process_and_do_not_grow(full_extremes):
    count = 20_000 if full_extremes else 480
    effect = tr.Compose([tr.LensDistortion(), tr.HeterogeneousFog(), tr.ThinPlateSpline(), tr.LensFlare(p=0.5)])
    samples = Samples(effect, count)
    found: dict[int, list[float]] = {}
    loader = DataLoader(samples, batch_size=8, num_workers=2, multiprocessing_context="fork")
    for number, batch in enumerate(loader):
        if number % 12 == 0:
            expected = torch.stack([samples[8 * number + i]["image"] for i in range(8)])
            assert torch.equal(batch["image"], expected)
        for worker, memory in zip(batch["worker"].tolist(), batch["allocated"].tolist(), strict=True):
            if memory:
                found.setdefault(worker, []).append(memory)
    assert sorted(found) == [0, 1]
    for memory in found.values():
        # After a quarter of the run everything that is kept once is there.
        start = memory[len(memory) // 4 :]
        assert max(start[len(start) // 2 :]) - max(start[: len(start) // 2]) < 2 * GROWTH


def in_threads(function: Callable[[int], Any], count: int) -> list[Any]:
    """What the function gives for each number, the first few called by all threads at the same moment."""
    together = threading.Barrier(THREADS)

    def call(number: int) -> Any:
        if number < THREADS:
            together.wait()
        return function(number)

    with ThreadPoolExecutor(THREADS) as pool:
        return list(pool.map(call, range(count)))


def maps(degraded: tr.Degraded) -> list[Tensor]:
    """The image and all maps."""
    names = ("image", "flow", "valid", "restore_flow", "restore_valid", "transmission", "extinction", "intensity")
    return [value for name in names if (value := getattr(degraded, name)) is not None]


def test_threads_that_call_one_effect_get_what_one_thread_gets(make, full_extremes):
    count = 2000 if full_extremes else 32
    # A new size for each stretch of calls, so that plans are made while others are read.
    sizes = [(SIZE[0] + 4 * (i // 8 % 7), SIZE[1] + 6 * (i // 8 % 7)) for i in range(count)]
    if make is EFFECTS["rectification"]:
        sizes = [SIZE] * count

    def call(effect: Effect, number: int) -> list[Tensor]:
        return maps(effect.degrade(picture(number, size=sizes[number], batch=2), seed=7, keys=[number, -number]))

    found = in_threads(partial(call, make()), count)
    alone = make()
    for number, values in enumerate(found):
        expected = call(alone, number)
        assert len(values) == len(expected)
        assert all(torch.equal(value, one) for value, one in zip(values, expected, strict=True)), number


def test_threads_get_their_own_gradients(make):
    effect, images = make(), [picture(i) for i in range(24)]

    def slope(number: int) -> Tensor:
        image = images[number].clone().requires_grad_()
        degraded = effect.degrade(image, seed=7, keys=[number])
        return torch.autograd.grad(degraded.image.square().sum(), image)[0]

    found = in_threads(slope, len(images))
    assert all(torch.equal(value, slope(number)) for number, value in enumerate(found))


@pytest.mark.parametrize("way", ["deepcopy", "pickle"])
def test_an_effect_is_copied_while_it_is_called(make, way):
    effect, image = make(), picture()
    copied = copy.deepcopy if way == "deepcopy" else lambda value: pickle.loads(pickle.dumps(value))
    expected = maps(effect.degrade(image, seed=7))

    def call(number: int) -> list[Tensor]:
        own = copied(effect) if number % 2 else effect
        return maps(own.degrade(image, seed=7))

    for values in in_threads(call, 32):
        assert all(torch.equal(value, one) for value, one in zip(values, expected, strict=True))


def test_a_result_is_copied_while_its_maps_are_read(make):
    degraded = make().degrade(picture(), seed=7)
    expected = maps(make().degrade(picture(), seed=7))

    def read(number: int) -> list[Tensor]:
        return maps(copy.deepcopy(degraded) if number % 2 else degraded)

    for values in in_threads(read, 32):
        assert all(torch.equal(value, one) for value, one in zip(values, expected, strict=True))
