"""What the commands share: one line for what a user can mend, a traceback for what only we can."""

import atexit
import difflib
import errno
import logging
import os
import re
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import wraps
from pathlib import Path
from typing import Any, TypeVar, cast

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
_OF_FILES = (UnreadableImageError, DamagedPairError)
_INFORMING = ("--help", "-h", "--hydra-help", "--info", "--shell-completion", "-sc")
_CHOOSING = ("+task=", "++task=", "+experiment=", "++experiment=")
_UNKNOWN = re.compile(r"Could not override '(\w+)'")
_SEEDS = 2**32  # as many as numpy takes
# Advice of libraries on what is meant so here.
_HINTS = (
    ".*does not have many workers.*",
    ".*LeafSpec.*",
    ".*smaller than the logging interval.*",
    ".*exists and is not empty.*",
    ".*dirpath has changed.*",
    "Glyph .* missing from font.*",
    ".*local_dir_use_symlinks.*",
    ".*callbacks used to create the checkpoint.*",
)
# The options of Hydra whose value is the next word.
_TAKING = ("--config-dir", "-cd", "--config-name", "-cn", "--config-path", "-cp", "--cfg", "-c", "--package", "-p")
_TAKING += ("--info", "-i", "--experimental-rerun")


def with_task(name: str, words: list[str]) -> list[str]:
    """The words of `python -m torchrefract.<name>` as they are, if they choose a task or only ask for information.

    An experiment chooses its task itself.
    """
    if any(word in _INFORMING for word in words):
        return words
    listed = ", ".join(tasks())
    for word in words:
        if word.startswith("task="):
            raise UsageError(f"{word} needs a plus, since no task is chosen yet: python -m torchrefract.{name} +{word}")
    if not any(word.startswith(_CHOOSING) for word in words):
        raise UsageError(f"+task must be one of {listed}: python -m torchrefract.{name} +task={tasks()[-1]}, got none")
    return words


def with_picture(name: str, words: list[str]) -> list[str]:
    """The words of `python -m torchrefract.<name>`, with a bare one that names a picture turned into `image=<word>`."""
    pictures = [i for i, word in enumerate(words) if _is_picture(word) and (i == 0 or words[i - 1] not in _TAKING)]
    if len(pictures) > 1:
        several = " and ".join(words[i] for i in pictures)
        raise UsageError(f"{name} must have one picture, in quotes if its name has spaces, got {several}")
    return [f"image={_quoted(word)}" if i in pictures else word for i, word in enumerate(words)]


def as_they_are(name: str, words: list[str]) -> list[str]:
    """The words of `python -m torchrefract.<name>`, where every one of them has its own name."""
    return words


def with_text(option: str) -> Callable[[str, list[str]], list[str]]:
    """For `command`: what is given for an option is a text, in which commas and brackets mean nothing."""

    def prepare(name: str, words: list[str]) -> list[str]:
        return [_as_text(word) if word.startswith(f"{option}=") else word for word in words]

    return prepare


def command(
    name: str, *, prepare: Callable[[str, list[str]], list[str]] = with_task
) -> Callable[[Callable[[], None]], Callable[[], None]]:
    """Decorates the Hydra main function of `python -m torchrefract.<name>`: prepares its words, shortens its errors."""

    def decorate(main: Callable[[], None]) -> Callable[[], None]:
        @wraps(main)
        def run() -> None:
            _quieten()
            # With this, Hydra hands on its errors instead of printing them in its own form.
            os.environ["HYDRA_FULL_ERROR"] = "1"
            with _one_line_errors(name):
                sys.argv[1:] = prepare(name, sys.argv[1:])
                main()

        return run

    return decorate


def job(function: Callable[[DictConfig], None]) -> Callable[[DictConfig], None]:
    """Decorates the function that Hydra calls: its errors end the program before Hydra adds lines to them."""

    @wraps(function)
    def run(cfg: DictConfig) -> None:
        with _one_line_errors():
            function(cfg)

    return run


def leave() -> None:
    """End the program as Python does, but that it leaves what is in memory to the system.

    To take all of PyTorch apart takes half a second, for nothing.
    """
    atexit._run_exitfuncs()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(0)


def check_seed(seed: Any) -> int:
    """`seed` if a command can take it."""
    if not isinstance(seed, int) or not 0 <= seed < _SEEDS:
        raise UsageError(f"seed must be a whole number from 0 to {_SEEDS - 1}, got {seed}")
    return seed


def tasks() -> list[str]:
    """The names of the tasks that conf/task holds."""
    return sorted(path.stem for path in Path(CONFIG_DIR, "task").glob("*.yaml"))


def make(cfg: DictConfig, part: str) -> Any:
    """What a part of a configuration instantiates to."""
    with naming(part):
        try:
            return instantiate(cfg[part])
        except InstantiationException as error:
            raise error.__cause__ or error from None


@contextmanager
def naming(part: str) -> Iterator[None]:
    """Errors of values inside the block are the user's, in the part of the configuration that is named.

    Those of a file, which they name, stay as they are.
    """
    try:
        yield
    except _OF_FILES:
        raise
    except (ValueError, TypeError, OSError) as error:
        raise UsageError(f"{part}: {error}") from error


def progress(items: Iterable[_T], name: str, *, count: int) -> Iterable[_T]:
    """The items, so many, with a line of progress of that name where somebody watches."""
    console = Console(stderr=True)
    return track(items, name, total=count, console=console, transient=True, disable=not console.is_terminal)


def _is_picture(word: str) -> bool:
    # A name may hold what is not its own in Hydra's grammar, so a file that is there is always meant.
    return not word.startswith("-") and (os.path.isfile(word) or not ("=" in word or word.startswith("~")))


def _as_text(word: str) -> str:
    """The word with its value in quotes, unless it has some, or is nothing."""
    option, _, text = word.partition("=")
    return word if text in ("", "null") or text[0] in "'\"" else f"{option}={_quoted(text)}"


def _quoted(text: str) -> str:
    """`text` so that Hydra's grammar and OmegaConf's interpolation hand it on letter by letter."""
    return QuotedString(re.sub(r"(\\*)\$\{", r"\1\1\\${", text), Quote.single).with_quotes()


def _mendable(error: Exception, name: str) -> str | None:
    """One line for an error of the user's with the command of a name, None for one of ours."""
    if isinstance(error, MissingConfigException) and error.missing_cfg_file:
        group, _, option = error.missing_cfg_file.rpartition("/")
        return f"{group} must be one of {', '.join(error.options or [])}, got {option}"
    if isinstance(error, MissingMandatoryValue):
        return f"{error.full_key} must be given, as in {error.full_key}=…, got nothing"
    if isinstance(error, _OF_FILES):
        return str(error).strip().splitlines()[-1].split("Error: ", 1)[-1]  # a worker prepends its traceback
    if isinstance(error, UsageError | HydraException | OmegaConfBaseException | YAMLError):
        unknown = _UNKNOWN.match(str(error)) if name else None
        return _no_option(name, unknown[1]) if unknown else " ".join(str(error).split())
    if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES):
        return f"{error.filename or 'a file'} could not be written: {error.strerror}"
    return None


def _no_option(name: str, word: str) -> str:
    """The error for a word before "=" that a command does not know."""
    options = _options(name)
    near = difflib.get_close_matches(word, options, n=1)
    hint = f"; did you mean {near[0]}?" if near else ""
    return f"an option must be one of {', '.join(options)}, got {word}{hint}"


def _options(name: str) -> list[str]:
    """The words before "=" that a command knows: of its configuration, and of the choices that add to it."""
    plain = cast(DictConfig, OmegaConf.load(Path(CONFIG_DIR, f"{name}.yaml")))
    options = [str(key) for key in plain if key not in ("defaults", "hydra")]
    said = dict(word.split("=", 1) for word in sys.argv[1:] if "=" in word)
    for part in plain.defaults:
        for group, choice in part.items() if isinstance(part, DictConfig) else ():
            file = Path(CONFIG_DIR, str(group), f"{said.get(str(group), choice)}.yaml")
            if group != "hydra" and not str(group).startswith("override"):
                options.append(str(group))
            if file.is_file() and file.read_text(encoding="utf-8").startswith("# @package _global_"):
                options += [str(key) for key in OmegaConf.load(file)]
    return list(dict.fromkeys(options))


@contextmanager
def _one_line_errors(name: str = "") -> Iterator[None]:
    try:
        yield
    except Exception as error:  # what a user cannot mend is raised again
        if (message := _mendable(error, name)) is None:
            raise
        print(f"error: {message}", file=sys.stderr)
        raise SystemExit(1) from error


def _quieten() -> None:
    logging.getLogger("pytorch_lightning").setLevel(logging.WARNING)
    for hint in _HINTS:
        warnings.filterwarnings("ignore", hint)
