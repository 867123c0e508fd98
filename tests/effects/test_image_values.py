"""Images that are clearly not in [0, 1], or not laid out as (C, H, W), raise."""

from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from targets import keypoints_of
from torchvision import tv_tensors

from torchrefract import Compose, LensDistortion, LensFlare, UniformFog
from torchrefract.effects.batch import check_image_values

EFFECTS = [LensDistortion(), UniformFog(visibility_range=(50, 50)), LensFlare(), Compose([LensDistortion()])]


def photo(*shape: int) -> torch.Tensor:
    """Return a smooth picture with dark and bright parts, in [0, 1]."""
    height, width = shape[-2:]
    ramp = torch.linspace(0, 1, width) * torch.linspace(0.2, 1, height)[:, None]
    return (ramp.square() + 0.02 * torch.rand(shape, generator=torch.Generator().manual_seed(0))).clamp(0, 1)


@pytest.mark.quick
@pytest.mark.parametrize("effect", EFFECTS, ids=lambda effect: type(effect).__name__)
@pytest.mark.parametrize("shape", [(3, 64, 80), (2, 3, 17, 33), (2, 2, 3, 40, 50)])
def test_values_of_0_to_255_and_normalized_ones_raise(effect, shape):
    image = photo(*shape)
    mean, std = (torch.tensor(value).view(3, 1, 1) for value in ([0.485, 0.456, 0.406], [0.229, 0.224, 0.225]))
    night = (image * 60).round()
    letterboxed = torch.cat([torch.zeros_like(image), torch.zeros_like(image), image * 255], dim=-2)
    for wrong in (image * 255, (image - mean) / std, 2 * image - 1, (image * 255).half(), night, letterboxed):
        with pytest.raises(ValueError, match=r"image must lie in \[0, 1\] if it is floating, got values from .* to"):
            effect(wrong)
    effect(image)
    effect((image * 255).round().byte())


def test_values_slightly_outside_the_range_pass():
    image = photo(2, 3, 64, 80)
    overshoot = torch.nn.functional.interpolate(
        (image > 0.3).float()[..., ::4, ::4], scale_factor=4, mode="bicubic", align_corners=False
    )
    assert overshoot.min() < -0.1
    assert overshoot.max() > 1.1
    highlights = torch.where(image > 0.7, 20 * image, image)
    invalid = image.clone()
    invalid[:, :, ::8] = torch.nan
    invalid[:, :, 1, 1] = 1e30
    for allowed in (overshoot, highlights, invalid, torch.zeros(3, 4, 5), torch.zeros(0, 3, 4, 5), 1.3 * image - 0.1):
        check_image_values(allowed)


def test_values_are_read_once_for_each_effect_and_shape(monkeypatch):
    calls: list[Any] = []
    monkeypatch.setattr("torchrefract.effects.base.check_image_values", calls.append)
    effect, other = UniformFog(), UniformFog()
    for image in (photo(3, 20, 30), photo(3, 20, 30), photo(3, 20, 31)):
        effect(image)
    assert len(calls) == 2
    other(photo(3, 20, 30))
    assert len(calls) == 3
    other(photo(3, 50, 30).requires_grad_())  # computed by a network
    assert len(calls) == 3


def test_a_black_frame_does_not_stand_for_the_values_of_those_that_follow():
    effect = UniformFog()
    effect(torch.zeros(3, 20, 30))
    with pytest.raises(ValueError, match=r"image must lie in \[0, 1\] if it is floating"):
        effect(255 * photo(3, 20, 30))


def test_a_clip_with_the_channels_before_the_frames_is_warned_of():
    with pytest.warns(
        UserWarning, match=r"taken for clips of 3 frames with 8 channels; use image\.movedim\(-4, -3\) if"
    ):
        LensFlare()(torch.rand(1, 3, 8, 24, 32))
    LensFlare()(torch.rand(1, 8, 3, 24, 32))
    LensFlare()(torch.rand(1, 3, 4, 24, 32))


@pytest.mark.quick
@pytest.mark.parametrize(
    ("image", "error", "message"),
    [
        (
            torch.zeros(48, 60, 3, dtype=torch.uint8),
            ValueError,
            "channels before its height and width, got .*; use image.movedim",
        ),
        (torch.zeros(2, 48, 60, 4), ValueError, "image must have its channels before its height and width"),
        (torch.zeros(48, 60, 1), ValueError, "image must have its channels before its height and width"),
        (
            np.zeros((48, 60, 3), dtype=np.uint8),
            TypeError,
            r"image must be a tensor, got numpy\.ndarray; convert it by",
        ),
        (torch.zeros(3, 48, 60, dtype=torch.uint16), TypeError, r"got torch\.uint16; divide it by"),
        ([1, 2], TypeError, "image must be a tensor, or a sample with an Image"),
    ],
)
def test_other_layouts_and_types_raise(image, error, message):
    with pytest.raises(error, match=message):
        UniformFog()(image)


def test_labels_in_the_place_of_the_image_raise():
    mask = tv_tensors.Mask(torch.zeros(1, 48, 60, dtype=torch.uint8))
    points = keypoints_of(torch.rand(1, 3, 2), (48, 60))
    for label in (mask, points):
        with pytest.raises(
            TypeError, match=rf"image must be an image, got {type(label).__name__} of torchvision; pass"
        ):
            UniformFog()(label, tv_tensors.Image(torch.rand(3, 48, 60)))
        with pytest.raises(TypeError, match="image must be an image"):
            UniformFog().degrade(label, seed=0)


def test_a_picture_of_pillow_raises():
    picture = Image.new("RGB", (60, 48))
    for inputs in ((picture,), (picture, {}), ({"image": picture, "labels": torch.arange(2)},)):
        with pytest.raises(TypeError, match=r"image must be a tensor, got PIL\.Image\.Image; .* place v2\.ToImage\(\)"):
            LensDistortion()(*inputs)
