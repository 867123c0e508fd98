"""Models made from their checkpoints alone, which are data of anybody's and may not choose what code runs."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from pkgutil import resolve_name
from typing import Any, NamedTuple

from hydra.errors import InstantiationException
from hydra.utils import instantiate
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from pytorch_lightning import LightningModule
from torch import nn

from torchrefract.restoration.checkpoints import CheckpointError, check_fits, model_name, read_checkpoint
from torchrefract.restoration.tasks import Task

_PACKAGE = "torchrefract."
_MADE = (nn.Module, Task)


class Loaded(NamedTuple):
    """A model and what its checkpoint says of it."""

    model: LightningModule  # in evaluation; images (B, 3, H, W) in [0, 1] -> Restored
    name: str  # as of `model_name`
    task: str
    size: tuple[int, int]  # height and width of the frames that it was trained on, px
    licenses: dict[str, Any]


def load_model(path: Path, *, changes: Mapping[str, Any] | None = None) -> Loaded:
    """The model of a checkpoint, made as its own configuration says.

    Nothing but networks, models and tasks of torchrefract is made, and no pretrained weights are looked for, since the
    checkpoint has all.

    Args:
        path: of the checkpoint.
        changes: of the configuration of the model, by the user.

    Raises:
        CheckpointError: what `read_checkpoint` and `check_fits` raise; a checkpoint without its configuration, or with
            one of something else.
    """
    checkpoint = read_checkpoint(path)
    config, data = (checkpoint.get(part) for part in ("config", "data"))
    if not (isinstance(config, dict) and isinstance(config.get("model"), dict) and isinstance(data, dict)):
        raise CheckpointError(
            f"ckpt_path must be a checkpoint with its configuration, as torchrefract.train writes them, got {path}"
        )
    model = _made(config["model"], changes or {}, path)
    check_fits(checkpoint, model, path, config=config["model"])
    model.on_load_checkpoint(checkpoint)
    model.load_state_dict(checkpoint["state_dict"])
    licenses = checkpoint.get("licenses", {})
    name = model_name(config["model"])
    return Loaded(model.eval(), name, str(checkpoint["task"]), _size(data.get("size"), path), licenses)


def _made(config: dict[str, Any], changes: Mapping[str, Any], path: Path) -> LightningModule:
    """What the configuration of a model says, which has no say in what else is run."""
    try:
        plain = OmegaConf.to_container(OmegaConf.merge(config, dict(changes)), resolve=False)
        for node in _nodes(plain):
            _check_node(node, path)
        made = instantiate(plain)
    except (InstantiationException, OmegaConfBaseException, ValueError, TypeError) as error:
        reason = error.__cause__ or error
        raise CheckpointError(f"ckpt_path must be of a model that can be made, got {path}: {reason}") from error
    if not isinstance(made, LightningModule):
        raise CheckpointError(f"ckpt_path must be of a model, got {path} of {type(made).__name__}")
    return made


def _nodes(value: Any) -> Iterator[dict[Any, Any]]:
    """The mappings in nested plain values."""
    if isinstance(value, dict):
        yield value
    for child in value.values() if isinstance(value, dict) else value if isinstance(value, list) else ():
        yield from _nodes(child)


def _check_node(node: dict[Any, Any], path: Path) -> None:
    """Raise CheckpointError for what could run other code or read other files; drop the place of old weights."""
    if any(isinstance(value, str) and "${" in value for value in node.values()):
        raise CheckpointError(f"ckpt_path must hold a resolved configuration, got {path} with ${{…}} in it")
    if node.get("pretrained") is not None:
        node["pretrained"] = None
    target = node.get("_target_")
    if "_target_" in node and not _is_ours(target):
        raise CheckpointError(f"ckpt_path must name models and tasks of torchrefract alone, got {path} with {target!r}")


def _is_ours(target: Any) -> bool:
    if not isinstance(target, str) or not target.startswith(_PACKAGE):
        return False
    try:
        found = resolve_name(target)
    except (ImportError, ValueError, AttributeError):
        return False
    # By where it was made: our modules have those that they import as attributes.
    return isinstance(found, type) and issubclass(found, _MADE) and found.__module__.startswith(_PACKAGE)


def _size(size: Any, path: Path) -> tuple[int, int]:
    if not (isinstance(size, list) and len(size) == 2 and all(isinstance(side, int) and side > 0 for side in size)):
        raise CheckpointError(f"ckpt_path must tell the size of its frames, got {path} with {size!r}")
    return size[0], size[1]
