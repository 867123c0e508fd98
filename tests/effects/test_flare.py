import math
from functools import partial
from itertools import pairwise

import numpy as np
import pytest
import torch
from helpers import random_image
from torch import Tensor
from torch.testing import assert_close

from torchrefract import FlareParams, LensFlare

picture = partial(random_image, dtype=torch.float64)
SIZE = (24, 32)
DIAGONAL = math.hypot(*SIZE)


def flare_params(
    image: Tensor, *, center: tuple[float, float] = (0.4, 0.2), radius: float = 0.3, strength: float = 0.6
) -> FlareParams:
    """Return the same white sun for each image."""
    batch, channels = image.shape[:2]

    def row(*values: float) -> Tensor:
        return torch.tensor([values] * batch, dtype=image.dtype)

    applied = torch.ones(batch, dtype=torch.bool)
    one = (row(radius)[:, 0], row(strength)[:, 0])
    return FlareParams(applied, row(*center), *one, row(*[1.0] * channels), row(0.0, 0.0), row(0.0))


def expected_mask(center: tuple[float, float], radius: float) -> Tensor:
    """Compute m by the formula of the paper, with the center from the upper left corner of the frame."""
    height, width = SIZE
    y, x = np.mgrid[:height, :width]
    distance = np.hypot(x + 0.5 - center[0] * width, y + 0.5 - center[1] * height)
    return torch.from_numpy(np.exp(-0.5 * (distance / (radius * DIAGONAL)) ** 2))


@pytest.mark.quick
@pytest.mark.parametrize("center", [(0.4, 0.2), (-0.5, 1.5), (0.5 / SIZE[1], 0.5 / SIZE[0])])
def test_the_image_is_the_closed_form(center):
    image = picture(2, 3, *SIZE)
    m = expected_mask(center, 0.3)
    params = flare_params(image, center=center)
    degraded = LensFlare().apply(image, params)
    added = image + 0.6 * m
    assert_close(degraded.image, added.clamp(0, 1), rtol=0, atol=1e-12)
    assert_close(degraded.intensity, (0.6 * m).expand(2, 1, -1, -1), rtol=0, atol=1e-12)
    assert torch.equal(degraded.valid, (added <= 1).all(dim=1, keepdim=True))
    assert degraded.flow is None
    assert degraded.transmission is None
    unclipped = LensFlare(clip=False).apply(image, params)
    assert_close(unclipped.image, added, rtol=0, atol=1e-12)
    assert torch.equal(unclipped.valid, degraded.valid)
    screen = LensFlare(blend="screen").apply(image, params)
    assert_close(screen.image, 1 - (1 - image) * (1 - 0.6 * m), rtol=0, atol=1e-12)
    assert screen.valid.all()


def test_screened_pixels_without_contrast_are_invalid():
    image = picture(1, 3, *SIZE)
    d = LensFlare(blend="screen").apply(image, flare_params(image, strength=3.0))
    assert d.image.max() == 1
    assert torch.equal(d.valid, 3 * expected_mask((0.4, 0.2), 0.3)[None, None] <= 1 - 1 / 255)


@pytest.mark.parametrize("off", [{"radius": 0.0}, {"strength": 0.0}])
def test_a_flare_of_zero_strength_or_size_keeps_values_outside_the_range(off):
    image = 3 * picture(2, 3, *SIZE) - 1
    d = LensFlare().apply(image, flare_params(image, **off))
    assert torch.equal(d.image, image)
    assert not d.intensity.any()
    assert d.valid.all()


def test_a_white_image_stays_white_and_passes_no_gradient():
    image = torch.ones(1, 3, *SIZE, dtype=torch.float64, requires_grad=True)
    params = flare_params(image)
    strength = params.strength.requires_grad_()
    d = LensFlare().apply(image, params._replace(strength=strength))
    assert (d.image == 1).all()
    for gradient in torch.autograd.grad(d.image.sum(), [image, strength]):
        assert not gradient.any()
    assert not d.valid.any()


def test_gradients_of_screen_blending_match_finite_differences():
    # Dark enough that nothing saturates, where the slope jumps; one sun has its center on a pixel.
    image = 0.3 * picture(2, 3, 5, 7)
    params = flare_params(image)._replace(center=torch.tensor([[3.5 / 7, 2.5 / 5], [0.31, 0.17]], dtype=torch.float64))
    effect = LensFlare(blend="screen")
    names = ("center", "radius", "strength", "color", "drift", "frame")

    def shine(image: Tensor, *values: Tensor) -> Tensor:
        return effect.apply(image, params._replace(**dict(zip(names, values, strict=True)))).image

    values = [image, *(getattr(params, name) for name in names)]
    values[-1] = values[-1] + 2.0
    values[-2] = values[-2] + 0.01
    assert torch.autograd.gradcheck(shine, [value.clone().requires_grad_() for value in values])


def test_the_sun_drifts_over_a_clip():
    clip = torch.zeros(1, 5, 3, *SIZE)
    effect = LensFlare(drift_x_range=(2 / SIZE[1], 2 / SIZE[1]), drift_y_range=(1 / SIZE[0], 1 / SIZE[0]))
    intensity = effect.degrade(clip, seed=3).intensity[0, :, 0]
    for earlier, later in pairwise(intensity):
        assert_close(later[1:, 2:], earlier[:-1, :-2], rtol=0, atol=1e-6)
        assert (later - earlier).abs().max() > 1e-3


def test_a_color_for_other_channels_raises():
    with pytest.raises(ValueError, match="color must have 1 number or 4, one for each channel"):
        LensFlare(color=(1.0, 0.9, 0.8)).degrade(picture(1, 4, 2, 2), seed=7)


def test_a_sun_outside_the_frame_shines_in():
    image = torch.zeros(1, 3, *SIZE)
    d = LensFlare(center_x_range=(-0.2, -0.2), center_y_range=(-0.3, -0.3)).degrade(image, seed=1)
    assert d.intensity[0, 0, 0, 0] == d.intensity.max() > 0.2
    assert d.valid.all()
