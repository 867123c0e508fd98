"""Work in processes of one thread each, which end with the process that started them."""

import atexit
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import forkserver
from multiprocessing.context import BaseContext
from typing import Any, TypeVar

import cv2
import torch

from torchrefract._validation import UsageError

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")

_QUEUED_ITEMS = 2  # for each worker, so that none waits
_PATIENCE = 10.0  # seconds that daemons have to end, which may not be of this library


def map_in_processes(
    work: Callable[[_Item], _Result], items: Iterable[_Item], *, workers: int, preload: str
) -> Iterator[_Result]:
    """Apply a function to items in processes, or in this one with `workers` 0.

    Args:
        work: can be pickled, and so can its results.
        items: read when a worker is about to be free.
        workers: number of processes.
        preload: module that the server of the processes imports once, so that not each of them does.

    Yields:
        the results, in any order.

    Raises:
        UsageError: a worker was killed.
        Exception: any error of a worker, after the others have finished their items.
    """
    if workers == 0:
        use_one_thread()
        yield from map(work, items)
        return
    pool = ProcessPoolExecutor(workers, mp_context=_context(preload), initializer=_start, initargs=(work,))
    pending = set[Future[_Result]]()
    try:
        for item in items:
            with held_signal(signal.SIGINT):  # a process that is interrupted while it starts would go on
                pending.add(pool.submit(_work, item))
            if len(pending) >= _QUEUED_ITEMS * workers:
                done, pending = wait(pending, return_when=FIRST_COMPLETED)
                yield from (future.result() for future in done)
        while pending:
            done, pending = wait(pending, return_when=FIRST_COMPLETED)
            yield from (future.result() for future in done)
    except BrokenProcessPool as error:
        raise UsageError(
            f"workers must fit the memory, got {workers} of which one was killed; files that are written stay, and the "
            "same command continues"
        ) from error
    finally:
        pool.shutdown(cancel_futures=True)


def use_one_thread() -> None:
    """Limit PyTorch and OpenCV to one thread in this process."""
    torch.set_num_threads(1)
    cv2.setNumThreads(1)


def ignore_sigterm(worker: int) -> None:
    """Leave SIGTERM to the training process, as `worker_init_fn` of a DataLoader, whose workers end with that process.

    SLURM and systemd send the signal to all processes of a job; a worker that ended first would stop the training
    before it has saved its checkpoint.
    """
    signal.signal(signal.SIGTERM, signal.SIG_IGN)


@atexit.register  # behind the function of multiprocessing, and so it is called before that
def _end_daemons() -> None:
    """End the daemons of this process as Python does, but kill those that ignore SIGTERM, for which it would wait."""
    daemons = [process for process in multiprocessing.active_children() if process.daemon]
    if daemons and hasattr(signal, "SIGCHLD"):
        signal.signal(signal.SIGCHLD, signal.SIG_DFL)  # PyTorch's handler raises for a worker that is killed
    for process in daemons:
        process.terminate()
    end = time.monotonic() + _PATIENCE
    for process in daemons:
        process.join(max(0.0, end - time.monotonic()))
        process.kill()


def exit_with_parent(parent: int) -> None:
    """Exit this process when its parent, the first one of a training, is killed; it would wait for half an hour."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(1)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def num_cores() -> int:
    """Return the number of cores for this process; processes that torchrun started on one machine share them."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, cores // int(os.environ.get("LOCAL_WORLD_SIZE", "1")))


def _context(preload: str) -> BaseContext:
    """Choose the start method of workers: forking this process, which has threads, could hang."""
    if "forkserver" not in multiprocessing.get_all_start_methods():
        return multiprocessing.get_context("spawn")
    multiprocessing.set_forkserver_preload([preload])
    with _handled(signal.SIGINT, signal.SIG_IGN):  # its server would print a traceback for Ctrl-C while it imports
        forkserver.ensure_running()
    return multiprocessing.get_context("forkserver")


@contextmanager
def held_signal(number: int) -> Iterator[None]:
    """Hold back a signal until the end of the block."""
    received: list[int] = []
    with _handled(number, lambda number, _: received.append(number)):
        yield
    if received:
        signal.raise_signal(number)


@contextmanager
def _handled(number: int, handler: Any) -> Iterator[None]:
    """Handle a signal in another way; processes that are started ignore it too if the handler is SIG_IGN."""
    if threading.current_thread() is not threading.main_thread():  # only there a handler can be set
        yield
        return
    before = signal.signal(number, handler)
    try:
        yield
    finally:
        signal.signal(number, before)


class _Worker:
    """The state of a worker process between items."""

    work: Callable[[Any], Any]


def _start(work: Callable[[Any], Any]) -> None:
    use_one_thread()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent stops its workers
    threading.Thread(target=_exit_with_parent, daemon=True).start()
    _Worker.work = work


def _exit_with_parent() -> None:
    """Exit if the parent is killed; otherwise the worker could write at the same time as the next run."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _work(item: Any) -> Any:
    return _Worker.work(item)
