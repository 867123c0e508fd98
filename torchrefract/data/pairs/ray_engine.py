"""Work in actors of Ray Data, on this machine or on a cluster: blocks of a lost actor are done again."""

import logging
import os
import pickle
from collections.abc import Callable, Iterable, Iterator
from typing import Any, TypeVar

import pyarrow as pa

from torchrefract._validation import UsageError
from torchrefract.data.workers import use_one_thread

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")

_SILENT: dict[str, Any] = {"include_dashboard": False, "log_to_driver": False, "logging_level": "ERROR"}


def map_in_actors(
    work: Callable[[_Item], _Result],
    items: Iterable[_Item],
    *,
    workers: int,
    address: str | None,
    num_gpus: float = 0,
    block: int = 8,
) -> Iterator[_Result]:
    """Apply a function to items in actors of Ray, each with a core and one thread.

    Args:
        work: can be pickled, and so can its results; called again for an item whose actor was lost.
        items: all are sent to Ray at the start.
        workers: number of actors.
        block: number of items that are done again if their actor is lost.
        address: of a cluster, as Ray takes it; None starts Ray on this machine.
        num_gpus: GPUs of an actor, which sees no others; below 1, actors share one.

    Yields:
        the results, in any order.

    Raises:
        UsageError: this machine has fewer GPUs.
        Exception: any error of `work`.
    """
    import ray  # noqa: PLC0415  # pyright: ignore[reportMissingImports]  # in its own extra
    import ray.data  # noqa: PLC0415  # pyright: ignore[reportMissingImports]  # in its own extra

    logging.getLogger("ray.data").setLevel(logging.ERROR)
    os.environ.setdefault("RAY_BACKEND_LOG_LEVEL", "fatal")  # it prints an error when an actor could restart
    started = not ray.is_initialized()
    if started:
        ray.init(address=address, **_SILENT, **({} if address else {"num_cpus": workers + 1}))
    try:
        if num_gpus:
            _check_gpus(ray.cluster_resources().get("GPU", 0), workers, num_gpus, can_wait=address is not None)
        ray.data.DataContext.get_current().enable_progress_bars = False
        rows = [{"item": pickle.dumps(item)} for item in items]
        blocks = max(workers, -(-len(rows) // block))
        dataset = ray.data.from_items(rows, override_num_blocks=min(blocks, len(rows)))
        dataset = dataset.map_batches(
            _Actor,
            fn_constructor_args=(work,),
            batch_size=1,  # Ray requires a number for GPUs, and joins blocks that are smaller
            batch_format="pyarrow",
            compute=ray.data.ActorPoolStrategy(size=workers),
            num_cpus=1,
            num_gpus=num_gpus or None,
        )
        for batch in dataset.iter_batches(batch_size=None, batch_format="pyarrow", prefetch_batches=0):
            for data in batch["result"].to_pylist():
                result, error = pickle.loads(data)
                if error is not None:
                    raise error
                yield result
    finally:
        if started:
            ray.shutdown()


def _check_gpus(available: float, workers: int, num_gpus: float, *, can_wait: bool) -> None:
    """Raise UsageError if there are too few GPUs; a cluster can grow, so print a line for one."""
    if (fitting := int(available / num_gpus)) >= workers:
        return
    if can_wait:
        print(
            f"the cluster has GPUs for {fitting} of {workers} workers; the others wait for nodes with GPUs", flush=True
        )
        return
    raise UsageError(
        f"engine.num_gpus must be 0 or fit the GPUs of this machine, got {num_gpus} for each of {workers} workers and "
        f"{available:g} GPUs; lower workers"
    )


class _Actor:
    """Does the work of blocks of items in a process of Ray."""

    def __init__(self, work: Callable[[Any], Any]):
        use_one_thread()
        self.work = work

    def __call__(self, block: pa.Table) -> pa.Table:
        results = [self._result(pickle.loads(item)) for item in block["item"].to_pylist()]
        return pa.table({"result": pa.array(map(pickle.dumps, results), pa.binary())})

    def _result(self, item: Any) -> tuple[Any, Exception | None]:
        """Return the result, or the error, which Ray would wrap and print."""
        try:
            return self.work(item), None
        except Exception as error:  # whatever it is, the caller raises it
            return None, error
