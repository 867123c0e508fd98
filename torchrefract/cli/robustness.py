"""The command that scores a model on degraded pictures by scene and severity."""

import json
import os
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import torch
from omegaconf import DictConfig, OmegaConf
from torch import Tensor
from torchvision import tv_tensors

import torchrefract
from torchrefract import presets, random
from torchrefract._validation import UsageError, check_count, check_number
from torchrefract.cli.command import check_seed, naming, progress
from torchrefract.data.frames import first_names
from torchrefract.data.images import files_in, read_image
from torchrefract.data.pairs.manifest import locked
from torchrefract.effects.base import Effect
from torchrefract.labels.targets import warp_moved_labels
from torchrefract.robustness.evaluate import Level, Robustness, Scored, evaluate
from torchrefract.robustness.predictors import Predict, import_function, load_predictor
from torchrefract.robustness.quantities import QUANTITIES
from torchrefract.robustness.report import Example, format_tolerated, write_report, write_tables
from torchrefract.robustness.scores import as_labels, classification_score, detection_score, segmentation_score

_SCORES = "scores.jsonl"  # one line of settings, then one for each picture
_WITH_WIDTH = ("highveld_heat_haze", "unpaved_road")  # scenes whose displacements are stated for a width
_SETTINGS = ("model", "weights", "data", "labels", "score", "scene", "severity", "seed")


class _Folder(NamedTuple):
    """Pictures with their targets; a target of None is the prediction for the clean picture."""

    path: Path
    names: list[str]
    target: Callable[[str, Tensor], Any]

    def read(self, names: Iterable[str]) -> Iterator[tuple[str, Tensor, Any]]:
        for name in names:
            image = read_image(self.path / name)
            yield name, image, self.target(name, image)


def test_robustness(cfg: DictConfig) -> None:
    """Score the pictures of a folder that have no scores yet, and write tables and a report."""
    out, seed = Path(str(cfg.out)).expanduser(), check_seed(cfg.seed)
    with naming("loss"):
        loss = check_number("loss", cfg.loss, low=0.001, high=0.999)
    with naming("worst"):
        num_worst = check_count("worst", cfg.worst, low=0)
    values: Any = OmegaConf.to_container(cfg)
    settings = {name: values[name] for name in _SETTINGS}
    levels, folder = _levels(settings["scene"], settings["severity"]), _folder(cfg)
    with naming("model"):
        predict = load_predictor(str(cfg.model), weights=cfg.weights, device=str(cfg.device))
    with naming("score"):
        score = choose_score if cfg.score is None else import_function(*str(cfg.score).partition(":")[::2])
    scenes = lru_cache(lambda width: _scenes(levels, width))
    out.mkdir(parents=True, exist_ok=True)
    with locked("out", out), _stored_scores(out / _SCORES, settings) as (done, store), warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of the assumed depth and of folds
        names = progress(folder.names, "scoring", count=len(folder.names))
        options = {"as_target": as_labels, "quantities": QUANTITIES, "seed": seed, "done": done, "on_scored": store}
        try:
            result = evaluate(predict, folder.read(names), scenes, score, **options)
        except RuntimeError as error:
            raise UsageError(f"model: {error}") from error
        about = settings | {"torchrefract": torchrefract.__version__, "torch": torch.__version__}
        write_tables(result, out, about, loss=loss)
        examples = [
            _example(name, level, result, folder, predict, scenes, seed) for name, level in _worst(result, num_worst)
        ]
        write_report(result, examples, out, title=f"{cfg.model} on {folder.path.name}", loss=loss)
    print(f"{out / 'report.html'}: {len(result.names)} pictures, clean score {result.clean.mean():.3f}")
    for scene in result.quantities:
        print(f"{scene}: {format_tolerated(result, scene, loss=loss)} for a loss of at most {loss:.0%}")
    if result.failures:
        name, reason = next(iter(result.failures.items()))
        names = first_names(list(result.failures))
        print(f"warning: the model failed for {names}, which are left out; for {name}: {reason}", file=sys.stderr)


def choose_score(prediction: Any, target: Any) -> float:
    """Score a prediction by its kind: boxes, classes at each pixel, or the class of the image."""
    if isinstance(prediction, dict):
        return detection_score(prediction, target)
    is_class = isinstance(prediction, Tensor) and prediction.ndim == 1
    return classification_score(prediction, target) if is_class else segmentation_score(prediction, target)


def _levels(scenes: Any, severities: Any) -> list[Level]:
    names = [scenes] if isinstance(scenes, str) else scenes
    unknown = [name for name in names if name not in QUANTITIES]
    if unknown or not names:
        raise UsageError(f"scene must be some of {', '.join(QUANTITIES)}, got {', '.join(unknown) or 'none'}")
    severities = [severities] if isinstance(severities, int) else severities
    if not severities or any(severity not in presets.SEVERITIES for severity in severities):
        raise UsageError(f"severity must be some of {presets.SEVERITIES}, got {severities}")
    return [Level(name, severity) for name in names for severity in severities]


def _scenes(levels: Iterable[Level], width: int) -> dict[str, dict[int, Effect]]:
    scenes: dict[str, dict[int, Effect]] = {}
    for name, severity in levels:
        options = {"width": width} if name in _WITH_WIDTH else {}
        scenes.setdefault(name, {})[severity] = getattr(presets, name)(severity, **options)
    return scenes


def _folder(cfg: DictConfig) -> _Folder:
    """Find the pictures and their labels."""
    path = Path(str(cfg.data)).expanduser()
    names = [file.name for file in files_in(path)] if path.is_dir() else []
    if not names:
        raise UsageError(f"data must be a folder of pictures, got {path}, which holds none")
    with naming("limit"):
        names = names if cfg.limit is None else names[: check_count("limit", cfg.limit)]
    if cfg.labels is None:
        return _Folder(path, names, lambda *_: None)
    labels = Path(str(cfg.labels)).expanduser()
    if labels.is_dir():
        masks = {file.stem: file for file in files_in(labels, (".png",))}
        missing = [name for name in names if Path(name).stem not in masks]
        if missing:
            raise UsageError(f"labels must hold a mask .png for each picture, got none for {first_names(missing)}")
        return _Folder(path, names, lambda name, _: _mask(masks[Path(name).stem]))
    boxes = _coco_boxes(labels)
    missing = [name for name in names if name not in boxes]
    if missing:
        raise UsageError(f"labels must name each picture, got nothing for {first_names(missing)}")
    return _Folder(path, names, lambda name, image: _boxes(boxes[name], image))


def _coco_boxes(path: Path) -> dict[str, list[tuple[list[float], int]]]:
    """Read the boxes (x, y, width, height) and classes of each picture."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        names = {image["id"]: Path(image["file_name"]).name for image in content["images"]}
        boxes: dict[str, list[tuple[list[float], int]]] = {name: [] for name in names.values()}
        for row in content["annotations"]:
            if not row.get("iscrowd"):
                boxes[names[row["image_id"]]].append((row["bbox"], row["category_id"]))
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UsageError(
            "labels must be a JSON file of COCO with images and annotations, or a folder of masks, "
            f"got {path}: {error!r}"
        ) from error
    return boxes


def _boxes(rows: list[tuple[list[float], int]], image: Tensor) -> dict[str, Any]:
    corners = torch.tensor([box for box, _ in rows]).view(-1, 4)
    corners = torch.cat([corners[:, :2], corners[:, :2] + corners[:, 2:]], dim=1)
    options: dict[str, Any] = {"format": "XYXY", "canvas_size": (image.shape[1], image.shape[2])}
    labels = torch.tensor([label for _, label in rows], dtype=torch.int64)
    return {"boxes": tv_tensors.BoundingBoxes(corners, **options), "labels": labels}


def _mask(path: Path) -> tv_tensors.Mask:
    from PIL import Image  # noqa: PLC0415 - used here alone

    with Image.open(path) as picture:
        return tv_tensors.Mask(picture)


@contextmanager
def _stored_scores(
    path: Path, settings: Mapping[str, Any]
) -> Iterator[tuple[dict[str, Scored], Callable[[str, Scored], None]]]:
    """Yield the scores of an earlier run, and a function that stores those of a picture."""
    done: dict[str, Scored] = {}
    lines = path.read_text(encoding="utf-8").splitlines(keepends=True) if path.is_file() else []
    lines = [line for line in lines if line.endswith("\n")]  # a killed run may leave a part of a line
    if lines:
        before = json.loads(lines[0])
        changed = [f"{name}={before.get(name)}" for name in settings if before.get(name) != settings[name]]
        if changed:
            raise UsageError(
                f"out must be a folder of the same settings, got one with {', '.join(changed)}; choose another"
            )
    for line in lines[1:]:
        row = json.loads(line)
        of_levels = {Level(scene, severity): (score, value) for scene, severity, score, value in row["levels"]}
        done[row["name"]] = Scored(row["clean"], of_levels)
    with path.open("w", encoding="utf-8") as stream:

        def write(row: Mapping[str, Any]) -> None:
            stream.write(json.dumps(row) + "\n")
            stream.flush()
            os.fsync(stream.fileno())

        def store(name: str, scored: Scored) -> None:
            write(
                {"name": name, "clean": scored.clean, "levels": [[*level, *of] for level, of in scored.levels.items()]}
            )

        write(settings)
        for name, scored in done.items():
            store(name, scored)
        yield done, store


def _worst(result: Robustness, count: int) -> list[tuple[str, Level]]:
    """Return the pictures whose scores fall most at the highest severity of each scene."""
    highest = {level.scene: level for level in sorted(result.scores, key=lambda level: level.severity)}
    order = dict.fromkeys(level.scene for level in result.scores)
    return [
        (result.names[i], highest[scene])
        for scene in order
        for i in (result.clean - result.scores[highest[scene]]).argsort(kind="stable")[::-1][:count]
    ]


def _example(
    name: str,
    level: Level,
    result: Robustness,
    folder: _Folder,
    predict: Predict,
    scenes: Callable[[int], Mapping[str, Mapping[int, Effect]]],
    seed: int,
) -> Example:
    """Degrade a picture again, and predict it again."""
    _, image, target = next(folder.read([name]))
    effect = scenes(image.shape[2])[level.scene][level.severity]
    degraded = effect.degrade(image, seed=seed, keys=[random.key_of(name)])
    target = as_labels(predict(image[None])[0], (image.shape[1], image.shape[2])) if target is None else target
    moved = warp_moved_labels(target, degraded.flow, effect.labels_getter) if degraded.has("flow") else target
    prediction = predict(degraded.image[None])[0]
    i = result.names.index(name)
    caption = (
        f"{name}, {level.scene} {level.severity}: {result.clean[i]:.2f} clean, {result.scores[level][i]:.2f} degraded"
    )
    if not isinstance(prediction, dict):
        return Example(degraded.image, caption, None, None)
    boxes = prediction["boxes"][prediction["scores"] >= 0.5]
    return Example(degraded.image, caption, moved["boxes"].as_subclass(Tensor), boxes.detach().cpu())
