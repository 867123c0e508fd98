"""Effects as plain values and back, for libraries that write their transforms to JSON or YAML."""

import importlib
import inspect
import math
from typing import Any

from torch import nn

from torchrefract._validation import type_name
from torchrefract.effects.base import Effect


def effect_to_config(effect: Effect) -> dict[str, Any]:
    """Return an effect as numbers, texts, lists and dicts, of the form that `hydra.utils.instantiate` takes.

    Raises:
        TypeError: an argument is a function, or an effect holds more than its arguments, such as a covariance.
    """
    return _to_plain(effect, "effect")


def effect_from_config(config: dict[str, Any]) -> Effect:
    """Create the effect of `effect_to_config`; only classes of torchrefract are called.

    Raises:
        TypeError, ValueError: not the config of an effect.
    """
    effect = _from_plain(config)
    if not isinstance(effect, Effect):
        raise TypeError(f"effect must be an effect or its config, got {type_name(effect)}")
    return effect


def _public_class(name: str) -> type[Any] | None:
    """Return a class of torchrefract that a config may name: an effect, a camera or a depth."""
    kind = getattr(importlib.import_module("torchrefract"), name, None)
    is_value = inspect.isclass(kind) and (issubclass(kind, Effect) or name == "Camera" or name.endswith("Depth"))
    return kind if is_value else None


def _to_plain(value: Any, name: str) -> Any:
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, float):
        return float(value)  # YAML knows no subclass of it
    if isinstance(value, list | tuple | nn.ModuleList):
        return [_to_plain(item, f"{name}[{i}]") for i, item in enumerate(value)]
    kind = type(value)
    if _public_class(kind.__name__) is not kind:
        got = f"{kind.__module__}.{kind.__qualname__}"
        raise TypeError(f"{name} must be a number, a text or a class of torchrefract to be written as text, got {got}")
    config = {"_target_": f"torchrefract.{kind.__name__}"}
    for argument in inspect.signature(kind).parameters:
        holder = value if hasattr(value, argument) else value.medium  # of a fog
        config[argument] = _to_plain(getattr(holder, argument), f"{name}.{argument}")
    again = _from_plain(config)
    if _state(again).keys() != _state(value).keys() or repr(again) != repr(value):
        raise TypeError(f"{name} must be given by its arguments to be written as text, got {kind.__name__} with more")
    return config


def _state(value: Any) -> dict[str, Any]:
    """Return the attributes of a value that hold anything."""
    return {name: held for name, held in vars(value).items() if held is not None}


def _from_plain(value: Any) -> Any:
    if isinstance(value, list | tuple):
        return tuple(map(_from_plain, value))
    if not isinstance(value, dict):
        return value
    package, _, name = str(value.get("_target_")).rpartition(".")
    kind = _public_class(name) if package == "torchrefract" else None
    if kind is None:
        raise ValueError(f"_target_ must name an effect, depth or camera of torchrefract, got {value.get('_target_')}")
    return kind(**{key: _from_plain(item) for key, item in value.items() if key != "_target_"})


def without_defaults(config: Any) -> Any:
    """Return a config without the arguments that have their default values.

    The config may be one of `effect_to_config`, or of any function or class that `hydra.utils.instantiate` calls.
    """
    if isinstance(config, list):
        return [without_defaults(item) for item in config]
    if not isinstance(config, dict):
        return config
    module, _, name = config["_target_"].rpartition(".")
    parameters = inspect.signature(getattr(importlib.import_module(module), name)).parameters
    short = {"_target_": config["_target_"]}
    for argument, value in config.items():
        default = parameters[argument].default if argument in parameters else inspect.Parameter.empty
        if argument != "_target_" and (default is inspect.Parameter.empty or value != _to_plain(default, argument)):
            short[argument] = without_defaults(value)
    return short


def config_to_code(config: Any, *, indent: int = 0) -> str:
    """Return the Python expression that makes what a config describes; it needs the modules of its targets.

    Args:
        config: as for `without_defaults`.
        indent: levels by which its lines after the first are indented.
    """
    if isinstance(config, dict):
        given = {name: value for name, value in config.items() if name != "_target_"}
        arguments = [f"{name}={config_to_code(value, indent=indent + 1)}" for name, value in given.items()]
        return f"{config['_target_']}({_in_lines(arguments, indent)})"
    if isinstance(config, list):
        items = [config_to_code(item, indent=indent + 1) for item in config]
        if any(isinstance(item, dict) for item in config):
            return f"[{_in_lines(items, indent)}]"
        return f"({', '.join(items)}{',' if len(items) == 1 else ''})"
    if isinstance(config, float) and not math.isfinite(config):
        return f'float("{config}")'
    return repr(config)


def _in_lines(parts: list[str], indent: int) -> str:
    line = "\n" + "    " * indent
    return "".join(f"{line}    {part}," for part in parts) + (line if parts else "")
