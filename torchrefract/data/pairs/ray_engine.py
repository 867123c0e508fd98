"""Work in actors of Ray Data, on this machine or on a cluster: blocks of a lost actor are done again."""

import logging
import os
import pickle
import socket
import time
from collections.abc import Callable, Iterable, Iterator
from typing import Any, TypeVar

import pyarrow as pa

from torchrefract._validation import UsageError
from torchrefract.data.workers import use_one_thread

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")

_CONNECT_SECONDS = 15.0  # a cluster that is being started has this long to answer
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
        UsageError: this machine has fewer GPUs, or Ray cannot join the cluster.
        Exception: any error of `work`.
    """
    import ray  # noqa: PLC0415  # pyright: ignore[reportMissingImports]  # in its own extra
    import ray.data  # noqa: PLC0415  # pyright: ignore[reportMissingImports]  # in its own extra

    logging.getLogger("ray.data").setLevel(logging.ERROR)
    os.environ.setdefault("RAY_BACKEND_LOG_LEVEL", "fatal")  # it prints an error when an actor could restart
    started = not ray.is_initialized()
    if started and address:
        _join_cluster(address)
    elif started:
        ray.init(address="local", num_cpus=workers + 1, **_SILENT)
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


def check_cluster(address: str) -> None:
    """Say that a cluster is being reached, and wait until something answers at its address HOST:PORT.

    Ray would try for minutes without a word. An address without a port, such as auto, is left to Ray.

    Raises:
        UsageError: nothing answers within 15 s.
    """
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if not port.isdecimal():
        return
    print(f"connecting to Ray at {address}", flush=True)
    end = time.monotonic() + _CONNECT_SECONDS
    while True:
        try:
            socket.create_connection((host.strip("[]"), int(port)), max(1.0, end - time.monotonic())).close()
            return
        except (OSError, OverflowError) as error:  # the latter for a port above 65535
            if time.monotonic() > end - 1:
                raise _cluster_error(
                    address, f"{getattr(error, 'strerror', None) or error}, tried for {_CONNECT_SECONDS:.0f} s"
                ) from error
        time.sleep(1)


def _join_cluster(address: str) -> None:
    import ray  # noqa: PLC0415  # pyright: ignore[reportMissingImports]  # in its own extra

    try:
        ray.init(address=address, **_SILENT)
    # Ray ends the process if something else than Ray answers.
    except (ConnectionError, RuntimeError, ValueError, SystemExit) as error:
        raise _cluster_error(address, "no Ray" if isinstance(error, SystemExit) else f"{error}".rstrip(".")) from error


def _cluster_error(address: str, reason: str) -> UsageError:
    return UsageError(
        f"engine.address must be that of a running cluster of Ray, got {address} ({reason}); `ray start --head` starts "
        "one and prints its address"
    )


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
