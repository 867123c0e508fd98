"""Main functions of the commands. This module imports only the standard library: a bare wheel lacks all others."""

import importlib
import io
import os
import signal
import sys
import textwrap
from collections.abc import Callable

_HELP = ("--help", "-h")
_HYDRA = (
    "Options of Hydra: `--cfg job` prints all options with their values{sweeps}. A file name may hold any letters; "
    "only the shell needs quotes, as in `'OPTION=my drive (1).mp4'`."
)
_SWEEPS = ", `-m` runs each combination of values such as `seed=1,2`"
# Their libraries are in the extra "calibration".
_CAMERA_COMMANDS = ("calibrate", "rectify", "make_board", "estimate_lens")
_EXTRAS = {"onnx": "export", "ray": "ray"}  # by the first letters of a library; that of all others is "train"


def command(name: str, page: str | None, function: str, *, has_sweeps: bool = True) -> Callable[[], None]:
    """Return the main function of `python -m torchrefract.<name>`.

    Args:
        name: of the module, and of its file in conf.
        page: the help page, which `--help` prints with the options of Hydra below.
        function: as "module:name", with the module in torchrefract.cli. It is called with the configuration.
        has_sweeps: True for a command that the option `-m` runs for several values.
    """

    def main() -> None:
        # A redirected output has few letters on Windows, and a name with others would stop a run.
        if isinstance(sys.stdout, io.TextIOWrapper) and sys.stdout.errors == "strict":
            sys.stdout.reconfigure(errors="backslashreplace")
        if any(argument in _HELP for argument in sys.argv[1:]):
            options = _HYDRA.format(sweeps=_SWEEPS if has_sweeps else "")
            print(f"{(page or '').strip()}\n\n{textwrap.fill(options, 120)}")
            return
        module, _, attribute = function.partition(":")
        try:
            run = importlib.import_module("torchrefract.cli.command").run
            job = getattr(importlib.import_module(f"torchrefract.cli.{module}"), attribute)
        except ModuleNotFoundError as error:
            if (message := missing_library(error, name)) is None:
                raise
            print(f"error: {message}", file=sys.stderr)
            raise SystemExit(1) from error
        except KeyboardInterrupt:
            print("stopped", file=sys.stderr)
            raise SystemExit(128 + signal.SIGINT) from None
        run(name, job)

    return main


def is_first_process() -> bool:
    """Return True in the first of the processes that Lightning or torchrun starts on a machine, and without those."""
    return os.environ.get("LOCAL_RANK", "0") == "0"


def missing_library(error: ModuleNotFoundError, name: str) -> str | None:
    """Return the error message of a command if a library is not installed; None if the module is of torchrefract."""
    library = (error.name or "").partition(".")[0]
    if library in ("", "torchrefract"):
        return None
    extras = {"playground": "playground"} | dict.fromkeys(_CAMERA_COMMANDS, "calibration")
    extra = extras.get(name) or _EXTRAS.get(library[:4], "train")
    return f"{name} needs {library}, which is not installed: pip install 'torchrefract[{extra}]'"
