"""The command that scores a model on degraded pictures by scene and severity."""

import io
import json
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import asdict
from functools import lru_cache
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
import torch
from omegaconf import DictConfig, OmegaConf
from PIL import Image
from torch import Tensor, nn
from torchvision import tv_tensors

import torchrefract
from torchrefract import random
from torchrefract._io import make_writable_folder
from torchrefract._validation import UsageError, check_count, check_flag, check_number, first_names
from torchrefract.cameras.camera import Camera
from torchrefract.cli.options import (
    check_seed,
    depth_folder,
    file_digests,
    find_device,
    naming,
    read_option,
    read_optional,
    read_place,
)
from torchrefract.cli.progress import Skipped, print_warning, progress, warn_of_assumed_depth
from torchrefract.cli.robustness_runs import (
    FORMAT,
    REFERENCE_WIDTH,
    SCORES,
    describe_scenes,
    levels_of,
    make_scenes,
    parse_scores,
    read_base,
    stored_scores,
)
from torchrefract.data.depth_maps import DepthFolder
from torchrefract.data.frames import list_files
from torchrefract.data.images import EXTENSIONS, UnreadableImageError, check_frame_of_camera, read_image
from torchrefract.data.label_files import (
    CocoLabels,
    LabelFolder,
    MaskFile,
    PictureLabels,
    YoloFile,
    boxes_of_coco,
    read_labels,
)
from torchrefract.data.media import describe_turned
from torchrefract.data.pairs.manifest import locked
from torchrefract.effects.base import Effect
from torchrefract.robustness.corruption_error import BaseComparison, compare_with_base
from torchrefract.robustness.evaluate import Level, Robustness, evaluate, move_target
from torchrefract.robustness.predictors import Predict, import_function, load_predictor, model_files
from torchrefract.robustness.quantities import quantity_of
from torchrefract.robustness.report import Classes, Example, format_tolerated, write_report, write_tables
from torchrefract.robustness.scores import (
    as_labels,
    check_prediction,
    classification_score,
    detection_score,
    segmentation_score,
)
from torchrefract.robustness.set_scores import IGNORED_CLASS

_METRICS = {"boxes": "AP50 by image", "pixels": "IoU by image", None: "accuracy"}  # of `choose_score`, by summary
_SETTINGS = ("model", "weights", "data", "labels", "score", "scene", "severity", "depth", "depth_scale", "seed")
_SETTINGS += ("camera", "horizon")


class _Folder(NamedTuple):
    """Pictures, by their names relative to a folder, and their labels, if there are any."""

    path: Path
    names: list[str]
    labels: CocoLabels | LabelFolder | None
    depths: DepthFolder | None
    skipped: Skipped
    classes: set[int]  # the lowest and highest class of the masks that were read, and the ignored one if they hold it
    place: dict[str, Any]  # arguments of the scenes
    device: torch.device  # of the images, and so of the effects

    @property
    def camera(self) -> Camera | None:
        """Return the camera of all pictures, if it is given."""
        return self.place.get("camera")

    def depth(self, name: str, image: Tensor) -> Tensor | None:
        """Return the depth map (1, H, W), m, of a picture; None without maps."""
        if self.depths is None:
            return None
        size = (image.shape[1], image.shape[2])
        return self.depths.read(name, None, frame_size=size, size=None).to(self.device)

    def read(self, names: Iterable[str]) -> Iterator[tuple[str, Tensor, Any]]:
        """Yield name, image and target; a target of None stands for the prediction for the clean picture."""
        for name in names:
            try:
                image = read_image(self.path / name)
            except UnreadableImageError as error:
                self.skipped.add(str(error))
                continue
            check_frame_of_camera(self.camera, name, height=image.shape[1], width=image.shape[2])
            with naming("labels"):
                target = None if self.labels is None else _target(self.labels.of(name), image)
            if isinstance(target, tv_tensors.Mask):
                scored = target[target != IGNORED_CLASS]
                self.classes.update(map(int, scored.aminmax()) if len(scored) else ())
                self.classes.update([IGNORED_CLASS] if len(scored) < target.numel() else ())
            yield name, image.to(self.device), target


def test_robustness(cfg: DictConfig) -> None:
    """Score the pictures of a folder that have no scores yet, and write tables and a report."""
    out, seed = Path(str(cfg.out)).expanduser(), check_seed(cfg.seed)
    loss = read_option(cfg, "loss", check_number, low=0.001, high=0.999)
    num_worst = read_option(cfg, "worst", check_count, low=0)
    num_draws = read_option(cfg, "worst_case_draws", check_count, low=2)
    num_draws = num_draws if read_option(cfg, "worst_case", check_flag) else None
    batch_size = read_option(cfg, "batch_size", check_count)
    folder, values = _folder(cfg), cast(dict[str, Any], OmegaConf.to_container(cfg))
    values["camera"] = folder.camera and json.loads(json.dumps(asdict(folder.camera)))  # as it is stored
    settings = {name: values[name] for name in _SETTINGS} | {"labels": folder.labels and folder.labels.digest()}
    settings |= {"worst_case_draws": num_draws, "format": FORMAT}
    levels = levels_of(settings["scene"], settings["severity"])
    settings["effects"] = describe_scenes(levels)
    base = None if cfg.base is None else read_base(Path(str(cfg.base)).expanduser(), settings, folder.names)
    with naming("model"):
        predict = load_predictor(str(cfg.model), weights=cfg.weights, device=str(folder.device))
    with naming("score"):
        score = choose_score if cfg.score is None else import_function(*str(cfg.score).partition(":")[::2])
    # Ultralytics may have downloaded the file just now.
    settings["files"] = file_digests([*model_files(str(cfg.model)), *model_files(str(cfg.score)), cfg.weights])
    scenes = lru_cache(lambda width: make_scenes(levels, width, folder.place))
    quantities = {name: of for name, by in scenes(REFERENCE_WIDTH).items() if (of := quantity_of(by.values()))}
    if folder.depths is None:
        warn_of_assumed_depth(
            nn.ModuleList(effect for by in scenes(REFERENCE_WIDTH).values() for effect in by.values())
        )
    with naming("out"):
        make_writable_folder(out)
    with (
        locked("out", out),
        stored_scores(out / SCORES, settings, folder.path) as (done, store),
        warnings.catch_warnings(),
    ):
        warnings.filterwarnings("ignore", "predict failed for")  # the command prints it once
        options = {"as_target": as_labels, "quantities": quantities, "seed": seed, "depth": folder.depth, "done": done}
        options |= {"on_scored": store, "worst_case_draws": num_draws, "batch_size": batch_size}
        result = _score(folder, predict, scenes, score, options)
        _check_clean(result, folder)
        about = settings | {
            "metric": _metric(cfg, out / SCORES),
            "torchrefract": torchrefract.__version__,
            "torch": torch.__version__,
        }
        with naming("base"):
            comparison = base and compare_with_base(result, base[1], folder=str(cfg.base), model=base[0])
        write_tables(result, out, about, loss=loss, comparison=comparison)
        examples = [
            _example(name, level, result, folder, predict, scenes, seed) for name, level in _worst(result, num_worst)
        ]
        write_report(
            result, examples, out, title=f"{cfg.model} on {folder.path.name}", loss=loss, comparison=comparison
        )
    of_set = "".join(f", {name} {value:.3f}" for name, value in result.set_scores[None].items())
    print(f"{out / 'report.html'}: {len(result.names)} pictures, clean score {result.clean.mean():.3f}{of_set}")
    if folder.labels is None:
        print("without labels, a score is the agreement with the prediction for the clean picture")
    _print_scenes(result, loss, num_draws)
    _print_comparison(comparison, has_labels=folder.labels is not None)
    _print_failures(result)


def _score(folder: _Folder, predict: Predict, scenes: Any, score: Any, options: dict[str, Any]) -> Robustness:
    """Score the pictures of a folder by `evaluate`; its errors become UsageError."""
    names = progress(folder.names, "scoring", count=len(folder.names))
    try:
        return evaluate(predict, folder.read(names), scenes, score, **options)
    except RuntimeError as error:
        if len(errors := folder.skipped.errors) == len(folder.names):
            raise UsageError(f"data must hold a picture that can be read, got {errors[0]}") from error
        raise UsageError(f"model: {error}") from error
    except ValueError as error:
        raise UsageError(str(error)) from error


def _print_comparison(comparison: BaseComparison | None, *, has_labels: bool) -> None:
    if comparison is None:
        return
    without = [scene for scene, error in comparison.scenes.items() if np.isnan(error)]
    number = f"no mCE beside {comparison.model}" if without else f"mCE {comparison.mean:.3f} beside {comparison.model}"
    print(
        f"{number}, on the {comparison.num_images} pictures of both runs; left out: {comparison.left_out} of this one "
        f"and {comparison.left_out_of_base} of {comparison.base}"
    )
    if without:
        print_warning(f"there is no mCE, as the base makes no error in {', '.join(without)}")
    if not has_labels:
        print_warning("without labels, each error is the disagreement of a model with its own clean predictions")


def _print_failures(result: Robustness) -> None:
    if result.failures:
        name, reason = next(iter(result.failures.items()))
        names = first_names(list(result.failures))
        print_warning(f"the model failed for {names}, which are left out; for {name}: {reason}")


def _print_scenes(result: Robustness, loss: float, num_draws: int | None) -> None:
    for scene in result.scenes:
        if scene in result.quantities:
            print(f"{scene}: {format_tolerated(result, scene, loss=loss)}")
        else:
            print(
                f"{scene}: mean score {result.mean_performance(scene):.3f}; it has no quantity that could be tolerated"
            )
        if num_draws:
            mean, worst = result.mean_performance(scene), result.mean_performance(scene, of="worst_case")
            print(f"{scene}: mean score {mean:.3f}, of the worst of {num_draws} draws {worst:.3f}")


def _check_clean(result: Robustness, folder: _Folder) -> None:
    """Raise UsageError if the scores of the clean pictures say nothing about the model; warn of masks of one class."""
    if IGNORED_CLASS in folder.classes and len(folder.classes) < 3:
        print_warning(
            f"the masks hold at most one class beside {IGNORED_CLASS}, which is not scored, so that the scores say "
            f"nothing: give what the masks show as {IGNORED_CLASS} another class, such as 1"
        )
    if not result.clean.any():
        raise UsageError("model must score above 0 on a clean picture, got 0 on all: check labels and classes")
    if folder.labels is None and np.isnan(result.set_scores[None].get("mAP", 0.0)):
        raise UsageError(
            "model must detect something with a score of at least 0.5 in a clean picture, got nothing in all: check "
            "its weights, or pass labels=..."
        )


def choose_score(prediction: Any, target: Any) -> float:
    """Score a prediction by its kind: boxes, classes at each pixel, or the class of the image."""
    check_prediction(prediction, target)
    if isinstance(prediction, dict):
        return detection_score(prediction, target)
    is_class = isinstance(prediction, Tensor) and prediction.ndim == 1
    return classification_score(prediction, target) if is_class else segmentation_score(prediction, target)


def _metric(cfg: DictConfig, path: Path) -> str:
    """Return the name of the score of a picture, by the first of the stored ones."""
    if cfg.score is None:
        with path.open(encoding="utf-8") as lines:
            _, scored = parse_scores(list(islice(lines, 2))[1])
        name = _METRICS[scored.clean.summary[0] if scored.clean.summary else None]
    else:
        name = str(cfg.score)
    return f"agreement ({name})" if cfg.labels is None else name


def _folder(cfg: DictConfig) -> _Folder:
    """Find the pictures and their labels."""
    path = Path(str(cfg.data)).expanduser()
    files = sorted(list_files(path)) if path.is_dir() else []
    names = [file.relative_to(path).as_posix() for file in files if file.suffix.lower() in EXTENSIONS]
    if not names:
        raise UsageError(f"data must be a folder of pictures, got {path}, which holds none")
    labels = None
    if cfg.labels is not None:
        labels = read_labels(Path(str(cfg.labels)).expanduser(), fill=0)
        labels.check(names)
        missing = [name for name in names if labels.of(name) is None]
        if missing and isinstance(labels, CocoLabels):
            raise UsageError(f"labels must list each picture, got nothing for {first_names(missing)}")
    names = names[: read_optional(cfg, "limit", check_count)]
    if (depths := depth_folder(cfg)) is not None:
        depths.check((name, None) for name in names)
    place = read_place(cfg)
    if (labels or "camera" in place) and (turned := describe_turned([path / name for name in names], upright=True)):
        print_warning(turned)
    return _Folder(path, names, labels, depths, Skipped(), set(), place, find_device(str(cfg.device)))


def _target(labels: PictureLabels | None, image: Tensor) -> Any:
    """Return the labels of a picture (3, H, W) as torchvision's types; without a YOLO file it holds nothing."""
    size = (image.shape[1], image.shape[2])
    boxes, classes = np.zeros((0, 4)), []
    if isinstance(labels, MaskFile):
        with Image.open(io.BytesIO(labels.move(None, size).content)) as picture:  # raises for a mask of another size
            return tv_tensors.Mask(np.array(picture).astype(np.int32))
    if isinstance(labels, YoloFile):
        boxes, classes = labels.boxes(size)
    elif labels is not None:
        annotations = [a for a in labels.move(None, size).content if not a.get("iscrowd")]
        for annotation in annotations:
            if not annotation.get("bbox") or not isinstance(annotation.get("category_id"), int):
                raise ValueError(
                    "labels must have a bbox and a category_id that is a whole number in each annotation, got "
                    f"{first_names([str(name) for name in annotation])} in annotation {annotation.get('id')}"
                )
        boxes = boxes_of_coco(annotations)
        classes = [annotation["category_id"] for annotation in annotations]
    options: dict[str, Any] = {"format": "XYXY", "canvas_size": size}
    boxes = tv_tensors.BoundingBoxes(torch.from_numpy(boxes).float(), **options)
    return {"boxes": boxes, "labels": torch.tensor(classes, dtype=torch.int64)}


def _worst(result: Robustness, count: int) -> list[tuple[str, Level]]:
    """Return the pictures whose scores, of the worst case if it is searched, fall most at the highest severities."""
    highest = {level.scene: level for level in sorted(result.scores, key=lambda level: level.severity)}
    drops = {scene: result.clean - (result.worst_case or result.scores)[level] for scene, level in highest.items()}
    return [
        (result.names[i], highest[scene])
        for scene in result.scenes
        for i in drops[scene].argsort(kind="stable")[::-1][:count]
        if drops[scene][i] > 0
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
    """Degrade a picture again, in its worst case if that is searched, and predict it again."""
    i = result.names.index(name)
    degree, score = "degraded", result.scores[level][i]
    if result.worst_case:
        degree, score, seed = "in the worst case", result.worst_case[level][i], int(result.worst_seeds[level][i])
    _, image, target = next(folder.read([name]))
    effect = scenes(image.shape[2])[level.scene][level.severity]
    degraded = effect.degrade(image, seed=seed, keys=[random.key_of(name)], depth=folder.depth(name, image))
    predicted = predict(image[None].clone())[0]
    size = (image.shape[1], image.shape[2])
    target = as_labels(predicted, size) if target is None else target
    moved = move_target(target, degraded, effect)
    prediction = predict(degraded.image[None].clone())[0]
    caption = f"{name}, {level.scene} {level.severity}: {result.clean[i]:.2f} clean, {score:.2f} {degree}"
    if isinstance(prediction, dict):
        boxes = prediction["boxes"][prediction["scores"] >= 0.5]
        return Example(degraded.image, caption, moved["boxes"].as_subclass(Tensor), boxes.detach().cpu())
    if prediction.ndim == 1:
        return Example(degraded.image, caption)
    pictures = (image, predicted), (degraded.image, prediction)
    clean, worst = (Classes(of, as_labels(classes, size).as_subclass(Tensor)) for of, classes in pictures)
    return Example(degraded.image, caption, clean=clean, degraded=worst)
