import math

import numpy as np
import pytest

from torchrefract.robustness import Level, Quantity, Robustness, corruption_error, images_of_both

VISIBILITY = Quantity("visibility", "m", False, lambda params: params.visibility)


def constant_scores(names: str, scores: dict[Level, list[float]], value: float = 100.0) -> Robustness:
    """Return scores of images, whose fogs have one visibility in all."""
    return Robustness(
        names=list(names),
        clean=np.ones(len(names)),
        scores={level: np.array(of) for level, of in scores.items()},
        values={level: np.full(len(names), value) for level in scores if level.scene == "fog"},
        set_scores={},
        quantities={"fog": VISIBILITY},
    )


@pytest.mark.quick
def test_the_corruption_error_is_the_ratio_of_the_errors_of_the_images_of_both_runs():
    mild, strong, lens = Level("fog", 1), Level("fog", 5), Level("lens", 3)
    result = constant_scores("abc", {mild: [1, 0.8, 0], strong: [0.5, 0.1, 0], lens: [0.9, 0.7, 0]})
    base = constant_scores("dba", {lens: [0, 0.5, 0.5], mild: [0, 0.9, 0.7], strong: [0, 0.2, 0.2]})
    assert images_of_both(result, base) == ["a", "b"]
    # Mean errors over a and b: 0.1 and 0.7 against 0.2 and 0.8 in fog, 0.2 against 0.5 through the lens.
    assert corruption_error(result, base, "fog") == pytest.approx(0.8 / 1.0)
    assert corruption_error(result, base, "lens") == pytest.approx(0.2 / 0.5)
    assert corruption_error(result, base) == pytest.approx((0.8 + 0.4) / 2)
    assert corruption_error(result, result) == pytest.approx(1)


@pytest.mark.quick
def test_a_scene_in_which_the_base_makes_no_error_has_no_corruption_error_and_the_mean_has_none():
    fog, lens = Level("fog", 1), Level("lens", 3)
    result = constant_scores("ab", {fog: [0.5, 0.5], lens: [0.4, 0.6]})
    base = constant_scores("ab", {fog: [1.0, 1 - 1e-7], lens: [0.4, 0.6]})  # a score of 1 and its rounding
    assert math.isnan(corruption_error(result, base, "fog"))
    assert math.isnan(corruption_error(base, base, "fog"))
    assert corruption_error(result, base, "lens") == 1
    assert math.isnan(corruption_error(result, base))


@pytest.mark.quick
def test_a_base_of_other_images_levels_or_draws_raises():
    fog = Level("fog", 1)
    result = constant_scores("ab", {fog: [0.5, 0.5]})
    with pytest.raises(ValueError, match="base must have scores of the same images, got none of a, b"):
        corruption_error(result, constant_scores("cd", {fog: [0.5, 0.5]}))
    for levels in ([Level("fog", 2)], [Level("haze", 1)], [fog, Level("fog", 2)], []):
        with pytest.raises(ValueError, match="base must have the same scenes and severities, fog 1, got"):
            corruption_error(result, constant_scores("ab", {level: [0.5, 0.5] for level in levels}))
    with pytest.raises(
        ValueError, match=r"base must be of the same draws, .*got a visibility of 101, not 100, for a in"
    ):
        corruption_error(result, constant_scores("ab", {fog: [0.5, 0.5]}, value=101.0))
    assert (
        corruption_error(result, constant_scores("ab", {fog: [0.5, 0.5]}, value=100 + 1e-5)) == 1
    )  # of another device
    with pytest.raises(ValueError, match="scene must be one of fog, got mist"):
        corruption_error(result, result, "mist")
