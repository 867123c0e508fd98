import math

import pytest
import torch
from targets import boxes_of
from torch import Tensor, nn
from torch.testing import assert_close

from torchrefract import Compose, LensDistortion, LensFlare, OneOf, ThinPlateSpline, UniformFog, Vignetting, warp_labels
from torchrefract.cameras.camera import Camera
from torchrefract.data.road_scenes import render_road_scenes
from torchrefract.effects.rectification import Rectification
from torchrefract.robustness import worst_case


@pytest.fixture(scope="module")
def frames() -> Tensor:
    return render_road_scenes(torch.arange(3), 45, 80)[0]


@pytest.fixture(scope="module")
def network() -> nn.Module:
    torch.manual_seed(0)
    layers = [nn.Conv2d(3, 8, 5, 2), nn.Tanh(), nn.Conv2d(8, 8, 5, 2), nn.Tanh(), nn.AdaptiveAvgPool2d(3), nn.Flatten()]
    return nn.Sequential(*layers, nn.Linear(72, 4)).requires_grad_(False)


@pytest.fixture(scope="module")
def change(frames, network):
    """Return the loss: how far the output of the network moves, for each sample."""
    clean = network(frames)
    return lambda image, _: (network(image) - clean[: len(image)]).square().sum(dim=1)


@pytest.mark.quick
def test_the_worst_of_a_monotone_loss_is_the_end_of_the_range(frames):
    effect = UniformFog(visibility_range=(40.0, 400.0), deviation_range=(-0.2, 0.2), airlight=0.8)
    worst = worst_case(lambda image, _: -(image - 0.8).square().mean(dim=(1, 2, 3)), effect, frames, steps=30)
    assert_close(worst.params.visibility, torch.full((3,), 40.0), rtol=1e-2, atol=0)
    assert_close(worst.params.deviation, torch.full((3,), 0.2), rtol=0, atol=4e-3)


@pytest.mark.parametrize(
    "effect",
    [
        UniformFog(visibility_range=(40.0, 400.0)),
        LensDistortion(),
        LensFlare(),
        Compose([ThinPlateSpline(), LensDistortion(), LensFlare()]),
    ],
    ids=["fog", "lens", "flare", "composition"],
)
def test_a_search_finds_more_than_random_draws_inside_the_ranges_and_again_by_its_keys(frames, change, effect):
    worst = worst_case(change, effect, frames, steps=10, restarts=2, seed=3, keys=[4, 5, 6])
    random = worst_case(change, effect, frames, steps=1, restarts=20, seed=3, keys=[4, 5, 6])
    assert worst.loss.mean() > random.loss.mean()
    assert worst.curve.shape == (2, 10, 3)
    assert_close(worst.curve.amax(dim=(0, 1)), worst.loss, rtol=1e-2, atol=1e-6)
    assert torch.equal(
        worst.curve[0, 0], worst_case(change, effect, frames, steps=1, restarts=1, seed=3, keys=[4, 5, 6]).curve[0, 0]
    )
    children = effect.effects_with_params(worst.params) if isinstance(effect, Compose) else [(effect, worst.params)]
    for leaf, params in children:
        if isinstance(leaf, UniformFog):
            assert leaf.params_in_range(params)
        if isinstance(leaf, LensDistortion):
            k1 = params.coefficients[:, 0]
            assert ((k1 >= -0.35) & (k1 <= -0.15)).all()  # the default
        if isinstance(leaf, LensFlare):
            low, high = leaf.strength_range
            assert ((params.strength >= low) & (params.strength <= high)).all()
    again = worst_case(change, effect, frames, steps=10, restarts=2, seed=3, keys=[4, 5, 6])
    assert torch.equal(again.image, worst.image)
    assert_close(effect.apply(frames, worst.params).image, worst.image, rtol=0, atol=0)


def test_each_sample_is_searched_alone(frames, change):
    effect = Compose([ThinPlateSpline(), UniformFog(visibility_range=(40.0, 400.0))])
    together = worst_case(change, effect, frames, steps=4, restarts=2, keys=[4, 5, 6])
    alone = worst_case(lambda image, t: change(torch.cat([image] * 2), t)[:1], effect, frames[:1], steps=4, keys=[4])
    assert_close(alone.image, together.image[:1], rtol=0, atol=1e-4)


def test_labels_move_along_in_each_step(frames):
    target = {"boxes": boxes_of([[20.0, 10, 40, 30]], (45, 80)), "labels": torch.tensor([1])}
    seen = []

    def loss(image: Tensor, moved: dict) -> Tensor:
        seen.append(moved["boxes"][0].as_subclass(Tensor))
        return image.mean(dim=(1, 2))[0].expand(()) if image.ndim == 3 else image.mean()

    effect = LensDistortion()
    worst = worst_case(loss, effect, frames[0], target, steps=3, restarts=1)
    expected = warp_labels(target, effect.apply(frames[0], worst.params).flow)
    assert_close(worst.target["boxes"].as_subclass(Tensor), expected["boxes"].as_subclass(Tensor))
    assert len(seen) == 4
    assert len({tuple(box.tolist()) for box in seen}) >= 3
    assert worst.target["labels"].tolist() == [1]


def test_one_of_several_effects_stays_as_drawn_and_the_worst_is_kept(frames, change):
    effect = OneOf([UniformFog(visibility_range=(40.0, 400.0)), Vignetting()])
    worst = worst_case(change, effect, frames, steps=3, restarts=4)
    assert torch.equal(torch.stack([child.applied for child in worst.params.children]).sum(dim=0), torch.ones(3).long())


def test_invalid_arguments_raise(frames):
    camera = Camera(width=80, height=45, fx=70.0, fy=70.0, cx=39.5, cy=22.0, coefficients=(-0.2, 0, 0, 0))
    with pytest.raises(
        ValueError, match="effect must draw parameters, got a loss without a gradient for Rectification"
    ):
        worst_case(lambda image, _: image.mean(), Rectification(camera), frames)
    with pytest.raises(ValueError, match="loss must be differentiable"):
        worst_case(lambda image, _: (image > 0.5).float().mean(), UniformFog(), frames)
    with pytest.raises(ValueError, match=r"loss must return a tensor of shape \(\) or \(3,\), got \(3, 3\)"):
        worst_case(lambda image, _: image.mean(dim=(2, 3)), UniformFog(), frames)
    with pytest.raises(ValueError, match="steps must be"):
        worst_case(lambda image, _: image.mean(), UniformFog(), frames, steps=0)
    with pytest.raises(ValueError, match="lr must"):
        worst_case(lambda image, _: image.mean(), UniformFog(), frames, lr=math.nan)
    model = nn.Conv2d(3, 1, 3)
    with pytest.raises(ValueError, match="loss must be differentiable with respect to the degraded image"):
        worst_case(lambda image, _: model(image.detach()).mean(), UniformFog(), frames)
    for image in (255 * frames, 4 * frames - 2):
        with pytest.raises(ValueError, match=r"image must lie in \[0, 1\] if it is floating"):
            worst_case(lambda image, _: image.mean(), UniformFog(), image)
    with pytest.raises(TypeError, match=r"image must be floating in \[0, 1\], got torch.uint8; use image.float"):
        worst_case(lambda image, _: image.float().mean(), UniformFog(), (255 * frames).byte())
    with pytest.raises(TypeError, match="effect must be an effect of torchrefract, got Identity"):
        worst_case(lambda image, _: image.mean(), nn.Identity(), frames)  # pyright: ignore[reportArgumentType]  # wrong
    with pytest.raises(TypeError, match="seed must be a whole number, got None"):
        worst_case(lambda image, _: image.mean(), UniformFog(), frames, seed=None)  # pyright: ignore[reportArgumentType]  # wrong
    with (
        torch.inference_mode(),
        pytest.raises(RuntimeError, match=r"needs gradients, .* Trainer\(inference_mode=False"),
    ):
        worst_case(lambda image, _: image.mean(), UniformFog(), frames)


@pytest.mark.quick
def test_a_search_leaves_the_gradients_of_the_model_and_needs_none_around_it(frames):
    torch.manual_seed(0)
    model = nn.Conv2d(3, 1, 3)
    effect = UniformFog(visibility_range=(40.0, 400.0))

    def loss(image: Tensor, _: None) -> Tensor:
        return model(image).mean(dim=(1, 2, 3))

    worst = worst_case(loss, effect, frames, steps=3, restarts=1)
    assert all(parameter.grad is None for parameter in model.parameters())
    with torch.no_grad():
        again = worst_case(loss, effect, frames, steps=3, restarts=1)
    assert torch.equal(again.image, worst.image)
