import math
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch
from targets import boxes_of
from torch import Tensor, nn
from torchvision import tv_tensors

from torchrefract import LensDistortion, UniformFog, key_of, presets
from torchrefract.effects.base import Effect
from torchrefract.fields import fog_volume
from torchrefract.robustness import Level, Quantity, Robustness, evaluate
from torchrefract.robustness.report import format_tolerated
from torchrefract.robustness.scores import as_labels, classification_score, detection_score, segmentation_score

VISIBILITY = Quantity("visibility", "m", False, lambda params: params.visibility)
RANGES = {1: (500.0, 1000.0), 2: (200.0, 500.0), 3: (60.0, 200.0), 4: (40.0, 60.0), 5: (20.0, 40.0)}


def flat_depth(name: str, image: Tensor) -> Tensor:
    return torch.full_like(image[:1], 50.0)


def fogs(**options) -> dict[int, Effect]:
    return {
        severity: UniformFog(visibility_range=limits, deviation_range=(0.0, 0.0), airlight=1.0, **options)
        for severity, limits in RANGES.items()
    }


def black(count: int) -> list[tuple[str, Tensor, int]]:
    return [(f"drive/{i:03}.png", torch.zeros(3, 8, 12), 1) for i in range(count)]


def test_a_model_that_fails_below_a_visibility_has_it_as_its_tolerated_value():
    # At 50 m a black image has the light 1 - 0.05^(50 / V), which is 0.6 at V = 163 m.
    def predict(images: Tensor) -> Tensor:
        return torch.stack([images.mean(dim=(1, 2, 3)) - 0.6, 0.6 - images.mean(dim=(1, 2, 3))], dim=1)

    result = evaluate(
        predict, black(40), {"fog": fogs()}, classification_score, quantities={"fog": VISIBILITY}, depth=flat_depth
    )
    truth = 50 * math.log(0.05) / math.log(0.4)
    estimate = result.tolerated("fog", loss=0.1)
    assert estimate.low <= truth <= estimate.high
    assert estimate.value == pytest.approx(truth, rel=0.1)
    rows = result.rows()
    assert [row.score.value for row in rows[:2]] == [1, 1]
    assert [row.score.value for row in rows[3:]] == [0, 0]
    assert [(row.quantity, row.unit, row.num_images) for row in rows] == [("visibility", "m", 40)] * 5
    assert 500 < rows[0].value < 1000
    share = rows[2].score.value
    assert result.mean_performance("fog") == pytest.approx((2 + share) / 5)
    assert result.relative_performance() == pytest.approx((2 + share) / 5)


def test_a_model_that_writes_to_its_images_is_scored_like_one_that_does_not():
    def normalize(images: Tensor, *, in_place: bool) -> Tensor:
        images = images.sub_(0.5) if in_place else images - 0.5
        return torch.stack([images.mean(dim=(1, 2, 3)), 0.3 - images.mean(dim=(1, 2, 3))], dim=1)

    def score(prediction: Tensor, _: int) -> float:
        return prediction[0].clamp(0, 1).item()

    samples = [("a.png", torch.full((3, 8, 12), 0.6), 1)]
    levels: dict[int, Effect] = {1: UniformFog(p=0.0), 2: UniformFog(visibility_range=(50.0, 500.0))}
    results = [
        evaluate(partial(normalize, in_place=in_place), samples, {"fog": levels}, score, depth=flat_depth)
        for in_place in (False, True)
    ]
    assert results[0].clean == results[1].clean == pytest.approx(0.1)
    assert results[0].scores == results[1].scores
    assert samples[0][1].eq(0.6).all()


def test_differences_between_levels_are_less_than_half_as_uncertain_as_with_independent_draws():
    def score(prediction: Tensor, target: Tensor) -> float:
        return 1 - prediction.mean().item()

    levels: dict[int, Effect] = {
        1: UniformFog(visibility_range=(50.0, 500.0)),
        2: UniformFog(visibility_range=(40.0, 400.0)),
    }
    runs = [evaluate(lambda x: x, black(60), {"fog": levels}, score, seed=seed, depth=flat_depth) for seed in (0, 1)]
    mild, strong = (next(v for level, v in runs[0].scores.items() if level.severity == s) for s in (1, 2))
    independent = next(v for level, v in runs[1].scores.items() if level.severity == 2)
    assert np.std(mild - strong) < 0.5 * np.std(mild - independent)
    again = evaluate(lambda x: x, black(60)[::-1], {"fog": levels}, score, depth=flat_depth)
    assert again.names == runs[0].names[::-1]
    for level, values in runs[0].scores.items():
        np.testing.assert_allclose(again.scores[level][::-1], values, atol=1e-6)


def test_the_worst_case_of_an_image_is_its_lowest_score_of_keyed_draws_the_usual_one_among_them():
    # At 50 m a black image has the light 1 - 0.05^(50 / V), so the lowest visibility V has the lowest score.
    calls, effects, samples = [], {s: fogs()[s] for s in (3, 5)}, black(6)

    def predict(images: Tensor) -> Tensor:
        calls.append(1)
        return images

    def run(samples: list[tuple[str, Tensor, int]], draws: int | None) -> Robustness:
        options: dict[str, Any] = {"worst_case_draws": draws, "seed": 3, "depth": flat_depth}
        return evaluate(predict, samples, {"fog": effects}, lambda image, _: 1 - image.mean().item(), **options)

    usual, result = run(samples, None), run(samples, 5)
    assert len(calls) == 6 * (1 + 2) + 6 * (1 + 2 * 5)
    again, more = run(samples[::-1], 5), run(samples, 40)
    for level, effect in zip(usual.scores, effects.values(), strict=True):
        draws = [
            effect.sample(torch.zeros(6, 3, 8, 12), seed=3 + i, keys=[key_of(n) for n in usual.names]) for i in range(5)
        ]
        visibility, draw = torch.stack([params.visibility for params in draws]).min(dim=0)
        np.testing.assert_allclose(result.worst_case[level], 0.05 ** (50 / visibility.double()), atol=1e-5)
        assert (result.worst_seeds[level] == 3 + draw.numpy()).all()
        np.testing.assert_array_equal(result.scores[level], usual.scores[level])
        np.testing.assert_array_equal(again.worst_case[level][::-1], result.worst_case[level])
        assert (result.worst_case[level] <= result.scores[level]).all()
        assert (more.worst_case[level] <= result.worst_case[level]).all()
        low, high = RANGES[level.severity]
        assert more.worst_case[level].max() < 0.05 ** (50 / (low + 0.3 * (high - low)))  # 1e-6 is the chance of another
    assert usual.worst_case == usual.worst_seeds == {}
    worst = {level.severity: values.mean() for level, values in result.worst_case.items()}
    assert [row.worst_case.value for row in result.rows() if row.worst_case] == pytest.approx([worst[3], worst[5]])
    assert [row.worst_case for row in usual.rows()] == [None, None]
    assert result.mean_performance("fog", of="worst_case") == pytest.approx((worst[3] + worst[5]) / 2)
    assert result.relative_performance(of="worst_case") == pytest.approx((worst[3] + worst[5]) / 2)  # clean 1


def test_scores_of_a_run_without_worst_cases_are_not_continued_with_them():
    stored: dict[str, Any] = {}

    def run(**options: Any) -> Robustness:
        return evaluate(lambda x: x, black(2), {"fog": fogs()}, lambda *_: 0.5, depth=flat_depth, **options)

    run(on_scored=stored.__setitem__)
    with pytest.raises(ValueError, match=r"done must have worst cases, got none for drive/000\.png; score it again"):
        run(done=stored, worst_case_draws=2)
    for draws, error in ((1, ValueError), (True, TypeError)):
        with pytest.raises(error, match="worst_case_draws must be"):
            run(worst_case_draws=draws)


@pytest.mark.quick
def test_the_relative_performance_of_all_scenes_is_the_mean_resilience_rate():
    scores = {Level("fog", 1): 0.6, Level("fog", 5): 0.2, Level("lens", 3): 0.7}
    result = Robustness(
        names=["a.png", "b.png"],
        clean=np.array([1.0, 0.6]),
        scores={level: np.array([score, score]) for level, score in scores.items()},
        values={},
        set_scores={None: {"mAP": 0.5}} | {level: {"mAP": score / 2} for level, score in scores.items()},
    )
    resilience = [(0.6 + 0.2) / (2 * 0.8), 0.7 / (1 * 0.8)]  # of a scene: sum of its scores / (levels x clean score)
    assert result.relative_performance() == pytest.approx(sum(resilience) / 2)
    assert result.relative_performance("fog") == pytest.approx(resilience[0])
    of_set = [(0.3 + 0.1) / (2 * 0.5), 0.35 / (1 * 0.5)]
    assert result.relative_performance(of="mAP") == pytest.approx(sum(of_set) / 2)


def test_labels_and_clean_predictions_move_along_the_flow():
    image = torch.zeros(3, 60, 90)
    image[:, 20:32, 60:80] = 1

    def predict(images: Tensor) -> list[dict[str, Tensor]]:
        """Detect the one bright box."""
        rows, columns = (images[0].mean(dim=0) > 0.5).nonzero().unbind(1)
        box = torch.stack([columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]).float()
        return [{"boxes": box[None], "labels": torch.tensor([1]), "scores": torch.tensor([0.9])}]

    lens = LensDistortion(k1_range=(-0.5, -0.4), k2_range=(0.15, 0.2), focal_range=(0.7, 0.8))
    target = {"boxes": boxes_of([[60.0, 20, 80, 32]], (60, 90)), "labels": torch.tensor([1])}
    still = detection_score(predict(lens.degrade(image, seed=0).image[None])[0], target)
    assert still == 0  # the lens moves the box by more than half of its size
    for given in (target, None):
        samples = [("a.png", image, given)]
        options: dict[str, Any] = {"as_target": as_labels, "worst_case_draws": 3}
        result = evaluate(predict, samples, {"lens": {3: lens}}, detection_score, **options)
        assert [row.score.value for row in result.rows()] == [1]
        assert result.worst_case[Level("lens", 3)].tolist() == [1]  # of three lenses, each with its flow


@pytest.mark.quick
@pytest.mark.parametrize("dtype", [torch.uint8, torch.uint16, torch.int64])
def test_pixels_that_show_nothing_of_the_clean_image_are_not_scored(dtype):
    def predict(images: Tensor) -> Tensor:
        """Take all for class 1, of three."""
        return torch.tensor([0.0, 1, 0]).view(1, 3, 1, 1).expand(len(images), 3, *images.shape[2:])

    lens = LensDistortion(k1_range=(-0.3, -0.3), frame="pad")
    image = torch.ones(3, 60, 90)
    assert 0.01 < (lens.degrade(image).image == 0).float().mean() < 0.5
    for target in (tv_tensors.Mask(torch.ones(60, 90, dtype=dtype)), None):
        samples = [("a.png", image, target)]
        result = evaluate(predict, samples, {"lens": {3: lens}}, segmentation_score, as_target=as_labels)
        assert [row.score.value for row in result.rows()] == [1]
        assert result.set_scores[Level("lens", 3)] == {"mIoU": 1}


@pytest.mark.quick
@pytest.mark.parametrize("dtype", [torch.bool, torch.int8, torch.uint16])
def test_classes_of_any_type_take_the_place_of_labels_where_the_degraded_image_shows_something(dtype):
    def predict(images: Tensor) -> Tensor:
        """Take all for class 1."""
        return torch.ones(len(images), *images.shape[2:], dtype=dtype)

    samples = [("a.png", torch.ones(3, 60, 90), None)]
    lens = {3: LensDistortion(k1_range=(-0.3, -0.3), frame="pad")}
    result = evaluate(predict, samples, {"lens": lens}, segmentation_score, as_target=as_labels)
    assert [row.score.value for row in result.rows()] == [1]


@pytest.mark.filterwarnings("ignore:depth is that of a road")  # scenes assume a depth; the test counts fields
def test_the_severities_of_a_scene_share_their_random_fields_which_changes_no_image(monkeypatch):
    drawn, noise = [], fog_volume.noise_on_planes
    monkeypatch.setattr(
        fog_volume, "noise_on_planes", lambda *args, **kwargs: drawn.append(1) or noise(*args, **kwargs)
    )
    scenes = {
        scene: {severity: getattr(presets, scene)(severity) for severity in (1, 4)}
        for scene in ("cape_town_fog", "highveld_heat_haze", "highveld_telephoto")
    }
    image, images = torch.rand(3, 45, 80, generator=torch.Generator().manual_seed(0)), []

    def predict(batch: Tensor) -> Tensor:
        images.append(batch[0])
        return torch.tensor([[0.0, 1.0]])

    evaluate(predict, [("a.png", image, 1)], scenes, classification_score)
    assert len(drawn) == 1
    effects = [effect for by_severity in scenes.values() for effect in by_severity.values()]
    for effect, degraded in zip(effects, images[1:], strict=True):
        assert torch.equal(degraded, effect.degrade(image, seed=0, keys=[key_of("a.png")]).image)
    assert len(drawn) == 3


def test_a_prediction_that_raises_is_left_out_and_said_and_many_stop_the_run():
    def predict(images: Tensor) -> Tensor:
        if images.amax() > 0.9:
            raise RuntimeError("out of memory")
        return torch.tensor([[0.0, 1.0]])

    samples = [(f"{i}.png", torch.full((3, 8, 12), 1.0 if i == 7 else 0.1), 1) for i in range(20)]
    effects: dict[str, dict[int, Effect]] = {"fog": {1: UniformFog(airlight=0.5)}}
    with pytest.warns(
        UserWarning, match=r"predict failed for 1 of 20 images, which are left out: 7\.png: RuntimeError: out of memory"
    ):
        result = evaluate(predict, samples, effects, classification_score)
    assert len(result.names) == 19
    assert result.failures == {"7.png": "RuntimeError: out of memory"}
    bright = [(name, torch.ones_like(image), target) for name, image, target in samples]
    with pytest.raises(RuntimeError, match=r"failed for 10 of 10; the last was 9\.png: RuntimeError: out of memory"):
        evaluate(predict, bright, effects, classification_score)
    with pytest.raises(RuntimeError, match="there are no samples"):
        evaluate(predict, [], effects, classification_score)
    with pytest.raises(ValueError, match="target must be labels, or as_target a function"):
        evaluate(predict, [("a.png", samples[0][1], None)], effects, classification_score)


def test_an_error_of_the_effect_or_the_score_is_not_taken_for_one_of_the_model():
    def no_depth(name: str, image: Tensor) -> Tensor:
        raise KeyError("no map")

    with pytest.raises(KeyError, match="no map"):
        evaluate(lambda x: x, black(2), {"fog": fogs()}, lambda *_: 1.0, depth=no_depth)
    with pytest.raises(ValueError, match=r"score must return a number in \[0, 1\], got 7\.0"):
        evaluate(lambda x: x, black(2), {"fog": fogs()}, lambda *_: 7.0)


@pytest.mark.quick
def test_samples_and_scenes_of_another_form_raise():
    scenes: Any = {"fog": fogs()}
    calls = []

    def run(samples: Any, scenes: Any = scenes) -> Robustness:
        return evaluate(lambda image: calls.append(1) or image.mean(dim=(2, 3)), samples, scenes, lambda *_: 1.0)

    for image in (torch.zeros(1, 3, 8, 12), torch.zeros(8, 12), np.zeros((3, 8, 12))):
        with pytest.raises(ValueError, match=r"samples must have images \(3, H, W\), tensors, got .* for a"):
            run([("a", image, 1)])
    with pytest.raises(TypeError, match="samples must have names that are texts, got 7"):
        run([(7, torch.zeros(3, 8, 12), 1)])
    for wrong in ({"fog": UniformFog()}, [UniformFog()], UniformFog(), {"fog": {1: nn.Identity()}}):
        with pytest.raises(TypeError, match=r"scenes must be \{scene: \{severity: effect\}\}, got"):
            run(black(1), wrong)
    assert not calls
    with pytest.raises(ValueError, match=r"samples must have names of their own, got drive/000\.png twice"):
        run(black(2) + black(1))


def test_a_model_without_a_score_on_clean_images_tolerates_nothing():
    result = evaluate(lambda x: x, black(3), {"fog": fogs()}, lambda *_: 0.0, quantities={"fog": VISIBILITY})
    with pytest.raises(ValueError, match="the mean score of the clean images must be above 0"):
        result.tolerated("fog")


@pytest.mark.quick
@pytest.mark.parametrize("values", [[300.0, 100.0], [200.0]])
@pytest.mark.parametrize(
    ("score", "expected"),
    [(0.5, "loses more than 10% even at the mildest"), (0.95, "loses at most 10% even at the strongest")],
)
def test_a_scene_of_which_nothing_or_everything_is_tolerated_is_described_so(values, score, expected):
    levels = {Level("fog", severity): value for severity, value in enumerate(values, start=1)}
    result = Robustness(
        names=["a.png"],
        clean=np.ones(1),
        scores={level: np.array([score]) for level in levels},
        values={level: np.array([value]) for level, value in levels.items()},
        set_scores={},
        quantities={"fog": VISIBILITY},
    )
    value = max(values) if score == 0.5 else min(values)
    text = format_tolerated(result, "fog", loss=0.1)
    assert text.startswith(f"{expected} tested value, visibility {value:.0f} m (95 % interval ")


def test_unknown_scenes_raise():
    result = evaluate(lambda x: [x], black(2), {"fog": {1: UniformFog()}}, lambda *_: 1.0)
    with pytest.raises(ValueError, match=r"scene must be one with a quantity \(no scene has one\), got fog"):
        result.tolerated("fog")


@pytest.mark.quick
def test_a_mean_of_an_unknown_scene_or_score_raises():
    result = evaluate(lambda image: image.mean(dim=(1, 2, 3)), black(2), {"fog": fogs()}, lambda *_: 0.5)
    for of_set in (result.mean_performance, result.relative_performance):
        assert of_set("fog") == pytest.approx(0.5 if of_set == result.mean_performance else 1)
        with pytest.raises(ValueError, match="scene must be one of fog, got fgo"):
            of_set("fgo")
        for of in ("worst_case", "mAP"):
            with pytest.raises(ValueError, match=f"of must be one of score, got {of}"):
                of_set(of=of)
