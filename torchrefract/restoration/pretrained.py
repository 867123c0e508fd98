"""Models that come with torchrefract, as files of weights that `load_model` reads like checkpoints."""

import json
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
import torch.nn.functional as F
from torch import Tensor

from torchrefract._io import as_path, write_file

if TYPE_CHECKING:
    from torchrefract.restoration.checkpoints import Loaded

WEIGHTS_SUFFIX = ".safetensors"
_FOLDER = Path(__file__).with_name("weights")
_METADATA = "torchrefract"  # its key in the header of a file
_PARTS = ("task", "data", "licenses")  # of a checkpoint
_CONFIG = ("task", "scene", "data", "model", "seed")  # the parts of its configuration that do not name a run
_CONSTANT = "constant_flow"  # the key of the mean flow of the training set among the weights
_REDUCTION = 4  # of its size in the file, because it is smooth


def pretrained(name: str) -> "Loaded":
    """Load a model that comes with torchrefract.

        loaded = torchrefract.pretrained("lens_small")
        restored = loaded.model(resize(image, loaded.size))  # restored.image, restored.flow

    The commands take the same name: `python -m torchrefract.restore ckpt_path=lens_small`. A card, in the folder
    `torchrefract/restoration/weights`, states the data, the license, the scores and the limits of each model.

    Args:
        name: "lens_small", the lens of a frame from the straightness of its lines.

    Returns:
        the model, in evaluation mode, which maps images (B, 3, H, W) in [0, 1] to `Restored`; and the size of frames
        that it was trained on.

    Raises:
        ValueError: no model has this name.
        ImportError: the packages of training are not installed.
    """
    names = model_names()
    if name not in names:
        remedy = "torchrefract.restoration.checkpoints.load_model reads files"
        raise ValueError(f"name must be {' or '.join(names)}, got {name!r}; {remedy}")
    try:
        from torchrefract.restoration.checkpoints import load_model  # noqa: PLC0415 - only models need Lightning
    except ImportError as error:
        raise ImportError('pretrained needs Lightning: pip install "torchrefract[train]"') from error
    return load_model(name)


def model_names() -> list[str]:
    """Return the names of the models that come with torchrefract."""
    return sorted(file.stem for file in _FOLDER.glob(f"*{WEIGHTS_SUFFIX}"))


def find_checkpoint(path: str | Path) -> Path:
    """Return the file of a model that comes with torchrefract if `path` is its name, or else the path as it is."""
    file = _FOLDER / f"{path}{WEIGHTS_SUFFIX}"
    return file if str(path) in model_names() else as_path(path)


def write_weights(checkpoint: Mapping[str, Any], out: Path) -> None:
    """Write the weights of a checkpoint in half precision, and all that is needed to rebuild its model."""
    from safetensors.torch import save  # noqa: PLC0415 - of the packages of training

    total, count = checkpoint["flows"]
    constant = (total / count.clamp(min=1))[None].float()
    reduced = _resize(constant, [-(-side // _REDUCTION) for side in total.shape[1:]])
    weights = (checkpoint["state_dict"] | {_CONSTANT: reduced}).items()
    values = {name: (value.half() if value.is_floating_point() else value).contiguous() for name, value in weights}
    config = {part: checkpoint["config"][part] for part in _CONFIG if part in checkpoint["config"]}
    about = {part: checkpoint[part] for part in _PARTS} | {"config": config, "crc32": _checksum(values)}
    write_file(out, save(values, metadata={_METADATA: json.dumps(about)}))


def read_weights(path: Path) -> dict[str, Any]:
    """Read a file of `write_weights` as a checkpoint with weights in single precision.

    Raises:
        KeyError, ValueError, SafetensorError: the file is damaged or of another program.
    """
    from safetensors import safe_open  # noqa: PLC0415 - of the packages of training

    with safe_open(path, framework="pt") as file:
        about = json.loads(file.metadata()[_METADATA])
        values = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - no mapping
    if _checksum(values) != about.pop("crc32"):
        raise ValueError("checksum differs")
    weights = {name: value.float() if value.is_floating_point() else value for name, value in values.items()}
    constant = _resize(weights.pop(_CONSTANT), about["data"]["size"])[0]
    return about | {"state_dict": weights, "flows": (constant, torch.ones_like(constant[:1]))}


def _checksum(values: Mapping[str, Tensor]) -> int:
    total = 0
    for name in sorted(values):
        total = zlib.crc32(values[name].numpy().tobytes(), total)
    return total


def _resize(flow: Tensor, size: Sequence[int]) -> Tensor:
    return F.interpolate(flow, [*size], mode="bicubic", align_corners=True)
