"""Models of other libraries: they are tiny, with random weights, but of the classes that users load."""

import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor
from torch.testing import assert_close

from torchrefract.robustness.predictors import load_predictor, model_files

SIZES = [(72, 128), (150, 60)]
Write = Callable[..., Path]


@pytest.fixture
def transformers(monkeypatch) -> Any:
    """Return the library, which may not reach the hub."""
    library = pytest.importorskip("transformers", reason="transformers is in the extra test")
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    return library


@pytest.fixture
def write(transformers, tmp_path) -> Write:
    """Return a function that writes a tiny model of a task to a folder."""

    def write_model(task: str, *, seed: int = 0, change: Callable[[Any], None] | None = None) -> Path:
        torch.manual_seed(seed)
        size = {"hidden_size": 16, "num_hidden_layers": 2, "num_attention_heads": 2, "intermediate_size": 16}
        square = {"height": 64, "width": 64}
        processor = transformers.SegformerImageProcessor(size=square)
        if task == "detector":
            config = transformers.YolosConfig(**size, image_size=[64, 96], num_detection_tokens=5, num_labels=3)
            model = transformers.YolosForObjectDetection(config)
            processor = transformers.YolosImageProcessor(size={"shortest_edge": 64, "longest_edge": 96})
        elif task == "segmenter":
            widths = {"hidden_sizes": [8, 8, 16, 16], "num_attention_heads": [1, 1, 2, 2], "depths": [1, 1, 1, 1]}
            config = transformers.SegformerConfig(**widths, decoder_hidden_size=16, num_labels=5)
            model = transformers.SegformerForSemanticSegmentation(config)
        elif task == "classifier":
            config = transformers.ViTConfig(**size, image_size=64, patch_size=16, num_labels=7)
            model = transformers.ViTForImageClassification(config)
            processor = transformers.ViTImageProcessor(size=square)
        else:
            model = transformers.ViTModel(transformers.ViTConfig(**size, image_size=64, patch_size=16))
        if change is not None:
            change(model)
        folder = tmp_path / task
        model.save_pretrained(folder)
        processor.save_pretrained(folder)
        return folder

    return write_model


def picture(height: int, width: int) -> Image.Image:
    """Return noise with blocks of 8 px."""
    blocks = np.random.default_rng(0).integers(0, 256, (height // 8 + 1, width // 8 + 1, 3), dtype=np.uint8)
    return Image.fromarray(np.ascontiguousarray(blocks.repeat(8, axis=0).repeat(8, axis=1)[:height, :width]))


def as_images(image: Image.Image) -> Tensor:
    return torch.from_numpy(np.array(image)).movedim(-1, 0)[None] / 255


@pytest.mark.parametrize("size", SIZES)
def test_boxes_of_a_detector_of_transformers_are_in_px_of_the_frame(write, size):
    corners = torch.tensor([0.1, 0.25, 0.5, 0.75])  # x1, y1, x2, y2 as shares of the frame
    centers = torch.stack([(corners[0] + corners[2]) / 2, (corners[1] + corners[3]) / 2])

    def aim(model: Any) -> None:
        box, names = model.bbox_predictor.layers[-1], model.class_labels_classifier.layers[-1]
        for layer, bias in ((box, torch.cat([centers, corners[2:] - corners[:2]]).logit()), (names, [-4, -4, 3, -4])):
            torch.nn.init.zeros_(layer.weight)
            layer.bias.data = torch.as_tensor(bias, dtype=torch.float32)

    (prediction,) = load_predictor(f"transformers:{write('detector', change=aim)}")(as_images(picture(*size)))
    scale = torch.tensor([size[1], size[0], size[1], size[0]])
    assert_close(prediction["boxes"], (corners * scale).expand(5, 4), rtol=0, atol=1e-3)
    assert prediction["labels"].tolist() == [2] * 5
    assert_close(prediction["scores"], torch.tensor([-4, -4, 3, -4.0]).softmax(dim=0)[2].expand(5))


@pytest.mark.parametrize("size", SIZES)
def test_a_detector_of_transformers_predicts_as_the_pipeline_of_the_library(transformers, write, size):
    folder, image = write("detector"), picture(*size)
    (prediction,) = load_predictor(f"transformers:{folder}")(as_images(image))
    expected = transformers.pipeline("object-detection", str(folder), threshold=0.05, device="cpu")(image)
    assert len(expected) == 5
    # The pipeline truncates boxes to whole pixels.
    boxes = [[row["box"][name] for name in ("xmin", "ymin", "xmax", "ymax")] for row in expected]
    order = prediction["scores"].argsort(descending=True)
    assert prediction["boxes"][order].int().tolist() == boxes
    assert_close(prediction["scores"][order], torch.tensor([row["score"] for row in expected]))
    assert [f"LABEL_{name}" for name in prediction["labels"][order].tolist()] == [row["label"] for row in expected]


@pytest.mark.parametrize("size", SIZES)
def test_a_segmenter_of_transformers_predicts_as_the_pipeline_of_the_library(transformers, write, size):
    folder, image = write("segmenter"), picture(*size)
    (prediction,) = load_predictor(f"transformers:{folder}")(as_images(image))
    parts = transformers.pipeline("image-segmentation", str(folder), device="cpu")(image)
    assert len(parts) > 1
    expected = np.zeros(size, int)
    for part in parts:
        expected[np.array(part["mask"]) > 0] = int(part["label"].removeprefix("LABEL_"))
    assert prediction.tolist() == expected.tolist()


def test_a_segmenter_whose_processor_crops_sees_the_complete_frame(transformers, write):
    folder, image = write("segmenter"), picture(72, 128)
    crop = {"do_center_crop": True, "crop_size": {"height": 64, "width": 64}}
    processor = transformers.MobileViTImageProcessor(size={"shortest_edge": 64}, **crop)
    processor.save_pretrained(folder)
    (prediction,) = load_predictor(f"transformers:{folder}")(as_images(image))
    model = transformers.AutoModelForSemanticSegmentation.from_pretrained(folder).eval()
    with torch.no_grad():
        logits = model(**processor(image, do_center_crop=False, return_tensors="pt")).logits
    expected = torch.nn.functional.interpolate(logits, size=(72, 128), mode="bilinear").argmax(dim=1)[0]
    assert_close(prediction, expected)
    assert len(expected.unique()) > 1


def test_a_classifier_of_transformers_predicts_as_the_pipeline_of_the_library(transformers, write):
    folder, image = write("classifier"), picture(72, 128)
    (logits,) = load_predictor(f"transformers:{folder}")(as_images(image))
    classify = transformers.pipeline("image-classification", str(folder), device="cpu")
    expected = {row["label"]: row["score"] for row in classify(image, top_k=7)}
    assert_close(logits.softmax(dim=0), torch.tensor([expected[f"LABEL_{i}"] for i in range(7)]))


def test_transformers_models_of_other_tasks_and_lost_ones_are_refused(write, tmp_path):
    with pytest.raises(ValueError, match=r"detector, a semantic segmenter or a classifier, got .*backbone of ViTModel"):
        load_predictor(f"transformers:{write('backbone')}")
    (tmp_path / "empty").mkdir()
    for name in ("someone/no-such-detector", str(tmp_path / "empty"), str(tmp_path / "lost")):
        with pytest.raises(ValueError, match=rf"folder of one \(download it elsewhere .* got {re.escape(name)}"):
            load_predictor(f"transformers:{name}")


def test_another_transformers_model_in_the_same_folder_is_not_mixed_with_the_scores_of_the_first(
    score, write, tmp_path
):
    (tmp_path / "frames").mkdir()
    picture(72, 128).save(tmp_path / "frames" / "0.png")
    for seed, code in ((0, 0), (0, 0), (1, 1)):
        model = f"model=transformers:{write('segmenter', seed=seed).name}"
        outcome = score(model, "scene=cheap_dashcam", "severity=1")
        assert outcome.code == code, outcome.err
    assert "out must be a folder of the same settings, got one with files={'segmenter/config.json': " in outcome.err


@pytest.mark.quick
def test_files_of_a_model_are_those_that_it_is_loaded_from(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path))
    (tmp_path / "folder").mkdir()
    for name in ("best.pt", "folder/model.safetensors", "folder/config.json", "folder/optimizer.pt"):
        (tmp_path / name).touch()
    assert model_files("best.pt") == model_files("ultralytics:best.pt") == ["best.pt"]
    assert model_files("ultralytics:~/best.pt") == [str(tmp_path / "best.pt")]
    assert model_files("transformers:folder") == ["folder/config.json", "folder/model.safetensors"]
    for name in ("ultralytics:yolo11n.yaml", "transformers:hustvl/yolos-tiny", "torchvision:resnet18", "opencv:hog"):
        assert model_files(name) == []


@pytest.mark.parametrize(
    ("library", "remedy"), [("transformers", 'pip install "torchrefract[depth]"'), ("ultralytics", "pip install ultra")]
)
def test_a_missing_library_is_one_line_of_error_with_the_command_that_installs_it(
    score, tmp_path, monkeypatch, library, remedy
):
    (tmp_path / "frames").mkdir()
    picture(8, 8).save(tmp_path / "frames" / "0.png")
    monkeypatch.setitem(sys.modules, library, None)
    message = score(f"model={library}:best.pt").message
    assert message.startswith(f"model: {library}:best.pt needs {library}: {remedy}")


@pytest.fixture
def ultralytics(tmp_path, monkeypatch) -> Any:
    library = pytest.importorskip("ultralytics", reason="ultralytics is under the AGPL and in no extra")
    monkeypatch.chdir(tmp_path)
    return library


@pytest.mark.filterwarnings("default")  # Ultralytics warns of its own code
@pytest.mark.parametrize("size", [*SIZES, (700, 900)])
@pytest.mark.parametrize("task", ["", "-seg"])
def test_a_detector_of_ultralytics_predicts_as_for_a_file(ultralytics, tmp_path, size, task):
    torch.manual_seed(0)
    model = ultralytics.YOLO(f"yolo11n{task}.yaml")
    for branch in model.model.model[-1].cv3:  # it is unsure of everything at the start
        torch.nn.init.normal_(branch[-1].weight, std=1.0)
        torch.nn.init.constant_(branch[-1].bias, -2.0)
    model.save(tmp_path / "best.pt")
    image = picture(*size)
    image.save(tmp_path / "frame.png")
    (prediction,) = load_predictor(f"ultralytics:{tmp_path / 'best.pt'}")(as_images(image))
    (expected,) = ultralytics.YOLO(tmp_path / "best.pt").predict(tmp_path / "frame.png", conf=0.05, verbose=False)
    assert len(expected.boxes) > 0
    assert_close(prediction["boxes"], expected.boxes.xyxy)
    assert_close(prediction["scores"], expected.boxes.conf)
    assert prediction["labels"].dtype == torch.int64
    assert prediction["labels"].tolist() == expected.boxes.cls.int().tolist()
    assert (prediction["boxes"].amax(dim=0) <= torch.tensor([size[1], size[0]] * 2)).all()
    assert {path.name for path in tmp_path.iterdir()} == {"best.pt", "frame.png"}


@pytest.mark.filterwarnings("default")  # Ultralytics warns of its own code
def test_architectures_of_ultralytics_are_taken_and_other_tasks_and_files_refused(ultralytics, tmp_path):
    predictions = load_predictor("ultralytics:yolo11n.yaml")(torch.rand(2, 3, 40, 60))
    assert [set(prediction) for prediction in predictions] == [{"boxes", "labels", "scores"}] * 2
    with pytest.raises(ValueError, match=r"detect, segment or pose, got yolo11n-obb\.yaml of the task obb"):
        load_predictor("ultralytics:yolo11n-obb.yaml")
    (tmp_path / "text.pt").write_text("nothing")
    torch.save({}, tmp_path / "other.pt")
    for name in ("lost.yaml", "lost.pt", "text.pt", "other.pt"):
        with pytest.raises(ValueError, match=f"model must be a file of YOLO .* got {name}"):
            load_predictor(f"ultralytics:{name}")
