"""The color of fog, estimated from painted frames whose haze is known."""

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from torchrefract.fields.airlight import airlight_of_frame

HEIGHT, WIDTH = 90, 160


def rough(low: float, high: float) -> Tensor:
    """Return texture (3, H, W) without a smooth part."""
    return low + (high - low) * torch.rand(3, HEIGHT, WIDTH, generator=torch.Generator().manual_seed(0))


def day() -> Tensor:
    """Return a frame (1, 3, H, W) whose sky grows brighter from row 0 to row 39."""
    frame = rough(0.1, 0.4)
    frame[:, :40] = torch.tensor([0.5, 0.6, 0.8])[:, None, None] + 0.002 * torch.arange(40.0)[:, None]
    return frame[None]


def night() -> Tensor:
    """Return a dark frame (1, 3, H, W) with lamps."""
    frame = rough(0.02, 0.1)
    frame[:, 20:26, 50:60] = frame[:, 60:66, 80:90] = 1.0
    return frame[None]


def haze(color: Tensor) -> Tensor:
    """Return a frame (1, 3, H, W) without sky in haze of a color, through which the upper left corner is not seen."""
    frame = rough(0.0, 0.9)
    t = torch.ones(HEIGHT, WIDTH)
    t[:25, :40] = 0.0
    return (frame * t + color[:, None, None] * (1 - t))[None]


def test_the_airlight_of_a_blue_day_is_the_light_of_its_horizon_with_a_quarter_of_its_blue():
    sky = torch.tensor([[0.5, 0.6, 0.8]], dtype=torch.float64) + 0.002 * 33.5  # rows 29 to 38; the rim is not smooth
    gray = 0.2126 * sky[0, 0] + 0.7152 * sky[0, 1] + 0.0722 * sky[0, 2]
    assert_close(airlight_of_frame(day()), gray + (sky - gray) / 4, rtol=0, atol=1e-4)


def test_the_airlight_of_an_evening_keeps_the_color_of_the_sky():
    frame = day().flip(1)  # red exceeds blue
    expected = torch.tensor([[0.8, 0.6, 0.5]], dtype=torch.float64) + 0.002 * 33.5
    assert_close(airlight_of_frame(frame), expected, rtol=0, atol=1e-4)


def test_the_airlight_of_a_night_is_dark_and_not_that_of_its_lamps():
    frame = night()
    expected = frame[:, :, :30].double().mean(dim=(2, 3))
    assert_close(airlight_of_frame(frame), expected, rtol=0, atol=1e-5)
    assert expected.max() < 0.1


def test_the_airlight_without_sky_is_the_color_of_the_thickest_haze():
    color = torch.tensor([0.45, 0.42, 0.36])
    assert_close(airlight_of_frame(haze(color)), color[None].double(), rtol=0, atol=1e-4)


@pytest.mark.quick
def test_each_frame_is_judged_alone_with_equal_bits():
    frames = torch.cat([day(), night(), haze(torch.tensor([0.45, 0.42, 0.36]))])
    expected = torch.cat([airlight_of_frame(frame[None]) for frame in frames])
    assert torch.equal(airlight_of_frame(frames), expected)
    assert torch.equal(airlight_of_frame(frames[[2, 0, 1]]), expected[[2, 0, 1]])
    assert airlight_of_frame(frames[:0]).shape == (0, 3)
    assert airlight_of_frame(frames[:, :1]).shape == (3, 1)
