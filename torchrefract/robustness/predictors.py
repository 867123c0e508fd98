"""Models of others as functions from images (1, 3, H, W) in [0, 1] to a sequence of one prediction."""

import importlib
import os
import sys
import warnings
import zipfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor, nn

from torchrefract._tensor import to_uint8

_KINDS = ("torchvision", "transformers", "ultralytics")
_PROGRAMS = (".pt2", ".onnx", ".pt")
_HOG_SCALE = 4.0  # a margin that counts as certain
_LEAST_SCORE = 0.05  # of detections, as in torchvision
_TASKS = ("ObjectDetection", "SemanticSegmentation", "ImageClassification")  # in names of classes of transformers
_STORED = (".json", ".safetensors", ".bin")  # files of a model of transformers
_BOX_TASKS = ("detect", "segment", "pose")  # of Ultralytics

_PARTS = ("boxes", "labels", "scores")  # of a detection

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
        A function without gradients. Detections of transformers and Ultralytics have scores of at least 0.05, those of
        torchvision of at least the `score_thresh` of the model.

    Raises:
        ImportError: the library of the model is not installed.
        ValueError: the model has another form, or cannot be found.
    """
    kind, _, name = model.partition(":")
    if weights is not None and kind != "torchvision":
        raise ValueError(
            f"weights must be null unless the model is torchvision:name, got {weights} for {model}; load them in a "
            "function: model=package.module:name"
        )
    if kind == "torchvision":
        predict = _load_torchvision(name, weights, device)
    elif kind == "transformers":
        predict = _load_transformers(os.path.expanduser(name), device)
    elif kind == "ultralytics":
        predict = _load_ultralytics(os.path.expanduser(name), device)
    elif Path(model).suffix in _PROGRAMS:
        predict = _load_program(Path(model), device)
    elif model == "opencv:hog":
        predict = _load_hog()
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
    """Return the paths of the files that a model of `load_predictor` is loaded from, as far as they are local.

    That of a function is its module, which must have been imported.
    """
    kind, _, name = model.partition(":")
    if kind in sys.modules and kind not in _KINDS:
        return [path] if (path := getattr(sys.modules[kind], "__file__", None)) else []
    path = Path(name).expanduser() if kind in ("transformers", "ultralytics") else Path(model)
    files = [file for file in sorted(path.iterdir()) if file.suffix in _STORED] if path.is_dir() else [path]
    return [str(file) for file in files if file.is_file()]


def _load_hog() -> Predict:
    """Return the pedestrian detector of OpenCV: boxes of class 1."""
    hog = cv2.HOGDescriptor()
    hog.setSVMDetector(np.array(cv2.HOGDescriptor.getDefaultPeopleDetector(), np.float32))

    def detect(image: np.ndarray) -> dict[str, Tensor]:
        corners, weights, (width, height) = (), (), hog.winSize
        if image.shape[0] >= height and image.shape[1] >= width:  # OpenCV reads beyond the memory of smaller ones
            corners, weights = hog.detectMultiScale(image, winStride=(8, 8), scale=1.05)
        corners = torch.tensor(np.array(corners, np.float32).reshape(-1, 4))
        scores = torch.tensor(np.array(weights, np.float32).reshape(-1)) / _HOG_SCALE
        boxes = torch.cat([corners[:, :2], corners[:, :2] + corners[:, 2:]], dim=1)
        return {"boxes": boxes, "labels": torch.ones(len(boxes), dtype=torch.int64), "scores": scores.clamp(0, 1)}

    return lambda images: [detect(image) for image in _bgr_arrays(images)]


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
        with _naming_file(f"weights must be a state_dict of {name}, got {weights}"):
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
    with _naming_file(rule):
        config = transformers.AutoConfig.from_pretrained(name, **options)
    architecture = " ".join(config.architectures or [])
    task = next((task for task in _TASKS if task in architecture), None)
    if task is None:
        raise ValueError(
            f"model must be a detector, a semantic segmenter or a classifier, got {name} of {architecture or 'no kind'}"
        )
    with _naming_file(rule):
        processor = transformers.AutoImageProcessor.from_pretrained(name, **options)
        network = getattr(transformers, f"AutoModelFor{task}").from_pretrained(name, **options)
    network.eval().to(device)
    if task == "SemanticSegmentation":
        processor.do_center_crop = False  # the library would stretch the classes of the crop over the frame

    def predict(images: Tensor) -> Any:
        outputs = network(**processor(images=list(to_uint8(images)), return_tensors="pt").to(device))
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

    with _naming_file(f"model must be a file of YOLO (.pt) or the name of an architecture (.yaml), got {name}"):
        network = YOLO(name)
    if network.task not in _BOX_TASKS:
        raise ValueError(f"model must detect, segment or pose, got {name} of the task {network.task}")

    def predict(images: Tensor) -> list[dict[str, Tensor]]:
        # Arrays are padded to the size of the network like files; tensors are taken as they are.
        results = network.predict(_bgr_arrays(images), conf=_LEAST_SCORE, device=device, verbose=False)
        boxes = [result.boxes for result in results]
        return [{"boxes": box.xyxy, "labels": box.cls.long(), "scores": box.conf} for box in boxes]

    return predict


def _bgr_arrays(images: Tensor) -> list[np.ndarray]:
    """Return images (B, 3, H, W) as arrays (H, W, 3), uint8, in OpenCV's order of colors."""
    return list(to_uint8(images).flip(1).movedim(1, -1).contiguous().cpu().numpy())


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


def _load_program(path: Path, device: str) -> Predict:
    """Load a model of TorchScript, torch.export or ONNX, which takes images one after the other.

    Outputs boxes, labels and scores, or those of a scripted detector of torchvision, become dicts. Of others, the first
    one is the prediction; one of another form than a score of each class, or a class of each pixel, raises ValueError.
    """
    if not path.is_file():
        raise ValueError(f"model must be a file that exists, got {path}")
    kind = "a TorchScript file of torch.jit.save" if path.suffix == ".pt" else "a program of torch.export or ONNX"
    with _naming_file(f"model must be {kind}, got {path}"):
        if path.suffix == ".onnx":
            outputs = _load_onnx(path)
        elif not zipfile.is_zipfile(path):  # PyTorch prints pages before it raises for these
            raise ValueError("it is no ZIP archive")
        else:
            outputs = _load_torchscript(path, device) if path.suffix == ".pt" else torch.export.load(path).module()

    def predict(images: Tensor) -> Any:
        size = (images.shape[2], images.shape[3])
        predictions = [_prediction(outputs(image), size) for image in images.split(1)]
        return torch.stack(predictions) if isinstance(predictions[0], Tensor) else predictions

    return predict


@contextmanager
def _naming_file(rule: str) -> Iterator[None]:
    """Turn any error of a file that a library cannot load into ValueError."""
    try:
        yield
    except ImportError:
        raise
    except Exception as error:  # PyTorch and ONNX Runtime raise errors of many types
        reason = (str(error).strip() or type(error).__name__).splitlines()[0]
        raise ValueError(f"{rule} ({reason})") from error


def _load_torchscript(path: Path, device: str) -> Predict:
    module = torch.jit.load(path, map_location=device)
    takes_list = isinstance(module.forward.schema.arguments[1].type, torch.ListType)

    def run(images: Tensor) -> Any:
        if not takes_list:
            return module(images)
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", ".*always returns a")  # losses and detections
            return module(list(images))

    return run


def _load_onnx(path: Path) -> Predict:
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
