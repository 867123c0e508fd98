"""The scenes of the command robustness: those of conf/scene, YAML files, and functions of a severity."""

import hashlib
import inspect
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from hydra.errors import InstantiationException
from hydra.utils import instantiate
from omegaconf import OmegaConf

from torchrefract._io import CONFIG_DIR
from torchrefract._validation import UsageError
from torchrefract.cli.options import naming
from torchrefract.effects.base import Effect
from torchrefract.robustness.evaluate import Level
from torchrefract.robustness.predictors import import_function
from torchrefract.robustness.quantities import QUANTITIES

_SUFFIXES = (".yaml", ".yml")
_REFERENCE_WIDTH = 1920  # px, of the frames for which effects are described


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
    effects = make_scenes((level for level in levels if not _shipped(level.scene).is_file()), _REFERENCE_WIDTH, {})
    texts = {name: repr(list(by.items())) for name, by in effects.items()}
    return {name: hashlib.sha256(text.encode()).hexdigest()[:16] for name, text in texts.items()} or None


def _shipped(name: str) -> Path:
    return Path(CONFIG_DIR, "scene", f"{name}.yaml")


def _effects(name: str, severities: Sequence[int], arguments: Mapping[str, Any]) -> dict[int, Effect]:
    module, _, function = name.partition(":")
    config = {} if function else _read(name)
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


def _read(name: str) -> dict[Any, Any]:
    file = Path(name).expanduser()
    if file.suffix not in _SUFFIXES:
        file = _shipped(name)
    if not file.is_file():
        raise UsageError(
            f"scene must be some of {', '.join(QUANTITIES)}, a file .yaml, or package.module:function, got {name}"
        )
    config: Any = OmegaConf.to_container(OmegaConf.load(file), resolve=True)
    if not isinstance(config, dict):
        raise UsageError(
            f"scene must be a mapping with the _target_ of an effect, got {type(config).__name__} in {file}"
        )
    return config
