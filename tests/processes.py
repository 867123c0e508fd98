"""Commands in processes of their own, which tests interrupt or kill."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]


@contextmanager
def running(*words: str, cwd: Path | None = None, stdout: int = subprocess.DEVNULL) -> Iterator[subprocess.Popen[str]]:
    """Run Python in a session of its own, on one thread, with a pipe for its errors; kill it at the end."""
    environment = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    options: dict[str, Any] = {"cwd": cwd, "env": environment, "stdout": stdout, "stderr": subprocess.PIPE}
    # A shell lets programs in the background ignore an interrupt.
    options["preexec_fn"] = partial(signal.signal, signal.SIGINT, signal.SIG_DFL)
    with subprocess.Popen([sys.executable, *words], text=True, start_new_session=True, **options) as process:
        try:
            yield process
        finally:
            process.kill()


def wait_for(condition: Callable[[], Any], process: subprocess.Popen[str] | None = None) -> None:
    """Wait until a condition holds or the process ends, for at most 200 s."""
    end = time.monotonic() + 200
    while not condition() and (process is None or process.poll() is None):
        assert time.monotonic() < end, "nothing happened in 200 s"
        time.sleep(0.02)
