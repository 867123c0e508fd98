"""Models of others as functions from images (1, 3, H, W) in [0, 1] to a sequence of one prediction."""

import importlib
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor, nn

from torchrefract.robustness.programs import load_program, naming_file

_PROGRAMS = (".pt2", ".onnx", ".pt")
_HOG_SCALE = 4.0  # a margin that counts as certain
_LEAST_SCORE = 0.05  # of detections, as in torchvision
_TASKS = ("ObjectDetection", "SemanticSegmentation", "ImageClassification")  # in names of classes of transformers
_STORED = (".json", ".safetensors", ".bin")  # files of a model of transformers
_BOX_TASKS = ("detect", "segment", "pose")  # of Ultralytics

Predict = Callable[[Tensor], Any]


def load_predictor(model: str, *, weights: str | None = None, device: str = "cpu") -> Predict:
    """Load a model.

    Args:
        model: one of
            "package.module:name": a function from images to predictions, or an nn.Module, of a module that Python can
                import from here.
            "torchvision:name": a detector, segmenter or classifier of `torchvision.models`, such as
                "torchvision:fasterrcnn_resnet50_fpn".
            "transformers:name": a detector, semantic segmenter or classifier of the Hugging Face hub, or of a folder
                that `save_pretrained` wrote, such as "transformers:hustvl/yolos-tiny".
            "ultralytics:file": a YOLO file (.pt), or the name of an architecture (.yaml) with random weights; boxes,
                also of models that segment or find keypoints.
            "opencv:hog": the pedestrian detector of OpenCV (Dalal and Triggs 2005), which needs no weights; its scores
                are the margins of its classifier, divided by 4.
            a file: .pt2 of torch.export, .onnx, or .pt of TorchScript, for images of the size that it takes: a detector
                with the outputs boxes, labels and scores, as those of torchvision, or scores (1, K) or (1, K, H, W) as
                the first output.
        weights: for torchvision: a file of its state_dict, or None for the weights that torchvision downloads.
        device: of models in PyTorch.

    Returns:
        A function without gradients. Detections of transformers and Ultralytics have scores of at least 0.05.

    Raises:
        ImportError: the library of the model is not installed.
        ValueError: the model has another form, or cannot be found.
    """
    kind, _, name = model.partition(":")
    if kind == "torchvision":
        predict = _load_torchvision(name, weights, device)
    elif kind == "transformers":
        predict = _load_transformers(os.path.expanduser(name), device)
    elif kind == "ultralytics":
        predict = _load_ultralytics(os.path.expanduser(name), device)
    elif Path(model).suffix in _PROGRAMS:
        predict = load_program(Path(model), device)
    elif model == "opencv:hog":
        predict = HogDetector()
    elif name:
        predict = import_function(kind, name, device)
    else:
        raise ValueError(
            "model must be package.module:name, torchvision:name, transformers:name, ultralytics:file, opencv:hog or a "
            f"file .pt2, .onnx or .pt, got {model}"
        )

    def without_gradient(images: Tensor) -> Any:
        with torch.inference_mode():
            outputs = predict(images.to(device))
        # Segmenters of torchvision return a dictionary.
        return outputs["out"] if isinstance(outputs, dict) and "out" in outputs else outputs

    return without_gradient


def model_files(model: str) -> list[str]:
    """Return the paths of the files that a model of `load_predictor` is loaded from, as far as they are local."""
    kind, _, name = model.partition(":")
    path = Path(name).expanduser() if kind in ("transformers", "ultralytics") else Path(model)
    files = [file for file in sorted(path.iterdir()) if file.suffix in _STORED] if path.is_dir() else [path]
    return [str(file) for file in files if file.is_file()]


class HogDetector:
    """The pedestrian detector of OpenCV: boxes of class 1."""

    def __init__(self) -> None:
        self._hog = cv2.HOGDescriptor()
        self._hog.setSVMDetector(np.array(cv2.HOGDescriptor.getDefaultPeopleDetector(), np.float32))

    def __call__(self, images: Tensor) -> list[dict[str, Tensor]]:
        """Detect pedestrians in images (B, 3, H, W)."""
        return [self._detect(image.movedim(0, -1).cpu().numpy()) for image in _as_bytes(images)]

    def _detect(self, image: np.ndarray) -> dict[str, Tensor]:
        corners, weights = (), ()
        (width, height), image = self._hog.winSize, np.ascontiguousarray(image[..., ::-1])
        if image.shape[0] >= height and image.shape[1] >= width:  # OpenCV reads beyond the memory of smaller ones
            corners, weights = self._hog.detectMultiScale(image, winStride=(8, 8), scale=1.05)
        corners = torch.tensor(np.array(corners, np.float32).reshape(-1, 4))
        scores = torch.tensor(np.array(weights, np.float32).reshape(-1)) / _HOG_SCALE
        boxes = torch.cat([corners[:, :2], corners[:, :2] + corners[:, 2:]], dim=1)
        return {"boxes": boxes, "labels": torch.ones(len(boxes), dtype=torch.int64), "scores": scores.clamp(0, 1)}


def _as_bytes(images: Tensor) -> Tensor:
    """Return images as uint8, which is what libraries read from files."""
    return (255 * images).round().clamp(0, 255).byte()


def _load_torchvision(name: str, weights: str | None, device: str) -> Predict:
    from torchvision import models  # noqa: PLC0415 - an extra

    if name not in models.list_models():
        raise ValueError(f"model must be one of torchvision.models.list_models(), got torchvision:{name}")
    kind = models.get_model_builder(name).__module__.split(".")[2]  # detection, segmentation or a family of classifiers
    stored: Any = models.get_model_weights(name)["DEFAULT"]
    if weights is None:
        network = models.get_model(name, weights=stored)
    else:
        parts = {"weights_backbone": None} if kind in ("detection", "segmentation") else {}
        network = models.get_model(name, weights=None, **parts)
        if not Path(weights).is_file():
            raise ValueError(f"weights must be a file that exists, got {weights}")
        with naming_file(f"weights must be a state_dict of {name}, got {weights}"):
            network.load_state_dict(torch.load(weights, map_location="cpu", weights_only=True))
    # A segmenter must keep the size of the images, in which the labels are.
    prepare = stored.transforms(resize_size=None) if kind == "segmentation" else stored.transforms()
    network = network.eval().to(device)
    return lambda images: network(prepare(images))


def _load_transformers(name: str, device: str) -> Predict:
    with _installed("transformers", 'pip install "torchrefract[depth]"', name):
        import transformers  # noqa: PLC0415 - an extra

    options: dict[str, Any] = {"local_files_only": os.path.isdir(name)}
    rule = (
        "model must be one of the Hugging Face hub that can be reached, or a folder of one (download it elsewhere and "
        f"pass the folder), got {name}"
    )
    with naming_file(rule):
        config = transformers.AutoConfig.from_pretrained(name, **options)
    architecture = " ".join(config.architectures or [])
    task = next((task for task in _TASKS if task in architecture), None)
    if task is None:
        raise ValueError(
            f"model must be a detector, a semantic segmenter or a classifier, got {name} of {architecture or 'no kind'}"
        )
    with naming_file(rule):
        processor = transformers.AutoImageProcessor.from_pretrained(name, **options)
        network = getattr(transformers, f"AutoModelFor{task}").from_pretrained(name, **options)
    network.eval().to(device)
    if task == "SemanticSegmentation":
        processor.do_center_crop = False  # the library would stretch the classes of the crop over the frame

    def predict(images: Tensor) -> Any:
        outputs = network(**processor(images=list(_as_bytes(images)), return_tensors="pt").to(device))
        sizes = [tuple(images.shape[2:])] * len(images)
        if task == "ObjectDetection":
            return processor.post_process_object_detection(outputs, threshold=_LEAST_SCORE, target_sizes=sizes)
        if task == "SemanticSegmentation":
            return processor.post_process_semantic_segmentation(outputs, target_sizes=sizes)
        return outputs.logits

    return predict


def _load_ultralytics(name: str, device: str) -> Predict:
    with _installed("ultralytics", "pip install ultralytics", name):
        from ultralytics import YOLO  # noqa: PLC0415 # pyright: ignore[reportMissingImports]  # in no extra

    with naming_file(f"model must be a file of YOLO (.pt) or the name of an architecture (.yaml), got {name}"):
        network = YOLO(name)
    if network.task not in _BOX_TASKS:
        raise ValueError(f"model must detect, segment or pose, got {name} of the task {network.task}")

    def predict(images: Tensor) -> list[dict[str, Tensor]]:
        # Arrays are padded to the size of the network like files; tensors are taken as they are.
        arrays = list(_as_bytes(images).flip(1).movedim(1, -1).contiguous().cpu().numpy())  # BGR
        results = network.predict(arrays, conf=_LEAST_SCORE, device=device, verbose=False)
        boxes = [result.boxes for result in results]
        return [{"boxes": box.xyxy, "labels": box.cls.long(), "scores": box.conf} for box in boxes]

    return predict


@contextmanager
def _installed(library: str, remedy: str, name: str) -> Iterator[None]:
    try:
        yield
    except ImportError as error:
        raise ImportError(f"{library}:{name} needs {library}: {remedy} ({error})") from error


def import_function(module: str, name: str, device: str = "cpu") -> Callable[..., Any]:
    """Import a function or an nn.Module, which is moved to the device, from a module below the current folder or not.

    Raises:
        ValueError: if there is none.
    """
    if os.getcwd() not in sys.path:
        sys.path.insert(0, os.getcwd())  # as `python -m` does
    try:
        function = getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError) as error:
        raise ValueError(
            f"a function must be package.module:name that can be imported, got {module}:{name}: {error}"
        ) from error
    if isinstance(function, nn.Module):
        return function.eval().to(device)
    if not callable(function):
        raise ValueError(f"a function or an nn.Module must be named, got {module}:{name}, {type(function).__name__}")
    return function
