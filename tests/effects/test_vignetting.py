"""Vignetting and lateral chromatic aberration, against closed forms."""

import math

import pytest
import torch
from helpers import random_image
from torch.testing import assert_close

from torchrefract import Camera, ChromaticAberration, Compose, LensDistortion, Vignetting
from torchrefract.cameras.camera import pinhole_of
from torchrefract.fields.vignetting import vignetting

CAMERA = Camera(width=81, height=61, fx=60.0, fy=70.0, cx=30.0, cy=25.0, coefficients=(0.0,) * 4)


def test_vignetting_is_the_fourth_power_of_the_cosine():
    t = vignetting(torch.tensor([0.5, 1.0]).double(), pinhole_of(CAMERA, height=61, width=81), height=61, width=81)
    angle = math.atan(math.hypot((80 - 30) / 60, (60 - 25) / 70))  # of a corner
    assert t[:, 0, 60, 80].tolist() == pytest.approx([1 - 0.5 * (1 - math.cos(angle) ** 4), math.cos(angle) ** 4])
    assert (t[:, 0, 25, 30] == 1).all()


def test_vignetting_darkens_linear_light():
    image = torch.full((1, 3, 61, 81), 0.5)
    degraded = Vignetting(strength_range=(1.0, 1.0), camera=CAMERA).degrade(image)

    def linear(value):
        return ((value + 0.055) / 1.055) ** 2.4

    assert_close(linear(degraded.image), linear(image) * degraded.transmission)
    stored = Vignetting(strength_range=(1.0, 1.0), camera=CAMERA, linear_light=False).degrade(image)
    assert_close(stored.image, image * degraded.transmission)


def test_each_color_has_its_scale_about_the_principal_point_and_green_stays(pixels):
    x, y = (axis.double() for axis in pixels(61, 81))
    image = torch.stack([x / 100, x / 100, y / 100])[None]
    effect = ChromaticAberration(red_range=(0.02, 0.02), blue_range=(-0.01, -0.01), camera=CAMERA)
    degraded = effect.degrade(image)
    valid = degraded.valid[0, 0]
    assert_close(degraded.image[0, 0][valid], ((30 + (x - 30) / 1.02) / 100).expand_as(valid)[valid])
    assert torch.equal(degraded.image[:, 1], image[:, 1])
    assert_close(degraded.image[0, 2][valid], ((25 + (y - 25) / 0.99) / 100).expand_as(valid)[valid])
    # Blue is smaller, so it lacks the pixels beyond 1 / 0.99 of the frame; so does a smaller red.
    outside = ((25 + (y - 25) / 0.99 - 30).abs() > 30) | ((30 + (x - 30) / 0.99 - 40).abs() > 40)
    assert torch.equal(valid, ~outside.expand_as(valid))
    swapped = ChromaticAberration(red_range=(-0.01, -0.01), blue_range=(0.02, 0.02), camera=CAMERA)
    assert torch.equal(swapped.degrade(image).valid, degraded.valid)


def test_labels_are_those_of_green_and_a_gray_image_stays():
    image, effect = random_image(2, 3, 40, 60), ChromaticAberration(red_range=(0.02, 0.02))
    assert effect.degrade(image).flow is None
    lens = LensDistortion(frame="pad")
    both = Compose([lens, effect]).degrade(image, seed=1)
    alone = lens.apply(image, both.params.children[0])
    assert_close(both.flow, alone.flow)
    assert_close(both.image[:, 1], alone.image[:, 1])
    gray = random_image(2, 1, 40, 60)
    assert torch.equal(effect.degrade(gray).image, gray)
