"""Scenes of a run of the command robustness, and its stored scores, by which it continues or is compared."""

import hashlib
import inspect
import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from hydra.errors import InstantiationException
from hydra.utils import instantiate
from omegaconf import OmegaConf

import torchrefract
from torchrefract import presets
from torchrefract._io import CONFIG_DIR, write_file
from torchrefract._validation import UsageError, first_names
from torchrefract.cli.options import naming
from torchrefract.cli.progress import print_warning
from torchrefract.effects.base import Effect
from torchrefract.robustness.evaluate import ImageScore, Level, Robustness, Scored
from torchrefract.robustness.predictors import import_function
from torchrefract.robustness.quantities import SCENES

SCORES = "scores.jsonl"  # one line of settings, then one for each picture
FORMAT = 3  # of these lines; 1 had no summaries of predictions, 2 scored pixels that show nothing
_VERSIONS = {"torchrefract": torchrefract.__version__, "torch": torch.__version__}
# Settings that a base shares, besides its data, scenes and severities.
_SHARED = ("labels", "score", "depth_scale", "seed", "camera", "horizon", "effects", "format")
_SUFFIXES = (".yaml", ".yml")
REFERENCE_WIDTH = 1920  # px, of frames for which scenes are described; their quantities do not depend on it


@contextmanager
def stored_scores(
    path: Path, settings: Mapping[str, Any], data: Path
) -> Iterator[tuple[dict[str, Scored], Callable[[str, Scored], None]]]:
    """Yield the scores of an earlier run, and a function that stores those of a picture of the folder `data`.

    Scores of pictures that changed since are left out.
    """
    lines = _complete_lines(path)
    if len(lines) == 1:
        lines = []  # of a run that scored nothing
    if lines:
        before = json.loads(lines[0])
        changed = [f"{name}={before.get(name)}" for name in settings if before.get(name) != settings[name]]
        if changed:
            raise UsageError(
                f"out must be a folder of the same settings, got one with {', '.join(changed)}; choose another"
            )
        _check_versions(before.get("versions") or {})
        lines[1:] = [line for line in lines[1:] if _is_current(json.loads(line), data)]
    done = dict(map(parse_scores, lines[1:]))
    write_file(path, "".join(lines) or json.dumps({**settings, "versions": _VERSIONS}) + "\n", alone=True)
    with path.open("a", encoding="utf-8") as stream:

        def store(name: str, scored: Scored) -> None:
            levels = [[*level, of] for level, of in scored.levels.items()]
            row = {"name": name, "clean": scored.clean, "levels": levels, "date": _date_of(data / name)}
            stream.write(json.dumps(row) + "\n")
            stream.flush()

        yield done, store


def read_base(path: Path, settings: Mapping[str, Any], names: Iterable[str]) -> tuple[str, Robustness]:
    """Return the model and the scores of an earlier run; warn if another version made them.

    Raises:
        UsageError: the folder has no run; its settings are others; it has none of the pictures.
    """
    lines = _complete_lines(path / SCORES)
    if not lines:
        raise UsageError(f"base must be a folder of an earlier run, got {path}, which has no {SCORES}")
    before, scored = json.loads(lines[0]), dict(map(parse_scores, lines[1:]))
    expected, of_base = _comparable(settings), _comparable(before)
    changed = [f"{name}={of_base[name]}" for name in expected if of_base[name] != expected[name]]
    if changed:
        raise UsageError(
            f"base must be a run on the same data with the same settings, got one with {', '.join(changed)}; score "
            "that model again with the options of this run"
        )
    if scored.keys().isdisjoint(names):
        raise UsageError(f"base must have scores of the same images, got none of {first_names(list(names))}")
    version = (before.get("versions") or {}).get("torchrefract", "of an unknown version")
    if version != torchrefract.__version__:
        text = f"torchrefract {version}, this is {torchrefract.__version__}: its pictures may differ"
        print_warning(f"base was run with {text}")
    levels, of_images = next(iter(scored.values())).levels, scored.values()
    result = Robustness(
        names=list(scored),
        clean=np.array([of.clean.score for of in of_images]),
        scores={level: np.array([of.levels[level].score for of in of_images]) for level in levels},
        values={level: np.array([of.levels[level].value for of in of_images]) for level in levels},
        set_scores={},
    )
    return str(before["model"]), result


def _check_versions(before: Mapping[str, str]) -> None:
    """Raise UsageError if another version of torchrefract began a run; warn of an unknown one or another PyTorch."""
    version = before.get("torchrefract")
    if version is None:
        text = f"an unknown version of torchrefract and continues with {torchrefract.__version__}: draws may differ"
        print_warning(f"out was begun by {text}")
    elif version != torchrefract.__version__:
        raise UsageError(
            f"out must be a folder of a run of torchrefract {torchrefract.__version__}, got one of {version}, whose "
            "draws may differ; choose another, or continue with that version"
        )
    elif before["torch"] != torch.__version__:
        text = f"{before['torch']} and continues with {torch.__version__}: last digits may differ"
        print_warning(f"out was begun with torch {text}")


def _comparable(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings that a run and its base share, in one form."""
    levels = levels_of(settings["scene"], settings["severity"])
    scenes, severities = (sorted({level[i] for level in levels}) for i in range(2))
    paths = {name: settings[name] and str(Path(settings[name]).expanduser().resolve()) for name in ("data", "depth")}
    return paths | {"scene": scenes, "severity": severities} | {name: settings.get(name) for name in _SHARED}


def _date_of(path: Path) -> int | None:
    """Return the time of the last change of a file, ns; None if it does not exist."""
    return path.stat().st_mtime_ns if path.is_file() else None


def _is_current(row: Mapping[str, Any], data: Path) -> bool:
    """Return True if a picture is the one that was scored; earlier versions stored no date."""
    return row.get("date") in (None, _date_of(data / row["name"]))


def _complete_lines(path: Path) -> list[str]:
    """Return the lines of a file, without a part of one that a killed run left; none without a file."""
    lines = path.read_text(encoding="utf-8").splitlines(keepends=True) if path.is_file() else []
    return [line for line in lines if line.endswith("\n")]


def parse_scores(line: str) -> tuple[str, Scored]:
    """Return the name and the scores of a picture, by its line."""
    row = json.loads(line)
    of_levels = {Level(*level): ImageScore(*of) for *level, of in row["levels"]}
    return row["name"], Scored(ImageScore(*row["clean"]), of_levels)


def levels_of(scenes: Any, severities: Any) -> list[Level]:
    """Return the levels of options; raise UsageError without a scene or for an unknown severity."""
    names = [scenes] if isinstance(scenes, str) else scenes or []
    if not names:
        raise UsageError(f"scene must be some of {', '.join(SCENES)}, or scenes of yours, got none")
    severities = [severities] if isinstance(severities, int | float) else severities
    if not severities or any(isinstance(s, bool) or s not in presets.SEVERITIES for s in severities):
        raise UsageError(f"severity must be some of {presets.SEVERITIES}, got {severities}")
    return [Level(str(name), int(severity)) for name in names for severity in severities]


def make_scenes(levels: Iterable[Level], width: int, place: Mapping[str, Any]) -> dict[str, dict[int, Effect]]:
    """Create the effects of levels for frames of a width, px.

    Args:
        levels: a scene is a name in conf/scene, a YAML file like those, or package.module:function.
        width: given to scenes that take one.
        place: camera and horizon, as far as they are given, likewise.

    Raises:
        UsageError: an unknown scene; one that is no effect; one without a severity for several of them.
    """
    severities: dict[str, list[int]] = {}
    for level in levels:
        severities.setdefault(level.scene, []).append(level.severity)
    return {name: _effects(name, of, {"width": width, **place}) for name, of in severities.items()}


def describe_scenes(levels: Iterable[Level]) -> dict[str, str] | None:
    """Return a digest of the parameters of each scene that is not of torchrefract, by name; None without any."""
    effects = make_scenes((level for level in levels if not _shipped(level.scene).is_file()), REFERENCE_WIDTH, {})
    texts = {name: repr(list(by.items())) for name, by in effects.items()}
    return {name: hashlib.sha256(text.encode()).hexdigest()[:16] for name, text in texts.items()} or None


def _shipped(name: str) -> Path:
    return Path(CONFIG_DIR, "scene", f"{name}.yaml")


def _effects(name: str, severities: Sequence[int], arguments: Mapping[str, Any]) -> dict[int, Effect]:
    module, _, function = name.partition(":")
    config = {} if function else _read_scene(name)
    if len(severities) > 1 and "_target_" in config and "severity" not in config:
        raise UsageError(
            f"scene must have a severity if several are scored, got {name} without one; write an effect below each "
            "severity, as in 1: {_target_: ...}, or pass one severity"
        )
    with naming("scene"):
        if function:
            make = import_function(module, function)
            given = _accepted(arguments, inspect.signature(make).parameters)
            effects = {severity: make(severity, **given) for severity in severities}
        else:
            effects = {severity: _from_config(config, name, severity, arguments) for severity in severities}
    for effect in effects.values():
        if not isinstance(effect, Effect):
            raise UsageError(f"scene must be an effect of torchrefract, got {type(effect).__name__} of {name}")
    return effects


def _from_config(config: dict[Any, Any], name: str, severity: int, arguments: Mapping[str, Any]) -> Any:
    if "_target_" not in config and severity not in config:
        raise ValueError(f"{name} must hold the _target_ of an effect, or one for severity {severity}, got neither")
    config = config if "_target_" in config else config[severity]
    try:
        # A camera is no value of a configuration.
        return instantiate(config | {"_partial_": True})(**_accepted({"severity": severity, **arguments}, config))
    except InstantiationException as error:
        raise error.__cause__ or error from None


def _accepted(arguments: Mapping[str, Any], names: Iterable[str]) -> dict[str, Any]:
    names = set(names)
    return {name: value for name, value in arguments.items() if name in names}


def _read_scene(name: str) -> dict[Any, Any]:
    file = Path(name).expanduser()
    if file.suffix not in _SUFFIXES:
        file = _shipped(name)
    if not file.is_file():
        raise UsageError(
            f"scene must be some of {', '.join(SCENES)}, a file .yaml, or package.module:function, got {name}"
        )
    config: Any = OmegaConf.to_container(OmegaConf.load(file), resolve=True)
    if not isinstance(config, dict):
        raise UsageError(
            f"scene must be a mapping with the _target_ of an effect, got {type(config).__name__} in {file}"
        )
    return config
