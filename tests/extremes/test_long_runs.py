"""Many calls, many sizes, many threads: memory stays constant, and results stay those of a single call."""

import copy
import ctypes
import gc
import pickle
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import _lru_cache_wrapper, partial
from pathlib import Path
from typing import Any, ClassVar

import pytest
import torch
from domain import IGNORE_STRENGTH
from helpers import EFFECTS, SIZE, assert_close_images, assert_close_maps, maps_of, random_image
from torch import Tensor
from torch.utils.data import DataLoader, Dataset, get_worker_info

import torchrefract as tr
from torchrefract.effects.base import Effect

HEIGHT, WIDTH = SIZE
pytestmark = IGNORE_STRENGTH
CALLS = {False: 20, True: 3000}  # in a stretch, without and with --extremes=full
GROWTH = {False: 0.32, True: 0.64}  # MB in a stretch: half of what it would be if each of 20 or 40 calls kept an image
THREADS = 8
needs_proc = pytest.mark.skipif(not Path("/proc/self/status").is_file(), reason="needs /proc, which shows the memory")


@pytest.fixture(params=EFFECTS)
def make(request) -> Callable[[], Effect]:
    return EFFECTS[request.param]


def frame(seed: int = 0, *, size: tuple[int, int] = (HEIGHT, WIDTH), batch: int = 1) -> Tensor:
    return random_image(batch, 3, *size, seed=seed)


class _Allocations(ctypes.Structure):
    """The result of glibc's mallinfo2, bytes; only the fields in use have names."""

    _fields_: ClassVar = [
        (name, ctypes.c_size_t) for name in ("_0", "_1", "_2", "_3", "mapped", "_5", "_6", "used", "_8", "_9")
    ]


def allocated_mb() -> float:
    """Return the memory in use, MB; without glibc that of the process, which varies by some MB of free memory."""
    library = ctypes.CDLL(None)
    if hasattr(library, "mallinfo2"):
        library.mallinfo2.restype = _Allocations
        info = library.mallinfo2()
        return (info.mapped + info.used) / 2**20
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) / 1024 for line in lines if line.startswith("VmRSS"))


@pytest.fixture(scope="module")
def bounded_caches() -> list[Any]:
    """Return all caches of the package that keep a limited number of results."""
    gc.unfreeze()  # the list of objects leaves out frozen ones
    caches: list[Any] = [value for value in gc.get_objects() if type(value) is _lru_cache_wrapper]
    ours = [cache for cache in caches if str(cache.__module__).startswith("torchrefract.")]
    return [cache for cache in ours if cache.cache_parameters()["maxsize"] is not None]


@pytest.fixture
def num_tensors(bounded_caches) -> Callable[[], int]:
    """Return a function that counts the tensors that are new since the start of the test and in no bounded cache."""

    def count() -> int:
        for cache in bounded_caches:
            cache.cache_clear()
        gc.collect()
        # `type` instead of isinstance, which makes some lazy objects warn.
        return sum(issubclass(type(value), Tensor) for value in gc.get_objects())

    gc.collect()
    gc.freeze()  # so that a count looks at new objects alone, not at a million of those of all libraries
    return count


@needs_proc
def test_the_memory_does_not_grow_with_the_number_of_calls(make, full_extremes, num_tensors):
    effect, image, growth = make(), frame(), []
    weight = torch.ones((), requires_grad=True)

    def call(key: int) -> None:
        degraded = effect.degrade(image * weight, seed=7, keys=[key])
        degraded.image.sum().backward()
        degraded.valid.sum()
        weight.grad = None

    for key in range(10):
        call(key)
    before = num_tensors()
    # Allocators grow in steps; a leak grows in every stretch.
    for stretch in range(3):
        start = allocated_mb()
        for key in range(CALLS[full_extremes]):
            call(stretch * CALLS[full_extremes] + key)
        growth.append(allocated_mb() - start)
    assert min(growth) < GROWTH[full_extremes], growth
    assert num_tensors() <= before + 2


def test_results_and_effects_are_freed_without_the_garbage_collector(make):
    def use(key: int) -> None:
        degraded = make().degrade(frame(), seed=7, keys=[key])
        maps_of(degraded)
        assert degraded.restore_residual is None or degraded.folding is not None

    use(0)
    gc.collect()
    gc.freeze()  # so that the next collections look at new objects alone
    gc.disable()
    try:
        gc.set_debug(gc.DEBUG_SAVEALL)
        for key in range(3):
            use(key)
        gc.collect()
        cycles = [value for value in gc.garbage if issubclass(type(value), Tensor | tr.Degraded)]
    finally:
        gc.set_debug(0)
        gc.garbage.clear()
        gc.enable()
    assert not cycles


def test_new_sizes_and_new_effects_do_not_keep_tensors(make, num_tensors):
    image = frame(size=(64, WIDTH))
    make().degrade(image[..., :HEIGHT, :], seed=7)
    before = num_tensors()
    for i in range(4):
        rows = HEIGHT if make is EFFECTS["rectification"] else HEIGHT + i
        make().degrade(image[..., :rows, :], seed=7)
    assert num_tensors() <= before + 2


class DegradedFrames(Dataset[dict[str, Any]]):
    """Frames that each worker degrades, with its number and its memory."""

    def __init__(self, effect: Effect, count: int):
        self.effect, self.count = effect, count

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, index: int) -> dict[str, Any]:
        image = self.effect.degrade(frame(index % 16)[0], seed=7, keys=[index]).image
        worker = get_worker_info()
        memory = allocated_mb() if index % 40 < 8 else 0.0
        return {"image": image, "worker": worker.id if worker else -1, "memory": memory}


@pytest.mark.filterwarnings("ignore:.*multi-threaded, use of fork:DeprecationWarning")
@needs_proc
def test_workers_load_the_samples_of_one_process_and_do_not_grow(full_extremes):
    effect = tr.Compose([tr.LensDistortion(), tr.HeterogeneousFog(), tr.ThinPlateSpline(), tr.LensFlare(p=0.5)])
    frames = DegradedFrames(effect, 20_000 if full_extremes else 320)
    memories: dict[int, list[float]] = {}
    loader = DataLoader(frames, batch_size=8, num_workers=2, multiprocessing_context="fork")
    for number, batch in enumerate(loader):
        if number % 12 == 0:
            expected = torch.stack([frames[8 * number + i]["image"] for i in range(8)])
            assert_close_images(batch["image"], expected)
        for worker, memory in zip(batch["worker"].tolist(), batch["memory"].tolist(), strict=True):
            if memory:
                memories.setdefault(worker, []).append(memory)
    assert sorted(memories) == [0, 1]
    for memory in memories.values():
        # Caches are full after a quarter of the run.
        rest = memory[len(memory) // 4 :]
        assert max(rest[len(rest) // 2 :]) - max(rest[: len(rest) // 2]) < 1.6


def pickled(effect: Effect) -> Effect:
    return pickle.loads(pickle.dumps(effect))


def call_in_threads(function: Callable[[int], Any], count: int) -> list[Any]:
    """Call a function with 0 ... count - 1 in threads that start at the same moment."""
    barrier = threading.Barrier(THREADS)

    def call(number: int) -> Any:
        if number < THREADS:
            barrier.wait()
        return function(number)

    with ThreadPoolExecutor(THREADS) as pool:
        return list(pool.map(call, range(count)))


def test_threads_that_share_or_copy_an_effect_get_the_results_and_gradients_of_one_thread(make, full_extremes):
    # A new size for each round of calls, so that some threads make plans while others use or copy them.
    step = 0 if make is EFFECTS["rectification"] else 1
    copies: tuple[Callable[[Effect], Effect], ...] = (lambda effect: effect, copy.deepcopy, pickled)

    def call(effect: Effect, number: int) -> tuple[dict[str, Tensor], Tensor]:
        scale = step * (number // THREADS % 7)
        image = frame(number, size=(HEIGHT + 4 * scale, WIDTH + 6 * scale), batch=2).requires_grad_()
        degraded = copies[number % 3](effect).degrade(image, seed=7, keys=[number, -number])
        (gradient,) = torch.autograd.grad(degraded.image.square().sum(), image)
        return maps_of(degraded), gradient

    results = call_in_threads(partial(call, make()), 2000 if full_extremes else 2 * THREADS)
    effect = make()
    for number, (maps, gradient) in enumerate(results):
        expected_maps, expected_gradient = call(effect, number)
        assert_close_maps(maps, expected_maps)
        torch.testing.assert_close(gradient, expected_gradient, rtol=1e-4, atol=1e-4)


def test_a_result_can_be_copied_while_threads_read_its_maps(make):
    degraded, expected = make().degrade(frame(), seed=7), maps_of(make().degrade(frame(), seed=7))

    def read(number: int) -> dict[str, Tensor]:
        return maps_of(copy.deepcopy(degraded) if number % 2 else degraded)

    for maps in call_in_threads(read, 2 * THREADS):
        assert_close_maps(maps, expected)
