"""Checkpoints: written whole or not at all, and looked at before they are used."""

import pickle
import struct
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from pytorch_lightning import Callback, LightningModule, Trainer
from pytorch_lightning.plugins.io import TorchCheckpointIO
from torch import nn

from torchrefract._io import replace_file
from torchrefract._validation import UsageError

# What a damaged archive, or a file that is none, makes the readers raise.
_DAMAGE = (zipfile.BadZipFile, zlib.error, pickle.UnpicklingError, EOFError, LookupError, OSError, RuntimeError)
_DAMAGE += (struct.error, ValueError, TypeError, AttributeError, ArithmeticError, AssertionError)


class CheckpointError(UsageError):
    """A checkpoint that cannot be read, does not fit, or cannot be written; the message says what to do."""


class AtomicCheckpointIO(TorchCheckpointIO):
    """A checkpoint takes the place of its predecessor when it is complete, so a full disk leaves the last good one."""

    def save_checkpoint(self, checkpoint: dict[str, Any], path: str | Path, storage_options: Any = None) -> None:
        """Write the checkpoint beside `path`, then move it there."""
        path = Path(path)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with replace_file(path) as temporary:
                torch.save(checkpoint, temporary)
        # torch reports a disk that is full while it writes as a RuntimeError of its archive writer.
        except (OSError, RuntimeError) as error:
            kept = f"; {path} of an earlier epoch is whole" if path.exists() else ""
            reason = error.strerror if isinstance(error, OSError) else "the disk may be full"
            raise CheckpointError(
                f"{path} could not be written ({reason}){kept}: make room or choose another hydra.run.dir, and go on "
                "with ckpt_path="
            ) from error


class Origin(Callback):
    """Checkpoints say where they come from, in plain values, which load with weights only.

    Args:
        config: the resolved configuration of the run.
        data: what the model is trained on, as by `fingerprint`.
        licenses: of what the model is made from, by what that is; None where it is not known.
    """

    def __init__(self, config: Mapping[str, Any], *, data: Mapping[str, Any], licenses: Mapping[str, str | None]):
        self.origin = {"config": dict(config), "data": dict(data), "licenses": dict(licenses)}

    def on_save_checkpoint(self, trainer: Trainer, pl_module: LightningModule, checkpoint: dict[str, Any]) -> None:
        """Configuration, data and licenses go along."""
        checkpoint.update(self.origin)


def model_name(model: Mapping[str, Any]) -> str:
    """What the model of a configuration is called: its network, and the encoder of that, as "ResUNet (tu-resnet34)"."""
    network = model.get("network", model)
    name = str(network.get("_target_", "a network")).rsplit(".", 1)[-1]
    return f"{name} ({network['encoder']})" if "encoder" in network else name


def read_checkpoint(path: Path, *, task: str | None = None) -> dict[str, Any]:
    """What the file holds, read without running code from it.

    Args:
        path: of the file.
        task: that it must be of; None takes any.

    Raises:
        CheckpointError: no such file, a file that is no checkpoint or damaged, one of another task.
    """
    if not path.is_file():
        raise CheckpointError(f"ckpt_path must be a checkpoint file, such as <run>/last.ckpt, got {path}")
    try:
        # torch itself compares no checksum: a hole in the file would come back as other weights.
        with zipfile.ZipFile(path) as archive:
            if (damaged := archive.testzip()) is not None:
                raise zipfile.BadZipFile(damaged)
        checkpoint = torch.load(path, map_location="cpu", weights_only=True, mmap=True)
    except _DAMAGE as error:
        raise CheckpointError(f"ckpt_path must be a whole checkpoint, got {path}, which is damaged or none") from error
    if not isinstance(checkpoint, dict) or not _has_parts(checkpoint):
        raise CheckpointError(f"ckpt_path must be a checkpoint of torchrefract, got {path}")
    if task not in (None, checkpoint["task"]):
        raise CheckpointError(f"ckpt_path must be a checkpoint of the task {task}, got {path} of {checkpoint['task']}")
    return checkpoint


def _has_parts(checkpoint: dict[Any, Any]) -> bool:
    """Whether there are weights by their names, and the name of a task."""
    weights = checkpoint.get("state_dict")
    if not isinstance(weights, dict) or not isinstance(checkpoint.get("task"), str):
        return False
    return all(isinstance(name, str) and isinstance(value, torch.Tensor) for name, value in weights.items())


def check_fits(
    checkpoint: Mapping[str, Any], model: nn.Module, path: Path, *, config: Mapping[str, Any] | None = None
) -> None:
    """Raise CheckpointError unless the weights of the checkpoint at `path` are those of such a model.

    `config`: what the model was made from, to name it beside that of the checkpoint.
    """
    shapes = {name: value.shape for name, value in model.state_dict().items()}
    saved = {name: value.shape for name, value in checkpoint["state_dict"].items()}
    differing = sorted(name for name in shapes.keys() | saved.keys() if shapes.get(name) != saved.get(name))
    if not differing:
        return
    wanted, found = (model_name(part) for part in (config or {}, checkpoint.get("config", {}).get("model", {})))
    if wanted != found and config and "config" in checkpoint:
        raise CheckpointError(f"ckpt_path must be a checkpoint of {wanted}, which model= names, got {path} of {found}")
    raise CheckpointError(
        f"ckpt_path must be a checkpoint of the model that model= names, got {path}, where {differing[0]} differs"
    )
