"""Units of pairs made by several processes, no more than a few of them at a time."""

import multiprocessing
import os
import signal
import threading
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import forkserver
from multiprocessing.context import BaseContext

import cv2
import torch

from torchrefract._validation import UsageError
from torchrefract.data.pair_manifest import PairRow
from torchrefract.data.pairs.making import Job, Maker, Recipe
from torchrefract.data.pairs.writing import Store

_AHEAD = 2  # units for each worker, made or waiting


def run(units: Iterable[Sequence[Job]], recipe: Recipe, store: Store, *, workers: int) -> Iterator[list[PairRow]]:
    """Make and write units; yields the rows of each when it is written, in no order.

    Args:
        units: of `store`.
        recipe: of the pairs.
        store: where they go.
        workers: processes, after `make_ready`; until they have started this one makes pairs, and all where they are 0.

    Raises:
        UsageError: a worker that died.
        Exception: what a worker raised, after the others have finished what they are at.
    """
    if workers == 0:
        maker = Maker(recipe)
        yield from (store.write(unit, maker) for unit in units)
        return
    pool = ProcessPoolExecutor(workers, mp_context=_context(), initializer=_start, initargs=(recipe, store))
    try:
        # The first one waits for what workers are forked off to have imported all.
        start = threading.Thread(target=pool.submit, args=(os.getpid,), daemon=True)
        start.start()
        units, maker = iter(units), Maker(recipe)
        while start.is_alive() and (unit := next(units, None)) is not None:
            yield store.write(unit, maker)
        start.join()
        waiting = set[Future[list[PairRow]]]()
        for unit in units:
            waiting.add(pool.submit(_write, unit))
            if len(waiting) >= _AHEAD * workers:
                done, waiting = wait(waiting, return_when=FIRST_COMPLETED)
                yield from (future.result() for future in done)
        while waiting:
            done, waiting = wait(waiting, return_when=FIRST_COMPLETED)
            yield from (future.result() for future in done)
    except BrokenProcessPool as error:
        raise UsageError(
            f"workers must leave memory for each, got {workers} of which one was killed, as for lack of memory; what "
            "is written stays, and the same command goes on"
        ) from error
    finally:
        pool.shutdown(cancel_futures=True)


def make_ready() -> None:
    """Let what workers import be imported beside what this process does before it has work for them.

    That takes one core: threads that wait for each other would wait for it.
    """
    work_alone()
    if "forkserver" in multiprocessing.get_all_start_methods():
        # All that the command imports beside itself, since each worker imports the command again.
        preloaded = [
            __name__,
            "torchrefract.cli.command",
            "torchrefract.data.pairs.card",
            "torchrefract.data.pairs.ledger",
        ]
        multiprocessing.set_forkserver_preload(preloaded)
        forkserver.ensure_running()


def _context() -> BaseContext:
    """Workers are forked off a process that has imported what they need, and computed nothing yet.

    A fork of this process, which has threads, may hang; spawned ones would each import everything anew.
    """
    there = "forkserver" in multiprocessing.get_all_start_methods()
    return multiprocessing.get_context("forkserver" if there else "spawn")


class _Worker:
    """What a worker process keeps between units."""

    maker: Maker
    store: Store


def _start(recipe: Recipe, store: Store) -> None:
    work_alone()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent ends its workers itself
    threading.Thread(target=_end_with_parent, daemon=True).start()
    _Worker.maker, _Worker.store = Maker(recipe), store


def work_alone() -> None:
    """Make pairs as fast as one thread can: as many workers as cores leave nothing for more."""
    torch.set_num_threads(1)
    cv2.setNumThreads(1)


def _end_with_parent() -> None:
    """Else workers of a parent that was killed would wait for it for ever, or write beside its successor."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _write(unit: Sequence[Job]) -> list[PairRow]:
    return _Worker.store.write(unit, _Worker.maker)
