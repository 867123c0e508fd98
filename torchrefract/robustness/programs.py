"""Models in files of TorchScript, torch.export and ONNX."""

import warnings
import zipfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

_PARTS = ("boxes", "labels", "scores")
Outputs = Callable[[Tensor], Any]


def load_program(path: Path, device: str) -> Callable[[Tensor], Any]:
    """Load a model from a file.

    Args:
        path: .pt of TorchScript, .pt2 of torch.export, or .onnx.
        device: of TorchScript.

    Returns:
        A function from images (B, 3, H, W), which the model takes one after the other, to a list of dicts of boxes
        (n, 4), labels (n,) and scores (n,), if the outputs have these names or are those of a scripted detector of
        torchvision; otherwise to the first outputs, (B, K), (B, K, H, W) or (B, H, W). It raises ValueError for outputs
        of another form.

    Raises:
        ImportError, UsageError: ONNX Runtime is not installed.
        ValueError: no file, or one of another kind.
    """
    if not path.is_file():
        raise ValueError(f"model must be a file that exists, got {path}")
    if path.suffix == ".pt":
        with naming_file(f"model must be a TorchScript file of torch.jit.save, got {path}"):
            _check_zip(path)
            outputs = _load_torchscript(path, device)
    else:
        with naming_file(f"model must be a program of torch.export or ONNX, got {path}"):
            outputs = _load_exported(path) if path.suffix == ".pt2" else _load_onnx(path)

    def predict(images: Tensor) -> Any:
        size = (images.shape[2], images.shape[3])
        predictions = [_prediction(outputs(image), size) for image in images.split(1)]
        return torch.stack(predictions) if isinstance(predictions[0], Tensor) else predictions

    return predict


@contextmanager
def naming_file(rule: str) -> Iterator[None]:
    """Turn any error of a file that a library cannot load into ValueError."""
    try:
        yield
    except ImportError:
        raise
    except Exception as error:  # PyTorch and ONNX Runtime raise errors of many types
        reason = (str(error).strip() or type(error).__name__).splitlines()[0]
        raise ValueError(f"{rule} ({reason})") from error


def _check_zip(path: Path) -> None:
    # PyTorch prints pages before it raises for other files.
    if not zipfile.is_zipfile(path):
        raise ValueError("it is no ZIP archive")


def _load_torchscript(path: Path, device: str) -> Outputs:
    module = torch.jit.load(path, map_location=device)
    takes_list = isinstance(module.forward.schema.arguments[1].type, torch.ListType)

    def run(images: Tensor) -> Any:
        if not takes_list:
            return module(images)
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", ".*always returns a")  # losses and detections
            return module(list(images))

    return run


def _load_exported(path: Path) -> Outputs:
    _check_zip(path)
    return torch.export.load(path).module()


def _load_onnx(path: Path) -> Outputs:
    from torchrefract.restoration.export import start_session  # noqa: PLC0415 - imports the training stack

    session = start_session(path)
    given, names = session.get_inputs()[0], [output.name for output in session.get_outputs()]

    def run(images: Tensor) -> dict[str, Tensor]:
        # Detectors of torchvision are exported for a list of images (3, H, W).
        image = (images[0] if len(given.shape) == 3 else images).cpu().numpy()
        return {
            name: torch.from_numpy(value)
            for name, value in zip(names, session.run(None, {given.name: image}), strict=True)
        }

    return run


def _prediction(outputs: Any, size: tuple[int, int]) -> Any:
    named = _named(outputs)
    if all(isinstance(named.get(name), Tensor) for name in _PARTS):
        boxes, labels, scores = (named[name] for name in _PARTS)
        return {"boxes": boxes.reshape(-1, 4), "labels": labels.flatten().long(), "scores": scores.flatten()}
    first = next(iter(named.values()), None)
    shape = tuple(first.shape) if isinstance(first, Tensor) else ()
    if first is not None and shape[:1] == (1,) and (len(shape) == 2 or (len(shape) in (3, 4) and shape[-2:] == size)):
        return first[0]
    got = ", ".join(
        f"{n} {tuple(of.shape) if isinstance(of, Tensor) else type(of).__name__}" for n, of in named.items()
    )
    height, width = size
    raise ValueError(
        f"model must have the outputs boxes, labels and scores, or a first one (1, K), (1, K, {height}, {width}) or "
        f"(1, {height}, {width}), got outputs {got}; export it with these names, or pass a function: "
        "model=package.module:callable"
    )


def _named(outputs: Any) -> Mapping[Any, Any]:
    """Return the outputs by name or by number; those of a scripted detector are its losses and a list of detections."""
    if isinstance(outputs, tuple) and len(outputs) == 2 and isinstance(outputs[1], list):
        outputs = outputs[1]
    if isinstance(outputs, list | tuple) and len(outputs) == 1 and isinstance(outputs[0], dict):
        outputs = outputs[0]
    if isinstance(outputs, dict):
        return outputs
    return dict(enumerate(outputs if isinstance(outputs, list | tuple) else [outputs]))
