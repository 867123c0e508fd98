"""Generation of pairs in several processes."""

import multiprocessing
import os
import signal
import threading
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from multiprocessing.context import BaseContext

import cv2
import torch

from torchrefract._validation import UsageError
from torchrefract.data.pairs.generator import GenerationConfig, PairGenerator, PairTask
from torchrefract.data.pairs.manifest import PairRow
from torchrefract.data.pairs.storage import PairStorage

_QUEUED_UNITS = 2  # for each worker, so that none waits


def generate_pairs(
    units: Iterable[Sequence[PairTask]], config: GenerationConfig, storage: PairStorage, *, workers: int
) -> Iterator[list[PairRow]]:
    """Generate and write units of pairs; yield the rows of each when it is written, in any order.

    Args:
        units: of `storage`.
        config: of the pairs.
        storage: writes them.
        workers: number of processes; 0 to generate the pairs in this process.

    Raises:
        UsageError: a worker was killed.
        Exception: any error of a worker, after the others have finished their units.
    """
    if workers == 0:
        use_one_thread()
        generator = PairGenerator(config)
        yield from (storage.write(unit, generator) for unit in units)
        return
    pool = ProcessPoolExecutor(workers, mp_context=_context(), initializer=_start, initargs=(config, storage))
    pending = set[Future[list[PairRow]]]()
    try:
        for unit in units:
            pending.add(pool.submit(_write, unit))
            if len(pending) >= _QUEUED_UNITS * workers:
                done, pending = wait(pending, return_when=FIRST_COMPLETED)
                yield from (future.result() for future in done)
        while pending:
            done, pending = wait(pending, return_when=FIRST_COMPLETED)
            yield from (future.result() for future in done)
    except BrokenProcessPool as error:
        raise UsageError(
            f"workers must fit the memory, got {workers} of which one was killed; pairs that are written stay, and the "
            "same command continues"
        ) from error
    finally:
        pool.shutdown(cancel_futures=True)


def use_one_thread() -> None:
    """Limit PyTorch and OpenCV to one thread in this process."""
    torch.set_num_threads(1)
    cv2.setNumThreads(1)


def _context() -> BaseContext:
    """Choose the start method of workers: forking this process, which has threads, could hang."""
    if "forkserver" not in multiprocessing.get_all_start_methods():
        return multiprocessing.get_context("spawn")
    multiprocessing.set_forkserver_preload([__name__])  # imported once, not in each worker
    return multiprocessing.get_context("forkserver")


class _Worker:
    """The state of a worker process between units."""

    generator: PairGenerator
    storage: PairStorage


def _start(config: GenerationConfig, storage: PairStorage) -> None:
    use_one_thread()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent stops its workers
    threading.Thread(target=_exit_with_parent, daemon=True).start()
    _Worker.generator, _Worker.storage = PairGenerator(config), storage


def _exit_with_parent() -> None:
    """Exit if the parent is killed; otherwise the worker could write at the same time as the next run."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _write(unit: Sequence[PairTask]) -> list[PairRow]:
    return _Worker.storage.write(unit, _Worker.generator)
