"""Default options of `eval`: the configuration with which a checkpoint was validated."""

from collections.abc import Sequence
from inspect import isfunction
from pathlib import Path
from typing import Any, cast

from omegaconf import DictConfig, OmegaConf

from torchrefract._io import CONFIG_DIR, config_names
from torchrefract.cameras.camera import Camera
from torchrefract.data.module import PairData, fingerprint
from torchrefract.data.pairs.configuration import flatten
from torchrefract.effects.base import Effect
from torchrefract.fields.depth import DepthProvider
from torchrefract.restoration.checkpoints import read_checkpoint, safe_config
from torchrefract.restoration.pretrained import find_checkpoint
from torchrefract.restoration.report import describe_scene

_PARTS = ("scene", "task", "data", "model")
_MODULES = ("torchrefract.presets", "torchrefract.data.module")  # a checkpoint may name their functions
_NOT_COMPARED = ("workers", "batch_size", "buffer", "pretrained")  # they change no score


def add_choices(arguments: list[str]) -> list[str]:
    """Add the task, data, model and scene of the checkpoint that `ckpt_path=` names, unless the arguments choose them.

    Hydra needs the choices to know which options exist; `use_validation_config` then sets their values.
    """
    given = {key: value for key, _, value in (argument.lstrip("+").partition("=") for argument in arguments)}
    text = given.get("ckpt_path", "")
    path = find_checkpoint(text if Path(text).is_file() else text.strip("'\""))
    if not text or "experiment" in given or ("task" in given and not path.is_file()):
        return arguments
    checkpoint = read_checkpoint(path)
    config = checkpoint.get("config") or {}
    choices = {"+task": checkpoint["task"]}
    choices |= {group: _choice(group, config.get(group)) for group in ("data", "model", "scene")}
    added = [f"{group}={name}" for group, name in choices.items() if name and group.lstrip("+") not in given]
    return arguments + added


def use_validation_config(
    cfg: DictConfig, checkpoint: dict[str, Any], overrides: Sequence[str], path: Path
) -> list[str] | None:
    """Replace the values in `cfg` that no override sets by those with which a checkpoint was validated.

    An experiment sets all values.

    Args:
        cfg: the configuration, which changes.
        checkpoint: of `read_checkpoint`.
        overrides: of the command line.
        path: of the checkpoint, for messages.

    Returns:
        The names of the values that differ from the checkpoint's; None if the checkpoint has no configuration.

    Raises:
        CheckpointError: the configuration of the checkpoint could run code of another package.
    """
    OmegaConf.resolve(cfg)
    if (stored := _stored_config(checkpoint)) is None:
        return None
    keys = [override.lstrip("+~").partition("=")[0] for override in overrides]
    if "experiment" not in keys:
        for part in _PARTS:
            if (chosen := cfg.get(part)) is not None and part in keys and _kind(chosen) != _kind(stored.get(part)):
                continue
            values = OmegaConf.create({part: safe_config(stored.get(part), path, is_allowed=_is_allowed)})
            for key in (key for key in keys if key.startswith(f"{part}.")):
                OmegaConf.update(values, key, OmegaConf.select(cfg, key), force_add=True)
            OmegaConf.update(cfg, part, values[part], merge=False, force_add=True)
        limit = (stored.get("trainer") or {}).get("limit_val_batches")
        if "trainer.limit_val_batches" not in keys and isinstance(limit, int | float):
            cfg.trainer.limit_val_batches = limit
        if "seed" not in keys and isinstance(stored.get("seed"), int):
            cfg.seed = stored["seed"]
        if "data.seed" not in keys and ("seed" in keys or _kind(cfg.data) != _kind(stored["data"])):
            cfg.data.seed = cfg.seed
        if "effect" in cfg.data:
            cfg.data.effect = cfg.scene
        cfg.model.task = cfg.task
    return changed_values(cfg, checkpoint)


def changed_values(cfg: DictConfig, checkpoint: dict[str, Any], *, ignored: Sequence[str] = _NOT_COMPARED) -> list[str]:
    """Return the names of the values of data and model that differ from those of a checkpoint's configuration."""
    if (stored := _stored_config(checkpoint)) is None:
        return []
    before, after = (_compared(config, ignored) for config in (stored, cast(Any, OmegaConf.to_container(cfg))))
    return sorted(key for key in before.keys() | after.keys() if before.get(key) != after.get(key))


def describe_validation(data: PairData, cfg: DictConfig, changed: list[str] | None) -> str:
    """State in a line on what a checkpoint is scored, and how that differs from its own validation."""
    facts, limit = fingerprint(data.val), cfg.trainer.limit_val_batches
    scene = describe_scene(data, cfg.data.get("effect"))
    height, width = facts["size"]
    text = f"{facts['frames']} validation frames of {facts['source']}{f' {root}' if (root := facts['root']) else ''}"
    text += f", {height}x{width} px, {scene}" + ("" if limit is None else f", limit_val_batches {limit}")
    if changed is None:
        return f"{text}; the checkpoint does not say what it was validated on"
    return f"{text}; " + (
        f"unlike its own validation in {', '.join(changed)}" if changed else "as in its own validation"
    )


def _stored_config(checkpoint: dict[str, Any]) -> dict[str, Any] | None:
    """Return the configuration in a checkpoint; None if it does not hold that of the data and the model."""
    config = checkpoint.get("config")
    is_usable = isinstance(config, dict) and all(isinstance(config.get(part), dict) for part in ("data", "model"))
    return config if is_usable else None


def _choice(group: str, config: Any) -> str | None:
    """Return the file in a group of conf that makes a part of a configuration, or None."""
    kinds = {name: _kind(OmegaConf.load(Path(CONFIG_DIR, group, f"{name}.yaml"))) for name in config_names(group)}
    return next((name for name, kind in kinds.items() if kind == _kind(config)), None)


def _kind(config: Any) -> tuple[Any, Any] | None:
    """Return what a part of a configuration makes: its target and that of its network."""
    if not isinstance(config, dict | DictConfig):
        return None
    network = config.get("network")
    return config.get("_target_"), network.get("_target_") if isinstance(network, dict | DictConfig) else None


def _is_allowed(value: Any) -> bool:
    is_class = isinstance(value, type) and issubclass(value, Effect | DepthProvider | Camera)
    return is_class or (isfunction(value) and value.__module__ in _MODULES and not value.__name__.startswith("_"))


def _compared(config: dict[str, Any], ignored: Sequence[str]) -> dict[str, Any]:
    """Return the values of data and model but for those of ignored names, and the limit of validations, by names."""
    parts = flatten({part: config[part] for part in ("data", "model")})
    values = {name: value for name, value in parts if name.rpartition(".")[2] not in ignored}
    return values | {"trainer.limit_val_batches": (config.get("trainer") or {}).get("limit_val_batches")}
