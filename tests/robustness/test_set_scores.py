"""Scores of all images together, against pycocotools on written files and the Jaccard index of torchmetrics."""

import csv
import json
import math
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from pictures import save_picture
from pycocotools.coco import COCO
from pycocotools.cocoeval import COCOeval
from torchmetrics.classification import MulticlassJaccardIndex

from torchrefract.data.images import read_image
from torchrefract.robustness.predictors import import_function
from torchrefract.robustness.scores import segmentation_score
from torchrefract.robustness.set_scores import set_scores, summarize

MODEL = """
import cv2
import torch

def detect(images):
    '''Detect red and green squares, some of them with wrong borders, and some twice.'''
    boxes, labels, scores = [], [], []
    for name, channel in ((1, 0), (2, 1)):
        mask = (images[0, channel] > 0.6).byte().numpy()
        for x, y, width, height, _ in cv2.connectedComponentsWithStats(mask)[2][1:].tolist():
            error = (3 * x + y) % 5
            boxes += [[x + error, y, x + width, y + height], [x, y, x + width, y + 2 * height]][: 1 + x % 2]
            labels += [name] * (1 + x % 2)
            scores += [((7 * x + 3 * y) % 31) / 31, ((5 * x + y) % 29) / 29][: 1 + x % 2]
    boxes, scores = torch.tensor(boxes).float().view(-1, 4), torch.tensor(scores).float()
    return [{"boxes": boxes, "labels": torch.tensor(labels).long(), "scores": scores}]
"""


@pytest.fixture
def frames(tmp_path, write_module) -> Path:
    """Write six pictures with squares of two classes, their labels, and a model with errors."""
    rng, images, rows = np.random.default_rng(0), [], []
    for i in range(6):
        picture = np.full((96, 160, 3), 90, np.uint8)
        for x in range(10, 140, 45):
            name, left, top, side = rng.integers((1, x, 10, 14), (3, x + 12, 60, 24)).tolist()
            picture[top : top + side, left : left + side] = (255, 90, 90) if name == 1 else (90, 255, 90)
            rows.append({"image_id": i, "bbox": [left, top, side, side], "category_id": name})
        save_picture(tmp_path / "frames" / f"{i}.png", picture)
        images.append({"id": i, "file_name": f"{i}.png", "height": 96, "width": 160})
    rows = [{"id": i + 1, "area": row["bbox"][2] ** 2, "iscrowd": 0} | row for i, row in enumerate(rows)]
    categories = [{"id": 1, "name": "red"}, {"id": 2, "name": "green"}]
    (tmp_path / "coco.json").write_text(json.dumps({"images": images, "annotations": rows, "categories": categories}))
    write_module("squares", MODEL)
    return tmp_path / "frames"


def coco_scores(folder: Path, labels: Path) -> dict[str, float]:
    """Run the evaluation of pycocotools on the predictions for pictures and their written labels."""
    truth, rows = COCO(str(labels)), []
    for i, image in truth.imgs.items():
        (prediction,) = import_function("squares", "detect")(read_image(folder / image["file_name"])[None])
        for (x1, y1, x2, y2), name, score in zip(*(part.tolist() for part in prediction.values()), strict=True):
            rows.append({"image_id": i, "category_id": name, "bbox": [x1, y1, x2 - x1, y2 - y1], "score": score})
    predictions = labels.with_name("predictions.json")
    predictions.write_text(json.dumps(rows))
    evaluation = COCOeval(truth, truth.loadRes(str(predictions)), "bbox")
    evaluation.evaluate()
    evaluation.accumulate()
    evaluation.summarize()
    return {"mAP": evaluation.stats[0], "mAP50": evaluation.stats[1]}


def test_the_map_of_all_images_is_that_of_pycocotools_on_written_pictures_and_labels(
    call, score, results, tmp_path, frames
):
    words = ("labels=coco.json", "scene=cheap_dashcam")
    assert score("model=squares:detect", *words, "severity=[3]").code == 0
    results = results()
    expected = coco_scores(frames, tmp_path / "coco.json")
    assert 0.1 < expected["mAP"] < expected["mAP50"] < 0.95
    assert {name: of["clean"] for name, of in results["set_scores"].items()} == pytest.approx(expected, abs=1e-6)
    assert call("degrade", "source=frames", "out=lens", *words, "severity=3", "workers=0").code == 0
    degraded = coco_scores(tmp_path / "lens" / "images", tmp_path / "lens" / "labels" / "coco.json")
    (row,) = results["levels"]
    assert {name: row[name] for name in degraded} == pytest.approx(degraded, abs=1e-6)
    for name, of in results["set_scores"].items():
        assert of["mean_performance"] == pytest.approx(degraded[name], abs=1e-6)
        assert of["relative_performance"] == pytest.approx(degraded[name] / expected[name], abs=1e-5)
    with (tmp_path / "out" / "results.csv").open(newline="") as file:
        (line,) = csv.DictReader(file)
    assert float(line["mAP"]) == row["mAP"]
    report = (tmp_path / "out" / "report.html").read_text()
    assert f"<td>{row['mAP']:.3f}</td><td>{row['mAP50']:.3f}</td>" in report


@pytest.mark.quick
def test_the_iou_of_all_images_is_that_over_all_of_their_pixels():
    generator = torch.Generator().manual_seed(0)
    targets = [torch.randint(0, 4 if i else 2, (8, 9), generator=generator) for i in range(5)]
    for target in targets:
        target[0, :3] = 255  # not counted
    logits = [
        torch.rand(5, 8, 9, generator=generator) + 0.3 * torch.eye(5)[t.clamp(max=4)].movedim(-1, 0) for t in targets
    ]
    metric = MulticlassJaccardIndex(5, ignore_index=255)
    metric.update(torch.stack(logits), torch.stack(targets))
    value = set_scores([summarize(*pair) for pair in zip(logits, targets, strict=True)])
    assert value == {"mIoU": pytest.approx(metric.compute().item())}
    of_each = [segmentation_score(*pair) for pair in zip(logits, targets, strict=True)]
    assert value["mIoU"] != pytest.approx(np.mean(of_each), abs=1e-3)


@pytest.mark.quick
def test_a_set_without_labels_has_no_score_and_other_predictions_have_none(monkeypatch):
    prediction: dict[str, Any] = {
        "boxes": torch.tensor([[0.0, 0, 5, 5]]),
        "labels": torch.tensor([1]),
        "scores": torch.tensor([0.9]),
    }
    empty = {"boxes": torch.zeros(0, 4), "labels": torch.zeros(0).long()}
    assert all(math.isnan(value) for value in set_scores([summarize(prediction, empty)] * 2).values())
    ignored = summarize(torch.zeros(2, 3), torch.full((2, 3), 255))
    assert math.isnan(set_scores([ignored])["mIoU"])
    assert set_scores([summarize(torch.tensor([0.1, 0.9]), 1)]) == {}
    assert set_scores([summarize(torch.rand(2, 3), torch.rand(2, 3)), ignored]) == {}
    mask, channels = torch.ones(2, 3).long(), torch.ones(4, 2, 3).long()
    # A logit or a probability of one class, and a channel for each of several labels, which a score may take.
    for other, target in ((torch.rand(1, 2, 3), mask), (torch.rand(2, 3), mask), (torch.rand(4, 2, 3), channels)):
        assert summarize(other, target) is None
    monkeypatch.setitem(sys.modules, "torchmetrics.detection", None)
    with pytest.warns(UserWarning, match="mAP is left out"):
        assert set_scores([summarize(prediction, prediction)]) == {}
