"""Detectors, segmenters and classifiers that were exported to files."""

import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from pictures import save_picture
from torch import Tensor, nn
from torch.testing import assert_close
from torchvision.models.detection.anchor_utils import DefaultBoxGenerator
from torchvision.models.detection.ssd import SSD

from torchrefract.robustness.predictors import load_predictor

# Of TorchScript and of its exporter for ONNX, which people still have.
pytestmark = [
    pytest.mark.filterwarnings("ignore:.*deprecated"),  # PyTorch's, of torch.jit
    pytest.mark.filterwarnings("ignore:You are using the legacy TorchScript-based ONNX export"),  # PyTorch's
]
SIZE = (72, 128)
NAMES = ["boxes", "scores", "labels"]  # the order of SSD


@pytest.fixture(scope="module")
def detector() -> nn.Module:
    """Return a detector of torchvision with a tiny backbone and random weights."""
    torch.manual_seed(0)
    layers = [nn.Conv2d(3, 8, 3, 2, 1), nn.ReLU(), nn.Conv2d(8, 8, 3, 2, 1), nn.ReLU(), nn.Conv2d(8, 8, 3, 2, 1)]
    backbone = nn.Sequential(*layers)
    backbone.out_channels = [8]  # pyright: ignore[reportArgumentType]  # torchvision reads it
    boxes = DefaultBoxGenerator([[2]], scales=[0.2, 0.5])
    return SSD(backbone, boxes, (64, 96), 3, head=None).eval()


@pytest.fixture
def image() -> Tensor:
    return torch.rand(1, 3, *SIZE, generator=torch.Generator().manual_seed(1))


@pytest.fixture
def write(detector, image, tmp_path) -> Callable[..., Path]:
    """Return a function that exports the detector with the names of its outputs."""

    def export(suffix: str, names: list[str] | None = None) -> Path:
        path = tmp_path / f"detector{suffix}"
        if suffix == ".pt":
            torch.jit.script(detector).save(path)
            return path
        pytest.importorskip("onnxruntime", reason="onnxruntime is in the extra export")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # it warns of many operators
            torch.onnx.export(detector, ([image[0]],), path, dynamo=False, output_names=names)
        return path

    return export


@pytest.mark.parametrize("suffix", [".pt", ".onnx"])
def test_an_exported_detector_of_torchvision_predicts_its_boxes(detector, image, write, suffix):
    with torch.no_grad():
        (expected,) = detector(image)
    (prediction,) = load_predictor(str(write(suffix, NAMES)))(image)
    assert len(expected["boxes"]) > 10
    assert {*prediction} == {*NAMES}
    for name in NAMES:
        assert_close(prediction[name], expected[name], rtol=1e-4, atol=1e-4)


def test_outputs_with_a_dimension_of_the_batch_are_taken(tmp_path, image):
    class Padded(nn.Module):
        def forward(self, images: Tensor) -> dict[str, Tensor]:
            boxes = torch.tensor([[[1.0, 2.0, 30.0, 40.0], [0.0, 0.0, 0.0, 0.0]]])
            return {"boxes": boxes, "scores": boxes[..., 2] / 60, "labels": boxes[..., 0]}

    torch.jit.script(Padded()).save(tmp_path / "padded.pt")
    torch.export.save(torch.export.export(Padded(), (image,)), tmp_path / "padded.pt2")
    for name in ("padded.pt", "padded.pt2"):
        (prediction,) = load_predictor(str(tmp_path / name))(image)
        assert_close(prediction["boxes"], torch.tensor([[1.0, 2, 30, 40], [0, 0, 0, 0]]))
        assert prediction["labels"].tolist() == [1, 0]
        assert prediction["labels"].dtype == torch.int64
        assert prediction["scores"].tolist() == [0.5, 0]


def test_outputs_that_are_no_prediction_are_named_with_the_remedy(score, tmp_path, write):
    write(".onnx")
    save_picture(tmp_path / "frames" / "0.png", np.full((*SIZE, 3), 90, np.uint8))
    yolo = nn.Sequential(nn.Flatten(1), nn.Unflatten(1, (6, -1)))
    torch.export.save(torch.export.export(yolo, (torch.rand(1, 3, *SIZE),)), tmp_path / "yolo.pt2")
    words = ("scene=cheap_dashcam", "severity=1")
    message = score("model=detector.onnx", *words).message
    assert "model must have the outputs boxes, labels and scores, or a first one (1, K), (1, K, 72, 128)" in message
    assert message.endswith("; export it with these names, or pass a function: model=package.module:callable")
    assert message.count("(n, 4)") == 0
    assert ", 4)" in message
    message = score("model=yolo.pt2", *words).message
    assert f"got outputs 0 (1, 6, {3 * 72 * 128 // 6})" in message


def test_exported_segmenters_and_classifiers_keep_their_first_output(tmp_path, image):
    class Segmenter(nn.Module):
        def forward(self, images: Tensor) -> dict[str, Tensor]:
            return {"out": images[:, :2], "aux": images}

    class Classifier(nn.Module):
        def forward(self, images: Tensor) -> tuple[Tensor, Tensor]:
            return images.mean(dim=(2, 3)), images

    torch.jit.script(Segmenter()).save(tmp_path / "segmenter.pt")
    torch.jit.script(Classifier()).save(tmp_path / "classifier.pt")
    torch.export.save(torch.export.export(Segmenter(), (image,)), tmp_path / "segmenter.pt2")
    torch.export.save(torch.export.export(Classifier(), (image,)), tmp_path / "classifier.pt2")
    for suffix in (".pt", ".pt2"):
        images = torch.cat([image, image.flip(3)])  # .pt2 has the batch size with which it was exported
        classes, scores = (load_predictor(str(tmp_path / f"{n}{suffix}"))(images) for n in ("segmenter", "classifier"))
        assert torch.equal(classes, images[:, :2])
        assert torch.equal(scores, images.mean(dim=(2, 3)))
