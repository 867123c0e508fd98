"""The score of a model on degraded images, by scene and severity, and the physical value that it tolerates."""

import itertools
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.utils import _pytree as pytree

from torchrefract import random
from torchrefract._tensor import sharing_results
from torchrefract._validation import check_count, check_number, warn
from torchrefract.effects.base import Effect
from torchrefract.labels.targets import is_tv_tensor, warp_moved_labels
from torchrefract.robustness.set_scores import IGNORED_CLASS, Summary, set_scores, summarize
from torchrefract.robustness.statistics import Estimate, mean_estimate, tolerated_value
from torchrefract.types import Degraded

_MAX_FAILED, _MIN_COUNT = 0.1, 10  # share of the images whose prediction may raise, and from how many on it counts
_CLASS_TYPES = (
    torch.uint8,
    torch.uint16,
    torch.int16,
    torch.int32,
    torch.int64,
)  # of masks that can hold `IGNORED_CLASS`


class Quantity(NamedTuple):
    """A parameter by which a scene is stated, such as the visibility of a fog.

    name, unit: of the parameter.
    is_harm: True if higher values harm more, False for one such as visibility.
    get: returns its value for each sample, (B,), from the params of the scene.
    """

    name: str
    unit: str
    is_harm: bool
    get: Callable[[Any], Tensor]


class Level(NamedTuple):
    """A scene at a severity."""

    scene: str
    severity: int


class ImageScore(NamedTuple):
    """The score of one image at a level or clean.

    value: of the quantity of the scene, 0 without one.
    summary: of the prediction and its target, see `set_scores.summarize`.
    worst_case: the lowest score of several draws; None without a search.
    worst_seed: the seed of that draw.
    """

    score: float
    value: float
    summary: Summary | None
    worst_case: float | None = None
    worst_seed: int | None = None


class Scored(NamedTuple):
    """The scores of one image."""

    clean: ImageScore
    levels: dict[Level, ImageScore]


Scenes = Mapping[str, Mapping[int, Effect]]


@dataclass(frozen=True)
class Row:
    """The scores at a level.

    quantity, value, unit: the physical quantity and its mean over the images; empty and NaN without one.
    score: mean over the images.
    drop: mean of the score of each clean image less that of the degraded one.
    set_scores: by name, those of all images together, see `set_scores.set_scores`.
    worst_case: mean over the images of the lowest score of several draws; None without a search.
    """

    scene: str
    severity: int
    quantity: str
    value: float
    unit: str
    num_images: int
    score: Estimate
    drop: Estimate
    set_scores: dict[str, float]
    worst_case: Estimate | None = None


@dataclass(frozen=True)
class Robustness:
    """The scores of a model.

    names: of the images that were scored.
    clean: (n,), the scores of the clean images.
    scores: for each level, (n,), the scores of the degraded images.
    values: for each level of a scene with a quantity, (n,), its value for each image.
    set_scores: for each level, and for the clean images by None, the scores of all images together by name: "mAP" and
        "mAP50" of detections, "mIoU" of masks.
    quantities: by scene.
    failures: names of the images whose prediction raised, and why.
    worst_case: for each level, (n,), the lowest score of several draws for each image; empty without a search.
    worst_seeds: for each level, (n,), the seed of that draw: `effect.degrade(image, seed=..., keys=[key_of(name)])`
        makes the image again.
    """

    names: list[str]
    clean: np.ndarray
    scores: dict[Level, np.ndarray]
    values: dict[Level, np.ndarray]
    set_scores: dict[Level | None, dict[str, float]]
    quantities: Mapping[str, Quantity] = field(default_factory=dict)
    failures: dict[str, str] = field(default_factory=dict)
    worst_case: dict[Level, np.ndarray] = field(default_factory=dict)
    worst_seeds: dict[Level, np.ndarray] = field(default_factory=dict)

    @property
    def scenes(self) -> list[str]:
        """Return the names of the scenes."""
        return list(dict.fromkeys(level.scene for level in self.scores))

    def scenes_or_all(self, scene: str | None) -> list[str]:
        """Return one scene, or all for None; raise ValueError for a scene that was not scored."""
        if scene is not None and scene not in self.scenes:
            raise ValueError(f"scene must be one of {', '.join(self.scenes)}, got {scene}")
        return self.scenes if scene is None else [scene]

    def rows(self) -> list[Row]:
        """Return the scores by level, with 95 % intervals by resampling of the images."""
        rows = []
        for level, scores in self.scores.items():
            quantity = self.quantities.get(level.scene)
            name, unit = (quantity.name, quantity.unit) if quantity else ("", "")
            value = float(self.values[level].mean()) if quantity else float("nan")
            estimates = mean_estimate(scores), mean_estimate(self.clean - scores)
            worst = mean_estimate(self.worst_case[level]) if self.worst_case else None
            rows.append(Row(*level, name, value, unit, len(scores), *estimates, self.set_scores[level], worst))
        return rows

    def clean_estimate(self) -> Estimate:
        """Return the mean score of the clean images."""
        return mean_estimate(self.clean)

    def tolerated(self, scene: str, *, loss: float = 0.1) -> Estimate:
        """Estimate the value of a scene's quantity up to which the mean score falls by at most a share.

        Args:
            scene: one with a quantity.
            loss: share of the mean score of the clean images, in (0, 1).

        Raises:
            ValueError: a scene without a quantity, a loss out of range, or clean images of the score 0.
        """
        loss = check_number("loss", loss, low=1e-6, high=1 - 1e-6)
        if not self.clean.any():
            raise ValueError("the mean score of the clean images must be above 0, got 0: check labels and classes")
        if scene not in self.quantities:
            raise ValueError(
                f"scene must be one with a quantity ({', '.join(self.quantities) or 'no scene has one'}), got {scene}"
            )
        levels = [level for level in self.scores if level.scene == scene]
        values, scores = (np.stack([by[level] for level in levels]) for by in (self.values, self.scores))
        least, is_harm = (1 - loss) * float(self.clean.mean()), self.quantities[scene].is_harm
        return tolerated_value(values.ravel(), scores.ravel(), least=least, is_harm=is_harm)

    def mean_performance(self, scene: str | None = None, *, of: str = "score") -> float:
        """Return the mean score over the levels of a scene, or over those of all scenes with equal weights: mPC.

        Args:
            scene: its name, or None for all.
            of: "score" for the mean over the images, "worst_case" for that of their worst cases, or the name of a score
                of all images together, such as "mAP".

        Raises:
            ValueError: a scene that was not scored, or a score that the run has not.

        Source: Michaelis et al., "Benchmarking robustness in object detection", 2019.
        """
        scenes = self.scenes_or_all(scene)
        names = ["score", *(["worst_case"] if self.worst_case else []), *self.set_scores.get(None, ())]
        if of not in names:
            raise ValueError(f"of must be one of {', '.join(names)}, got {of}")
        means = [np.mean([self._value(of, level) for level in self.scores if level.scene == s]) for s in scenes]
        return float(np.mean(means))

    def relative_performance(self, scene: str | None = None, *, of: str = "score") -> float:
        """Return `mean_performance` divided by the score of the clean images: rPC; NaN if that is 0.

        For all scenes it equals the mean resilience rate:

            mRR = mean over scenes of RR,  RR = sum over severities of the score / (number of severities * clean score)

        Source: Michaelis et al., "Benchmarking robustness in object detection", 2019, for rPC; Xie et al., "RoboBEV:
        towards robust bird's eye view perception under corruptions", 2023, for mRR.
        """
        return self.mean_performance(scene, of=of) / (self._value(of, None) or float("nan"))

    def _value(self, of: str, level: Level | None) -> float:
        if of not in ("score", "worst_case"):
            return self.set_scores[level][of]
        scores = self.worst_case if of == "worst_case" else self.scores
        return float(self.clean.mean() if level is None else scores[level].mean())


def evaluate(
    predict: Callable[[Tensor], Any],
    samples: Iterable[tuple[str, Tensor, Any]],
    scenes: Scenes | Callable[[int], Scenes],
    score: Callable[[Any, Any], float],
    *,
    as_target: Callable[[Any, tuple[int, int]], Any] | None = None,
    quantities: Mapping[str, Quantity] | None = None,
    seed: int = 0,
    depth: Callable[[str, Tensor], Tensor | None] | None = None,
    done: Mapping[str, Scored] | None = None,
    on_scored: Callable[[str, Scored], None] | None = None,
    worst_case_draws: int | None = None,
    batch_size: int = 1,
) -> Robustness:
    """Score a model on images as they are, and at each severity of each scene.

    An image has one key, that of its name, at all levels: its lens, fog or haze differs from level to level by its
    strength alone, so that differences between levels have small intervals.

    Args:
        predict: from images (B, 3, H, W), float in [0, 1], to a sequence of B predictions; B is 1 for clean images.
        samples: name, image (3, H, W) and target of each image. Labels of the target move along the flow. A
            target that is a `Mask` of integers gets 255 where the degraded image shows nothing of the clean one.
        scenes: by name, and in each the effects by severity; or a function that returns them for a width in px.
        score: from a prediction and a target to a number in [0, 1], higher is better; see `robustness.scores`.
        as_target: makes a target of the prediction for the clean image and its (height, width), for targets that are
            None: the score is then the agreement with it. See `scores.as_labels`.
        quantities: of the scenes, by name.
        seed: of the draws.
        depth: returns the depth (1, H, W), m, of an image by its name and itself; None takes that which effects assume.
        done: scores of an earlier run with the same arguments, by name, which are not computed again.
        on_scored: is called with the name and the scores of each other image.
        worst_case_draws: number of draws, at least 2, of which the worst for each image, scene and severity is kept: a
            random search of the parameters within the ranges of each effect. Draw i has the seed `seed + i`, draw 0
            gives all other scores. Takes as many calls of `predict` for each level; None does not search.
        batch_size: largest number B of degraded versions of an image that `predict` takes at once.

    Returns:
        The scores of all images but those whose prediction raised.

    Raises:
        RuntimeError: the prediction raised for more than a tenth of the images, from ten on, or for all of them.
        TypeError: a name that is no text; scenes that are not effects by scene and severity.
        ValueError: an image of another form; a name twice; a target of None without `as_target`; predictions that are
            not a sequence of B; a score outside [0, 1]; `done` without the worst cases that are asked for.
    """
    quantities, done = dict(quantities or {}), done or {}
    num_draws = 1 if worst_case_draws is None else check_count("worst_case_draws", worst_case_draws, low=2)
    batch_size = check_count("batch_size", batch_size)
    scored: dict[str, Scored] = {}
    failures: dict[str, str] = {}

    def score_image(name: str, image: Tensor, target: Any) -> Scored:
        if target is None and as_target is None:
            raise ValueError(f"target must be labels, or as_target a function, got None for {name}")
        by_name = _checked_scenes(
            scenes(image.shape[-1]) if callable(scenes) and not isinstance(scenes, Effect) else scenes
        )
        (prediction,) = _predict(predict, [image])
        if target is None and as_target is not None:
            target = as_target(prediction, (image.shape[-2], image.shape[-1]))
        clean = _score(score, prediction, target)
        draws: dict[Level, list[ImageScore]] = {}
        options = {"keys": [random.key_of(name)], "depth": depth and depth(name, image)}
        with closing(_degraded(image, target, by_name, range(seed, seed + num_draws), options)) as pictures:
            while batch := list(itertools.islice(pictures, batch_size)):
                predictions = _predict(predict, [degraded.image for _, degraded, _ in batch])
                for (level, degraded, moved), prediction in zip(batch, predictions, strict=True):
                    quantity = quantities.get(level.scene)
                    value = quantity.get(degraded.params).item() if quantity else 0.0
                    draws.setdefault(level, []).append(_score(score, prediction, moved, value))
        return Scored(clean, {level: _with_worst_case(of, seed) for level, of in draws.items()})

    for name, image, target in samples:
        _check_sample(name, image, scored, failures)
        if name in done:
            if num_draws > 1 and any(of.worst_case is None for of in done[name].levels.values()):
                raise ValueError(f"done must have worst cases, got none for {name}; score it again")
            scored[name] = done[name]
            continue
        try:
            scored[name] = score_image(name, image, target)
            if on_scored is not None:
                on_scored(name, scored[name])
        except _PredictionError as error:
            failures[name] = str(error)
        if _fails_too_often(len(failures), len(scored)):
            break
    if not scored or _fails_too_often(len(failures), len(scored)):
        name, reason = next(reversed(failures.items()), ("none", "there are no samples"))
        raise RuntimeError(
            f"predict must succeed for nine of ten images, failed for {len(failures)} of "
            f"{len(scored) + len(failures)}; the last was {name}: {reason}"
        )
    if failures:
        name, reason = next(iter(failures.items()))
        count = f"{len(failures)} of {len(scored) + len(failures)}"
        warn(f"predict failed for {count} images, which are left out: {name}: {reason}")
    return _collect(scored, quantities, failures)


def move_target(target: Any, degraded: Degraded, effect: Effect, *, mask_fill: int = 0) -> Any:
    """Return the labels of a degraded image, or of a batch, moved along its flow on their device; None stays None."""
    if target is None or not degraded.has("flow"):
        return target
    flow = degraded.flow.detach()
    device = next((leaf.device for leaf in pytree.tree_leaves(target) if isinstance(leaf, Tensor)), flow.device)
    return warp_moved_labels(target, flow.to(device), effect.labels_getter, mask_fill=mask_fill)


def _check_sample(name: Any, image: Any, *earlier: Mapping[str, Any]) -> None:
    """Raise TypeError for a name that is no text, and ValueError for an earlier name or an image of another form."""
    if not isinstance(name, str):
        raise TypeError(f"samples must have names that are texts, got {name!r}")
    if any(name in names for names in earlier):
        raise ValueError(f"samples must have names of their own, got {name} twice")
    if not isinstance(image, Tensor) or image.ndim != 3:
        got = tuple(image.shape) if isinstance(image, Tensor) else type(image).__name__
        raise ValueError(f"samples must have images (3, H, W), tensors, got {got} for {name}")


def _checked_scenes(scenes: Any) -> Scenes:
    """Return the scenes; raise TypeError if they are not effects by scene and severity."""
    is_valid = isinstance(scenes, Mapping) and all(
        isinstance(of, Mapping) and all(isinstance(effect, Effect) for effect in of.values()) for of in scenes.values()
    )
    if not is_valid:
        raise TypeError(f"scenes must be {{scene: {{severity: effect}}}}, got {type(scenes).__name__}")
    return scenes


class _PredictionError(Exception):
    """A model that raised, with its reason."""


def _degraded(
    image: Tensor, target: Any, scenes: Scenes, seeds: Iterable[int], options: dict[str, Any]
) -> Generator[tuple[Level, Degraded, Any], None, None]:
    """Yield an image and its target at each level of each scene, once for each seed."""
    # No label is true where the degraded image shows nothing of the clean one.
    mask_fill = IGNORED_CLASS if is_tv_tensor(target, "Mask") and target.dtype in _CLASS_TYPES else 0
    for (scene, effects), seed in itertools.product(scenes.items(), seeds):
        with sharing_results():  # the severities of a scene have the same random fields
            for severity, effect in effects.items():
                degraded = effect.degrade(image, seed=seed, **options)
                yield Level(scene, severity), degraded, move_target(target, degraded, effect, mask_fill=mask_fill)


def _predict(predict: Callable[[Tensor], Any], images: Sequence[Tensor]) -> Any:
    """Return the predictions for images (3, H, W), of which the model gets a copy that it may write to."""
    try:
        predictions = predict(torch.stack(list(images)))
    except Exception as error:  # a model may raise anything
        raise _PredictionError(f"{type(error).__name__}: {error}") from error
    if isinstance(predictions, dict) or not hasattr(predictions, "__len__") or len(predictions) != len(images):
        count = f" of {len(predictions)}" if isinstance(predictions, Tensor | list | tuple) else ""
        one = "one prediction for one image" if len(images) == 1 else f"{len(images)} predictions for as many images"
        raise ValueError(
            f"predict must return a sequence of {one}, got {type(predictions).__name__}{count}; return a list, or a "
            f"tensor ({len(images)}, ...)" + ("" if len(images) == 1 else "; or set batch_size=1")
        )
    return predictions


def _score(score: Callable[[Any, Any], float], prediction: Any, target: Any, value: float = 0.0) -> ImageScore:
    value_of_score = score(prediction, target)
    try:
        number = float(value_of_score)
    except (TypeError, ValueError, RuntimeError):  # of a tensor with several values
        number = float("nan")
    if not 0 <= number <= 1:
        raise ValueError(f"score must return a number in [0, 1], got {value_of_score}")
    return ImageScore(number, value, summarize(prediction, target))


def _with_worst_case(draws: Sequence[ImageScore], seed: int) -> ImageScore:
    """Return the first draw with the lowest score of all, if there are several."""
    if len(draws) == 1:
        return draws[0]
    scores = [of.score for of in draws]
    return draws[0]._replace(worst_case=min(scores), worst_seed=seed + scores.index(min(scores)))


def _collect(
    scored: Mapping[str, Scored], quantities: Mapping[str, Quantity], failures: Mapping[str, str]
) -> Robustness:
    """Return the scores of images, by name and of the same levels, as arrays."""
    levels = list(next(iter(scored.values())).levels)
    of_level: dict[Level | None, list[ImageScore]] = {
        level: [of.levels[level] for of in scored.values()] for level in levels
    }
    of_level[None] = [of.clean for of in scored.values()]
    searched = [level for level in levels if of_level[level][0].worst_case is not None]
    return Robustness(
        names=list(scored),
        clean=np.array([of.score for of in of_level[None]]),
        scores={level: np.array([of.score for of in of_level[level]]) for level in levels},
        values={level: np.array([of.value for of in of_level[level]]) for level in levels if level.scene in quantities},
        set_scores={level: set_scores([of.summary for of in images]) for level, images in of_level.items()},
        quantities={level.scene: quantities[level.scene] for level in levels if level.scene in quantities},
        failures=dict(failures),
        worst_case={level: np.array([of.worst_case for of in of_level[level]]) for level in searched},
        worst_seeds={level: np.array([of.worst_seed for of in of_level[level]]) for level in searched},
    )


def _fails_too_often(failed: int, scored: int) -> bool:
    return failed + scored >= _MIN_COUNT and failed > _MAX_FAILED * (failed + scored)
