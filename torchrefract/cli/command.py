"""Shared code of the entry points: one line for an error that the user can fix, a traceback for any other."""

import difflib
import errno
import logging
import os
import re
import signal
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, cast

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.types import Quote, QuotedString
from hydra.errors import HydraException, MissingConfigException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import ConfigAttributeError, MissingMandatoryValue, OmegaConfBaseException
from yaml import YAMLError

from torchrefract._io import CONFIG_DIR, config_names
from torchrefract._validation import UsageError
from torchrefract.cli.entry import is_first_process, missing_library
from torchrefract.cli.options import FILE_ERRORS

_WRITING_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EFBIG)
_WRITING_ERRORS += (errno.EEXIST, errno.ENOTDIR, errno.ENAMETOOLONG)  # a file has the name of the folder, and the like
_INFORMATION_OPTIONS = ("--hydra-help", "--info", "--shell-completion", "-sc")
_MULTIRUN = ("-m", "--multirun")
# Options whose value is text, mostly the path of a file: Hydra's syntax in it means nothing. The model of robustness is
# a file or a function, that of other commands the choice of a group, without a dot.
_TEXT_OPTION = re.compile(
    r"(\+{0,2}(?:image|images|input|data|labels|weights|source|files|depth|network|checkpoint|camera|scene\.camera|base|out|ckpt_path|init_from|license|run_dir|data\.root|data\.depth|hydra\.run\.dir"
    r"|model(?==.*[./])|hydra\.sweep\.dir|hydra\.sweep\.subdir|model\.network\.pretrained))=(.*)",
    re.DOTALL,
)
_SWEEP = re.compile(r"(choice|range|interval|glob|sort|shuffle|tag)\(.*\)")
_TASK_OPTIONS = ("+task=", "++task=", "+experiment=", "++experiment=")  # an experiment chooses its task
# Options of Hydra whose value is the next argument.
_OPTIONS_WITH_VALUE = ("--config-dir", "-cd", "--config-name", "-cn", "--config-path", "-cp", "--cfg", "-c")
_OPTIONS_WITH_VALUE += ("--package", "-p", "--info", "-i", "--experimental-rerun")
_ADDRESS = r"=['\"]?([A-Za-z][\w+.-]*://.*?)['\"]?$"
_REMOTE = {  # options that may be an address, and what to do if they must not be one
    re.compile(r"\+*(out|run_dir|hydra\.(?:run|sweep)\.dir)" + _ADDRESS): "write to a folder and copy it",
    re.compile(r"(input|source|images?|labels|depth|camera|base)" + _ADDRESS): "copy it to a folder",
}
_REMOTE_OPTIONS = {
    "generate": ("source", "out", "depth"),
    "degrade": ("source", "out", "depth"),
    "estimate_depth": ("source", "out"),
    "merge": ("out",),
    "train": ("run_dir",),
    "eval": ("run_dir",),
}
_LOST_PROCESS = re.compile("(closed|reset) by peer|remote process")  # of gloo and NCCL
_UNKNOWN_OPTION = re.compile(r"Could not override '(\w+)'")
_NO_NAME = re.compile(r"\+?(\w+)=(null|true|false|[-+]?(?:inf|nan|[\d._e+-]+))", re.IGNORECASE)  # read as no text
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
    ".*could not find the monitored key.*",  # before the first validation; afterwards it is an error
)


def run(name: str, function: Callable[[DictConfig], None]) -> None:
    """Run a command with the configuration that the command line gives.

    Args:
        name: of the module, and of its file in conf.
        function: called with the configuration.
    """
    is_multirun, failed = any(argument in _MULTIRUN for argument in sys.argv), list[SystemExit]()

    def job(cfg: DictConfig) -> None:
        try:
            with _one_line_errors(name), _no_empty_folder(cfg, existing):  # Hydra would add lines to an error
                function(cfg)
                sys.stdout.flush()
        except SystemExit as stop:
            if not is_multirun or stop.code != 1 or isinstance(stop.__context__, BrokenPipeError):
                raise
            failed.append(stop)  # as Hydra does, go on with the other runs

    job.__module__ = f"torchrefract.{name}"  # Hydra names the job by it
    logging.getLogger("pytorch_lightning").setLevel(logging.WARNING)
    for message in _IGNORED_WARNINGS:
        warnings.filterwarnings("ignore", message)
    os.environ["HYDRA_FULL_ERROR"] = "1"  # Hydra then raises its errors instead of printing them
    values = (argument.partition("=")[2].strip("'\"") for argument in sys.argv[1:])
    # Hydra creates the folder of a run before it calls the job.
    existing = _existing_folders([*filter(None, values), *Path("runs").glob("*"), "runs"])
    with _one_line_errors(name), _one_line_warnings():
        _check_addresses(name, sys.argv[1:])
        sys.argv[1:] = prepare_arguments(name, sys.argv[1:])
        hydra.main(config_path=str(_config_file(name).parent), config_name=name, version_base="1.3")(job)()
    if failed:
        raise failed[0]


def _check_addresses(name: str, arguments: list[str]) -> None:
    """Raise UsageError if an option is an address, of which pathlib would make a path in a folder such as "s3:".

    Those of `_REMOTE_OPTIONS` may be addresses.
    """
    allowed = _REMOTE_OPTIONS.get(name, ())
    for argument in arguments:
        for pattern, remedy in _REMOTE.items():
            if (match := pattern.match(argument)) and match[1] not in allowed:
                raise UsageError(
                    f"{match[1]} must be a path on this machine, got {match[2]}; {remedy}, or mount the storage"
                )


def prepare_arguments(name: str, arguments: list[str]) -> list[str]:
    """Quote file names for Hydra's grammar, and move options such as `-m` behind the overrides.

    Raises:
        UsageError: if the arguments lack a task, name several pictures, or give a folder of scenes to `robustness`.
    """
    is_multirun = any(argument in _MULTIRUN for argument in arguments)
    if name == "robustness" and (given := {"--config-dir", "-cd"}.intersection(arguments)):
        raise UsageError(f"scene must be given as a file, as in scene=[DIR/scene/mine.yaml], got {given.pop()}")
    if name == "preview":
        arguments = picture_as_option(arguments)
    if name == "eval":
        # Only this command needs the training stack here.
        from torchrefract.cli.evaluation import add_choices  # noqa: PLC0415

        arguments = add_choices(arguments)
    if name in ("train", "eval"):
        arguments = require_task(name, arguments)
    overrides, options = list[str](), list[str]()
    for i, argument in enumerate(arguments):
        is_value = i > 0 and arguments[i - 1] in _OPTIONS_WITH_VALUE
        (options if is_value or argument.startswith("-") else overrides).append(argument)
    if bare := [override for override in overrides if "=" not in override and not override.startswith("~")]:
        raise UsageError(f"an option must be NAME=VALUE, got {bare[0]}")
    return [quote_text(override, is_multirun=is_multirun) for override in overrides] + options


def quote_text(override: str, *, is_multirun: bool = False) -> str:
    """Quote the value of an option that is text, mostly a file name; return other overrides unchanged.

    A path that begins with ~ lies in the home folder. Quotes around a value, and the interpolation of a path that does
    not exist, keep their meaning in Hydra. With `is_multirun`, commas separate the values of a sweep unless a file has
    them in its name.
    """
    if not (match := _TEXT_OPTION.fullmatch(override)):
        return override
    option, text = match.groups()
    if is_path := option.lstrip("+") != "license":
        text = os.path.expanduser(text)  # not every shell does so behind an equals sign
    exists = is_path and _exists(text)
    is_quoted = len(text) > 1 and text[0] == text[-1] and text[0] in "'\""
    if text in ("", "null", "???") or (is_quoted and not exists):
        return override
    if is_multirun and is_path and not exists:
        if _SWEEP.fullmatch(text):
            return override
        parts = map(os.path.expanduser, text.split(","))
        return f"{option}=" + ",".join(_quote(part, is_literal=_exists(part)) for part in parts)
    return f"{option}={_quote(text, is_literal=exists or not is_path)}"


def require_task(name: str, arguments: list[str]) -> list[str]:
    """Return the arguments if they choose a task or an experiment, or ask for information only.

    Raises:
        UsageError: if no task is chosen, or `task=` lacks its plus.
    """
    if any(argument in _INFORMATION_OPTIONS for argument in arguments):
        return arguments
    if name == "eval" and not any(argument.startswith("ckpt_path=") for argument in arguments):
        raise UsageError("ckpt_path must be the path of a checkpoint: add ckpt_path=<run>/best.ckpt, got none")
    example = f"python -m torchrefract.{name}"
    for argument in arguments:
        if argument.startswith("task="):
            raise UsageError(f"{argument} needs a plus, since no task is chosen yet: {example} +{argument}")
    if not any(argument.startswith(_TASK_OPTIONS) for argument in arguments):
        tasks = config_names("task")
        raise UsageError(f"+task must be one of {', '.join(tasks)}: {example} +task={tasks[-1]}, got none")
    return arguments


def picture_as_option(arguments: list[str]) -> list[str]:
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
        raise UsageError(f"preview must have one picture, in quotes if its name has spaces, got {names}")
    return [f"image={_quote(argument)}" if i in pictures else argument for i, argument in enumerate(arguments)]


def _is_picture(argument: str) -> bool:
    # The name of a file may contain the syntax of Hydra, so an existing file is always a picture.
    return not argument.startswith("-") and (
        os.path.isfile(argument) or not ("=" in argument or argument.startswith("~"))
    )


def _quote(text: str, *, is_literal: bool = True) -> str:
    """Quote a text for Hydra's grammar and, if it is literal, for OmegaConf's interpolation."""
    literal = re.sub(r"(\\*)\$\{", r"\1\1\\${", text) if is_literal else text
    return QuotedString(literal, Quote.single).with_quotes()


def _exists(path: str) -> bool:
    """Return True if a path, or the folder of a path with an interpolation in it, exists."""
    folder = os.path.dirname(path)
    return os.path.exists(path) or ("${" in folder and os.path.isdir(folder))


def _existing_folders(paths: Iterable[str | Path]) -> set[Path]:
    """Return the paths, and the folders that they lie in, that exist as folders."""
    resolved = [Path(path).resolve() for path in paths]
    return {folder for path in resolved for folder in (path, *path.parents) if folder.is_dir()}


@contextmanager
def _no_empty_folder(cfg: DictConfig, existing: set[Path]) -> Iterator[None]:
    """Delete the output folders of a run that fails if they are empty and did not exist before.

    Of several runs, a folder that holds Hydra's list of them alone counts as empty.
    """
    outputs = [str(path) for key in ("out", "run_dir") if (path := OmegaConf.select(cfg, key))]
    outputs = [path for path in outputs if path != HydraConfig.get().runtime.output_dir]
    existing = existing | _existing_folders([Path.cwd(), *outputs])
    try:
        yield
    except BaseException:
        for path in (HydraConfig.get().runtime.output_dir, *outputs):
            folder = Path(path).resolve()
            with suppress(OSError):  # not empty, or missing
                while folder not in existing:
                    if [child.name for child in folder.iterdir()] == ["multirun.yaml"]:
                        (folder / "multirun.yaml").unlink()
                    folder.rmdir()
                    folder = folder.parent
        raise


@contextmanager
def _one_line_errors(name: str) -> Iterator[None]:
    """Print an error that the user can fix as one line and end the program; raise any other again."""
    try:
        yield
    except BrokenPipeError:  # as for `| head`
        with open(os.devnull, "w") as nothing:
            os.dup2(nothing.fileno(), sys.stdout.fileno())  # Python flushes the output when it exits
        print("stopped, as the reader of the output has ended; the same command continues", file=sys.stderr)
        raise SystemExit(1) from None
    except Exception as error:  # all but the known ones are raised again
        is_missing = isinstance(error, ModuleNotFoundError)
        if (message := missing_library(error, name) if is_missing else _user_message(error, name)) is None:
            raise
        if message:
            print(f"error: {message}", file=sys.stderr)
        raise SystemExit(1) from error
    except KeyboardInterrupt as error:
        if is_first_process():  # a terminal interrupts all of them
            print(f"stopped; {error if str(error) else 'the same command continues'}", file=sys.stderr)
        raise SystemExit(128 + signal.SIGINT) from None


@contextmanager
def _one_line_warnings() -> Iterator[None]:
    """Print a warning to the user as one line, without the place in the code that gave it."""
    form = warnings.formatwarning

    def one_line(message: Warning | str, category: type[Warning], *place: Any, **text: Any) -> str:
        return f"warning: {message}\n" if category is UserWarning else form(message, category, *place, **text)

    warnings.formatwarning = one_line
    try:
        yield
    finally:
        warnings.formatwarning = form


def _user_message(error: Exception, name: str) -> str | None:
    """Return one line for an error that the user of a command can fix, None for any other."""
    if isinstance(error, MissingConfigException) and error.missing_cfg_file:
        file = error.missing_cfg_file
        group, _, option = file.rpartition("/") if file.startswith("hydra/") else file.partition("/")
        choices = ", ".join(error.options or [])
        message = f"{group} must be one of {choices}, got {option}"
        if Path(option).suffix in (".yaml", ".yml"):
            message += f"; a file DIR/{group}/NAME.yaml is given by --config-dir DIR {group}=NAME"
        return message
    if str(error).startswith("Config group override must be"):  # a ValueError of Hydra
        for group, value in (word.groups() for word in map(_NO_NAME.fullmatch, sys.argv[1:]) if word):
            if choices := config_names(group):
                return f"{group} must be one of {', '.join(choices)}, got {value}"
    if isinstance(error, MissingMandatoryValue):
        return f"{error.full_key} must be given, as in {error.full_key}=…, got nothing"
    if isinstance(error, FILE_ERRORS) or str(error).startswith("Caught UsageError in DataLoader worker"):
        return str(error).strip().splitlines()[-1].split("Error: ", 1)[-1]  # a worker prepends its traceback
    if isinstance(error, UsageError | HydraException | OmegaConfBaseException | YAMLError):
        unknown = _UNKNOWN_OPTION.match(str(error))
        return _unknown_option(name, unknown[1]) if unknown else " ".join(str(error).split()) + _similar_key(error)
    return _file_message(error) if isinstance(error, OSError) else _process_message(error)


def _process_message(error: Exception) -> str | None:
    """Return one line for the error that PyTorch raises if another process has ended, None for any other.

    Of the processes of a training, only the first says that another one has ended; the line of others is empty.
    """
    if isinstance(error, RuntimeError) and _LOST_PROCESS.search(str(error)):
        text = "another process of the training has ended: it printed why, or was killed, as for lack of memory; "
        return f"{text}ckpt_path=<run>/last.ckpt continues" if is_first_process() else ""
    reason = str(error).strip().rstrip(".")
    if not reason.startswith("DataLoader worker (pid"):
        return None
    return f"data.workers must fit the memory, got one that ended ({reason}); a training continues by ckpt_path="


def _file_message(error: OSError) -> str | None:
    if isinstance(error, PermissionError):
        return f"{error.filename} could not be opened: {error.strerror}" if error.filename else str(error)
    if error.errno in _WRITING_ERRORS:
        return f"{error.filename or 'a file'} could not be written: {error.strerror}"
    return None


def _unknown_option(name: str, option: str) -> str:
    options = _options(name)
    similar = difflib.get_close_matches(option, options, n=1)
    hint = f"; did you mean {similar[0]}?" if similar else ""
    return f"an option must be one of {', '.join(options)}, got {option}{hint}"


def _similar_key(error: Exception) -> str:
    """Return a hint at the key of a part of the configuration that is most similar to the given one."""
    cause = error.__cause__
    if not (isinstance(cause, ConfigAttributeError) and isinstance(cause.parent_node, DictConfig)):
        return ""
    similar = difflib.get_close_matches(str(cause.key), map(str, cause.parent_node), n=1)
    return f"; did you mean {str(cause.full_key).removesuffix(str(cause.key))}{similar[0]}?" if similar else ""


def _options(name: str) -> list[str]:
    """Return the names before "=" that a command accepts: keys and groups of its configuration."""
    config = cast(DictConfig, OmegaConf.load(_config_file(name)))
    options = [str(key) for key in config if key not in ("defaults", "hydra")]
    given = dict(argument.split("=", 1) for argument in sys.argv[1:] if "=" in argument)
    for part in cast(list[Any], OmegaConf.to_container(config.defaults)):  # a group may be missing
        for group, choice in part.items() if isinstance(part, dict) else ():
            file = Path(CONFIG_DIR, str(group), f"{given.get(str(group), choice)}.yaml")
            if group != "hydra" and not str(group).startswith("override"):
                options.append(str(group))
            if file.is_file() and file.read_text(encoding="utf-8").startswith("# @package _global_"):
                options += [str(key) for key in OmegaConf.load(file)]
    return list(dict.fromkeys(options))


def _config_file(name: str) -> Path:
    """Return the configuration of a command: in a folder of its own if its options have the names of groups."""
    in_folder = Path(CONFIG_DIR, name, f"{name}.yaml")
    return in_folder if in_folder.is_file() else Path(CONFIG_DIR, f"{name}.yaml")
