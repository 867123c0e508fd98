"""Networks as programs that need no torchrefract: of torch.export, and of ONNX."""

import importlib
import json
import logging
from collections.abc import Mapping
from pathlib import Path
from types import ModuleType

import torch
from torch import Tensor, nn

from torchrefract._validation import UsageError

FORMATS = (".onnx", ".pt2")
ABOUT = "about.json"  # of a .pt2, in its extra files
_INPUT = "image"
_OPSET = 20  # the first whose GridSample has all that F.grid_sample has


def traced(network: nn.Module, image: Tensor) -> torch.export.ExportedProgram:
    """A network as a program for images of the size of this one, (B, C, H, W) with B of at least 2, in any batch."""
    shapes = {_INPUT: {0: torch.export.Dim("batch")}}
    with torch.no_grad():
        return torch.export.export(network, (image,), dynamic_shapes=shapes)


def save_program(program: torch.export.ExportedProgram, path: Path, *, about: Mapping[str, object]) -> None:
    """Write a program in the format of a name, with what is to be known of it in plain values."""
    text = json.dumps(about)
    if path.suffix == ".pt2":
        torch.export.save(program, path, extra_files={ABOUT: text})
        return
    _needed("onnxscript")
    logging.getLogger("onnxscript").setLevel(logging.ERROR)  # it warns of what it leaves as it is
    logging.getLogger("onnx_ir").setLevel(logging.WARNING)
    outputs = list(about["outputs"]) if isinstance(about["outputs"], list) else []
    made = torch.onnx.export(
        program, dynamo=True, input_names=[_INPUT], output_names=outputs, opset_version=_OPSET, verbose=False
    )
    if made is None:
        raise UsageError(f"out must be .pt2 for what ONNX has no operators for, got {path}")
    made.model.metadata_props["about"] = text
    made.save(path)


def outputs_of(path: Path, image: Tensor) -> list[Tensor]:
    """What the program in a file makes of images; that of ONNX by ONNX Runtime, or else by ONNX's reference."""
    if path.suffix == ".pt2":
        with torch.no_grad():
            return list(torch.export.load(path).module()(image))
    feed = {_INPUT: image.numpy()}
    try:
        runtime = _needed("onnxruntime")
    except UsageError:
        session = _needed("onnx.reference").ReferenceEvaluator(str(path))
    else:
        session = runtime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    return [torch.from_numpy(value) for value in session.run(None, feed)]


def _needed(name: str) -> ModuleType:
    try:
        return importlib.import_module(name)
    except ImportError as error:
        package = name.partition(".")[0]
        raise UsageError(
            f"out must end in .pt2 where {package} is not installed, got .onnx: pip install onnx onnxscript onnxruntime"
        ) from error
