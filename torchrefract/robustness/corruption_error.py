"""The errors of a model on degraded images relative to those of a base model: CE and mCE."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from torchrefract._validation import first_names
from torchrefract.robustness.evaluate import Robustness

_NO_ERROR = 1e-6  # of a mean score, which rounding leaves
_SAME_DRAW = 1e-4  # largest relative difference of a value that two devices compute from the same draw


class BaseComparison(NamedTuple):
    """The corruption errors of a run beside a base.

    base, model: folder and model of the base.
    num_images: that both runs have scored.
    left_out, left_out_of_base: number of images that only one of them has scored.
    scenes, mean: CE by scene, and mCE.
    """

    base: str
    model: str
    num_images: int
    left_out: int
    left_out_of_base: int
    scenes: dict[str, float]
    mean: float


def compare_with_base(result: Robustness, base: Robustness, *, folder: str, model: str) -> BaseComparison:
    """Compute the `corruption_error` of each scene and their mean, beside a base of a folder and a model."""
    count = len(images_of_both(result, base))
    left_out, left_out_of_base = (len(run.names) - count for run in (result, base))
    scenes = {scene: corruption_error(result, base, scene) for scene in result.scenes}
    return BaseComparison(folder, model, count, left_out, left_out_of_base, scenes, float(np.mean([*scenes.values()])))


def corruption_error(result: Robustness, base: Robustness, scene: str | None = None) -> float:
    """Divide the error of a model in a scene by that of a base model on the same degraded images.

        CE = sum over severities of (1 - score) / sum over severities of (1 - score of the base)

    Scores are means over the images of both runs, see `images_of_both`.

    Args:
        result: the scores of the model.
        base: those of another model, for the same scenes, severities and draws.
        scene: its name, or None for the mean over all scenes: mCE.

    Returns:
        Below 1 if the model makes fewer errors than the base; NaN if the base makes none in the scene or, for the mean,
        in one of them.

    Raises:
        ValueError: an unknown scene; a base without an image in common, of other levels, or of other draws, as those of
            another seed.

    Source: Hendrycks and Dietterich, "Benchmarking neural network robustness to common corruptions and perturbations",
    ICLR 2019, which states it in %.
    """
    scenes = result.scenes_or_all(scene)
    names = images_of_both(result, base)
    _check_base(result, base, names)
    return float(np.mean([_error_ratio(result, base, names, of) for of in scenes]))


def images_of_both(result: Robustness, base: Robustness) -> list[str]:
    """Return the names of the images that two runs have scored, in the order of the first."""
    names = set(base.names)
    return [name for name in result.names if name in names]


def _error_ratio(result: Robustness, base: Robustness, names: Sequence[str], scene: str) -> float:
    levels = [level for level in result.scores if level.scene == scene]
    error, error_of_base = (
        sum(1 - float(run.scores[level][_rows(run, names)].mean()) for level in levels) for run in (result, base)
    )
    return error / error_of_base if error_of_base > _NO_ERROR else float("nan")


def _rows(run: Robustness, names: Sequence[str]) -> list[int]:
    rows = {name: i for i, name in enumerate(run.names)}
    return [rows[name] for name in names]


def _check_base(result: Robustness, base: Robustness, names: Sequence[str]) -> None:
    """Raise ValueError if a base has none of the images, or other levels or draws."""
    if not names:
        raise ValueError(f"base must have scores of the same images, got none of {first_names(result.names)}")
    if set(base.scores) != set(result.scores):
        levels, of_base = (
            ", ".join(f"{of.scene} {of.severity}" for of in sorted(run.scores)) for run in (result, base)
        )
        raise ValueError(f"base must have the same scenes and severities, {levels}, got {of_base or 'none'}")
    for level in result.values:
        if level not in base.values:
            continue
        values, of_base = (run.values[level][_rows(run, names)] for run in (result, base))
        differs = ~np.isclose(values, of_base, rtol=_SAME_DRAW, atol=0)
        if differs.any():
            i, quantity = int(differs.argmax()), result.quantities[level.scene].name
            raise ValueError(
                f"base must be of the same draws, by the same seed and version, got a {quantity} of {of_base[i]:.4g}, "
                f"not {values[i]:.4g}, for {names[i]} in {level.scene} {level.severity}"
            )
