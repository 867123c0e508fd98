"""Work of functions that do without Python's lock, shared among threads, as many as torch has."""

import ctypes
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch

_EACH = 4  # parts for each thread: one that is held up leaves its parts to the others
_Task = ctypes.CFUNCTYPE(None, ctypes.c_void_p)


def share(work: Callable[[int, int], None], count: int, *, least: int) -> None:
    """work(start, stop) for parts of 0 ... count, one after the other or at once.

    Args:
        work: what is to be done for part of the whole.
        count: the whole.
        least: the smallest part that is worth a thread.
    """
    most = count // max(1, least)
    threads = min(torch.get_num_threads(), most)
    if threads < 2:
        work(0, count)
        return
    parts = min(_EACH * threads, most)
    ends = [count * i // parts for i in range(parts + 1)]
    left, failed = iter(list(pairwise(ends))), list[BaseException]()

    def take() -> None:
        try:
            for start, stop in left:
                work(start, stop)
        except BaseException as error:  # what calls this, on other threads, is not of Python
            failed.append(error)

    together = _torchs() or _ours
    together(take, threads)
    if failed:
        raise failed[0]


@cache
def _torchs() -> Callable[[Callable[[], None], int], None] | None:
    """What calls a function on each of torch's own threads, None where they cannot be had.

    Other threads would have to wait for those: after each operation they keep their cores for some milliseconds, in
    case another one follows. On a look-up of 10 ms on two cores that costs as much as the second thread brings.
    """
    try:
        # OpenMP's entry point, of the very library that torch works with.
        parallel = ctypes.CDLL(str(Path(torch.__file__).parent / "lib" / "libtorch_cpu.so")).GOMP_parallel
    except (OSError, AttributeError):
        return None
    parallel.argtypes = [_Task, ctypes.c_void_p, ctypes.c_uint, ctypes.c_uint]
    parallel.restype = None

    def together(take: Callable[[], None], threads: int) -> None:
        parallel(_Task(lambda _: take()), None, threads, 0)

    return together


def _ours(take: Callable[[], None], threads: int) -> None:
    """The function called on threads of our own, of which this is one."""
    others: list[Any] = [_pool().submit(take) for _ in range(threads - 1)]
    take()
    for other in others:
        other.result()


@cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(max_workers=os.cpu_count(), thread_name_prefix="torchrefract")


# A process that is forked has none of the threads.
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_pool.cache_clear)
