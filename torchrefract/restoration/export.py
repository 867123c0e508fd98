"""Export a model to a file that runs without torchrefract: a program of `torch.export` or of ONNX."""

import importlib
import io
import json
import logging
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import torch
from torch import Tensor, nn

from torchrefract._io import replace_file
from torchrefract._validation import UsageError
from torchrefract.restoration.checkpoints import Loaded
from torchrefract.restoration.inference import FullSizeModel

FORMATS = (".onnx", ".pt2")
METADATA = "about.json"  # the name of the metadata among the extra files of a .pt2
_INPUT = "image"
_OPSET = 20  # the first with all modes of F.grid_sample
_TOLERANCES = {"restored": 1e-3, "flow": 1e-2}  # share of the range of an image, and px


def export_model(loaded: Loaded, out: Path, *, size: tuple[int, int], interpolation: str) -> dict[str, float]:
    """Export a model for frames of one size and any batch size. Keep the file only if it agrees with the model.

    Args:
        loaded: a model that restores in a single pass.
        out: the file to write, .onnx or .pt2; no other process may write it.
        size: (height, width) of the frames, px.
        interpolation: interpolation of the warp along a predicted flow.

    Returns:
        the largest difference from the model by output: "restored", in units of the range, and "flow", px.

    Raises:
        UsageError: a package is missing, ONNX has no operator for the model, or the file disagrees with the model.
    """
    if out.suffix == ".onnx":
        for package in ("onnxscript", "onnxruntime"):  # fail before the trace, which takes longer
            _import(package)
    height, width = size
    network = FullSizeModel(loaded.model, size=loaded.size, interpolation=interpolation).eval()
    images = torch.rand(2, 3, height, width, generator=torch.Generator().manual_seed(0))
    # torch.export warns of weights in another memory format.
    program = trace(network.to(memory_format=torch.contiguous_format), images)
    with torch.no_grad():
        expected = dict(zip(_TOLERANCES, network(images), strict=False))
    metadata = {
        "model": loaded.name,
        "task": loaded.task,
        "input": f"image, (B, 3, {height}, {width}), RGB in [0, 1]",
        "outputs": [*expected],
        "licenses": loaded.licenses,
    }
    with replace_file(out, alone=True) as path:
        save_program(program, path, outputs=[*expected], metadata=metadata)
        return _compare(path, images, expected)


def trace(network: nn.Module, image: Tensor) -> torch.export.ExportedProgram:
    """Trace a network for images of the size of `image`, (B, C, H, W) with B of at least 2, and any batch size."""
    shapes = {_INPUT: {0: torch.export.Dim("batch")}}
    with torch.no_grad():
        return torch.export.export(network, (image,), dynamic_shapes=shapes)


def save_program(
    program: torch.export.ExportedProgram, path: Path, *, outputs: Sequence[str], metadata: Mapping[str, object]
) -> None:
    """Write a program, the names of its outputs and its metadata in the format of the suffix."""
    text = json.dumps(metadata)
    if path.suffix == ".pt2":
        archive = io.BytesIO()  # torch's writer of files ends the process on a full disk
        torch.export.save(program, archive, extra_files={METADATA: text})
        path.write_bytes(archive.getbuffer())
        return
    logging.getLogger("onnxscript").setLevel(logging.ERROR)  # it warns of operators that it does not optimize
    logging.getLogger("onnx_ir").setLevel(logging.WARNING)
    names: dict[str, Any] = {"input_names": [_INPUT], "output_names": [*outputs]}
    names["dynamic_shapes"] = {_INPUT: {0: "batch"}}  # the program itself numbers its sizes
    exported = torch.onnx.export(program, dynamo=True, opset_version=_OPSET, verbose=False, **names)
    if exported is None:
        raise UsageError(f"out must be .pt2 for a model without operators in ONNX, got {path}")
    exported.model.metadata_props["about"] = text
    exported.save(path)


def load_program(path: Path) -> Callable[[Tensor], list[Tensor]]:
    """Return a function from images (B, C, H, W) to the outputs of a file .pt2 or .onnx, without gradients."""
    if path.suffix == ".pt2":
        program = torch.export.load(path).module()

        @torch.no_grad()
        def run(image: Tensor) -> list[Tensor]:
            outputs = program(image)
            return [outputs] if isinstance(outputs, Tensor) else list(outputs)

        return run
    session = start_session(path)
    name = session.get_inputs()[0].name
    return lambda image: [torch.from_numpy(value) for value in session.run(None, {name: image.cpu().numpy()})]


def start_session(path: Path) -> Any:
    """Start a session of ONNX Runtime on the CPU; raise UsageError if it is not installed."""
    return _import("onnxruntime").InferenceSession(str(path), providers=["CPUExecutionProvider"])


def _compare(path: Path, images: Tensor, expected: Mapping[str, Tensor]) -> dict[str, float]:
    """Compare a file with the model for two batch sizes; one of them is not the traced one."""
    errors, run = dict.fromkeys(expected, 0.0), load_program(path)
    for batch in (slice(0, 2), slice(0, 1)):
        for name, output in zip(expected, run(images[batch]), strict=False):
            errors[name] = max(errors[name], (output - expected[name][batch]).abs().max().item())
    if wrong := [name for name, error in errors.items() if not error <= _TOLERANCES[name]]:
        raise UsageError(f"out must agree with the model, got {wrong[0]} off by {errors[wrong[0]]:.1e}")
    return errors


def _import(name: str) -> ModuleType:
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise UsageError(
            f"out must end in .pt2 if {name} is not installed, got .onnx: pip install onnx onnxscript onnxruntime"
        ) from error
