"""Shared code of the entry points: one line for an error that the user can fix, a traceback for any other."""

import difflib
import errno
import logging
import os
import re
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar, cast

import hydra
from hydra.core.override_parser.types import Quote, QuotedString
from hydra.errors import HydraException, InstantiationException, MissingConfigException
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import MissingMandatoryValue, OmegaConfBaseException
from rich.console import Console
from rich.progress import track
from yaml import YAMLError

from torchrefract._io import CONFIG_DIR
from torchrefract._validation import UsageError
from torchrefract.data.images import UnreadableImageError
from torchrefract.data.pairs.files import DamagedPairError

_T = TypeVar("_T")
_Prepare = Callable[[str, list[str]], list[str]]  # (command, arguments) -> arguments

_NUM_SEEDS = 2**32  # NumPy's limit
_FILE_ERRORS = (UnreadableImageError, DamagedPairError)  # their messages name the file
_INFORMATION_OPTIONS = ("--help", "-h", "--hydra-help", "--info", "--shell-completion", "-sc")
_TASK_OPTIONS = ("+task=", "++task=", "+experiment=", "++experiment=")  # an experiment chooses its task
# Options of Hydra whose value is the next argument.
_OPTIONS_WITH_VALUE = ("--config-dir", "-cd", "--config-name", "-cn", "--config-path", "-cp", "--cfg", "-c")
_OPTIONS_WITH_VALUE += ("--package", "-p", "--info", "-i", "--experimental-rerun")
_UNKNOWN_OPTION = re.compile(r"Could not override '(\w+)'")
# Warnings of libraries about settings that are intended.
_IGNORED_WARNINGS = (
    ".*does not have many workers.*",
    ".*LeafSpec.*",
    ".*smaller than the logging interval.*",
    ".*exists and is not empty.*",
    ".*dirpath has changed.*",
    "Glyph .* missing from font.*",
    ".*local_dir_use_symlinks.*",
    ".*callbacks used to create the checkpoint.*",
)


def command(
    name: str, function: Callable[[DictConfig], None], *, prepare: _Prepare | None = None
) -> Callable[[], None]:
    """Return the main function of `python -m torchrefract.<name>`.

    Args:
        name: of the module, and of its file in conf.
        function: called with the configuration.
        prepare: changes or checks the command-line arguments before Hydra parses them.
    """

    def job(cfg: DictConfig) -> None:
        with _one_line_errors(name):  # Hydra would add lines to an error that leaves this function
            function(cfg)

    job.__module__ = f"torchrefract.{name}"  # Hydra names the job by it

    def main() -> None:
        logging.getLogger("pytorch_lightning").setLevel(logging.WARNING)
        for message in _IGNORED_WARNINGS:
            warnings.filterwarnings("ignore", message)
        os.environ["HYDRA_FULL_ERROR"] = "1"  # Hydra then raises its errors instead of printing them
        with _one_line_errors(name):
            if prepare is not None:
                sys.argv[1:] = prepare(name, sys.argv[1:])
            hydra.main(config_path=CONFIG_DIR, config_name=name, version_base="1.3")(job)()

    return main


def require_task(name: str, arguments: list[str]) -> list[str]:
    """Return the arguments if they choose a task or an experiment, or ask for information only.

    Raises:
        UsageError: if no task is chosen, or `task=` lacks its plus.
    """
    if any(argument in _INFORMATION_OPTIONS for argument in arguments):
        return arguments
    example = f"python -m torchrefract.{name}"
    for argument in arguments:
        if argument.startswith("task="):
            raise UsageError(f"{argument} needs a plus, since no task is chosen yet: {example} +{argument}")
    if not any(argument.startswith(_TASK_OPTIONS) for argument in arguments):
        tasks = sorted(path.stem for path in Path(CONFIG_DIR, "task").glob("*.yaml"))
        raise UsageError(f"+task must be one of {', '.join(tasks)}: {example} +task={tasks[-1]}, got none")
    return arguments


def picture_as_option(name: str, arguments: list[str]) -> list[str]:
    """Turn the bare argument that names a picture into `image=<argument>`.

    Raises:
        UsageError: if several arguments name pictures.
    """
    pictures = [
        i
        for i, argument in enumerate(arguments)
        if _is_picture(argument) and (i == 0 or arguments[i - 1] not in _OPTIONS_WITH_VALUE)
    ]
    if len(pictures) > 1:
        names = " and ".join(arguments[i] for i in pictures)
        raise UsageError(f"{name} must have one picture, in quotes if its name has spaces, got {names}")
    return [f"image={_quote(argument)}" if i in pictures else argument for i, argument in enumerate(arguments)]


def quote_option(option: str) -> _Prepare:
    """Return a `prepare` for `command` that takes the value of an option as text: commas and brackets mean nothing."""

    def quote(argument: str) -> str:
        name, _, text = argument.partition("=")
        is_plain = name == option and text not in ("", "null") and text[0] not in "'\""
        return f"{option}={_quote(text)}" if is_plain else argument

    return lambda name, arguments: [quote(argument) for argument in arguments]


def check_seed(seed: Any) -> int:
    """Return `seed` if NumPy and PyTorch accept it."""
    if not isinstance(seed, int) or not 0 <= seed < _NUM_SEEDS:
        raise UsageError(f"seed must be a whole number from 0 to {_NUM_SEEDS - 1}, got {seed}")
    return seed


def make(cfg: DictConfig, part: str) -> Any:
    """Instantiate a part of a configuration."""
    with naming(part):
        try:
            return instantiate(cfg[part])
        except InstantiationException as error:
            raise error.__cause__ or error from None


@contextmanager
def naming(part: str) -> Iterator[None]:
    """Turn errors of values inside the block into UsageError, with the name of a part of the configuration.

    Errors of files stay as they are, since they name the file.
    """
    try:
        yield
    except _FILE_ERRORS:
        raise
    except (ValueError, TypeError, OSError) as error:
        raise UsageError(f"{part}: {error}") from error


def progress(items: Iterable[_T], name: str, *, count: int) -> Iterable[_T]:
    """Return `count` items that show a progress bar with a name while they are taken, in a terminal only."""
    console = Console(stderr=True)
    return track(items, name, total=count, console=console, transient=True, disable=not console.is_terminal)


def _is_picture(argument: str) -> bool:
    # The name of a file may contain the syntax of Hydra, so an existing file is always a picture.
    return not argument.startswith("-") and (
        os.path.isfile(argument) or not ("=" in argument or argument.startswith("~"))
    )


def _quote(text: str) -> str:
    """Quote a text for Hydra's grammar and OmegaConf's interpolation."""
    return QuotedString(re.sub(r"(\\*)\$\{", r"\1\1\\${", text), Quote.single).with_quotes()


@contextmanager
def _one_line_errors(name: str) -> Iterator[None]:
    """Print an error that the user can fix as one line and end the program; raise any other again."""
    try:
        yield
    except Exception as error:
        if (message := _user_message(error, name)) is None:
            raise
        print(f"error: {message}", file=sys.stderr)
        raise SystemExit(1) from error


def _user_message(error: Exception, name: str) -> str | None:
    """Return one line for an error that the user of a command can fix, None for any other."""
    if isinstance(error, MissingConfigException) and error.missing_cfg_file:
        group, _, option = error.missing_cfg_file.rpartition("/")
        return f"{group} must be one of {', '.join(error.options or [])}, got {option}"
    if isinstance(error, MissingMandatoryValue):
        return f"{error.full_key} must be given, as in {error.full_key}=…, got nothing"
    if isinstance(error, _FILE_ERRORS):
        return str(error).strip().splitlines()[-1].split("Error: ", 1)[-1]  # a worker prepends its traceback
    if isinstance(error, UsageError | HydraException | OmegaConfBaseException | YAMLError):
        unknown = _UNKNOWN_OPTION.match(str(error))
        return _unknown_option(name, unknown[1]) if unknown else " ".join(str(error).split())
    if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES):
        return f"{error.filename or 'a file'} could not be written: {error.strerror}"
    return None


def _unknown_option(name: str, option: str) -> str:
    options = _options(name)
    similar = difflib.get_close_matches(option, options, n=1)
    hint = f"; did you mean {similar[0]}?" if similar else ""
    return f"an option must be one of {', '.join(options)}, got {option}{hint}"


def _options(name: str) -> list[str]:
    """Return the names before "=" that a command accepts: keys and groups of its configuration."""
    config = cast(DictConfig, OmegaConf.load(Path(CONFIG_DIR, f"{name}.yaml")))
    options = [str(key) for key in config if key not in ("defaults", "hydra")]
    given = dict(argument.split("=", 1) for argument in sys.argv[1:] if "=" in argument)
    for part in config.defaults:
        for group, choice in part.items() if isinstance(part, DictConfig) else ():
            file = Path(CONFIG_DIR, str(group), f"{given.get(str(group), choice)}.yaml")
            if group != "hydra" and not str(group).startswith("override"):
                options.append(str(group))
            if file.is_file() and file.read_text(encoding="utf-8").startswith("# @package _global_"):
                options += [str(key) for key in OmegaConf.load(file)]
    return list(dict.fromkeys(options))
