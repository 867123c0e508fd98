"""The color of fog, estimated from painted frames whose haze is known."""

import cv2
import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from torchrefract.fields.airlight import airlight_of_frame, dust_airlight
from torchrefract.fields.sky import sky_mask
from torchrefract.fields.srgb import luma

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


def test_the_airlight_of_mirrored_frames_is_the_same():
    frames = 0.3 + 0.6 * torch.rand(8, 3, HEIGHT, WIDTH, generator=torch.Generator().manual_seed(0))  # without sky
    expected = airlight_of_frame(frames)
    assert expected.min() > 0.4
    assert torch.equal(airlight_of_frame(frames.flip(3)), expected)  # many nodes share a value of the dark channel


def test_dust_is_laterite_by_day_and_as_dark_as_the_night():
    laterite = torch.tensor([[0.78, 0.71, 0.61]], dtype=torch.float64)
    assert torch.equal(dust_airlight(street((0.9, 0.9, 0.9), (0.3, 0.3, 0.3))), laterite)
    dark = dust_airlight(night())
    assert_close(dark / dark.mean(), laterite / laterite.mean())
    assert_close(luma(dark[..., None, None]), luma(airlight_of_frame(night())[..., None, None]))
    assert dust_airlight(day()[:, :1]).shape == (1, 1)


@pytest.mark.quick
def test_each_frame_is_judged_alone_with_equal_bits():
    frames = torch.cat([day(), night(), haze(torch.tensor([0.45, 0.42, 0.36]))])
    expected = torch.cat([airlight_of_frame(frame[None]) for frame in frames])
    assert torch.equal(airlight_of_frame(frames), expected)
    assert torch.equal(airlight_of_frame(frames[[2, 0, 1]]), expected[[2, 0, 1]])
    assert airlight_of_frame(frames[:0]).shape == (0, 3)
    assert airlight_of_frame(frames[:, :1]).shape == (3, 1)


def street(sky: tuple[float, float, float], road: tuple[float, float, float]) -> torch.Tensor:
    """Return a frame (1, 3, 120, 200) whose upper half has one color, and whose lower half another with texture."""
    image = torch.tensor(sky).view(1, 3, 1, 1).repeat(1, 1, 120, 200)
    noise = 0.06 * (torch.rand(1, 1, 60, 200, generator=torch.Generator().manual_seed(0)) - 0.5)
    image[:, :, 60:] = torch.tensor(road).view(1, 3, 1, 1) + noise
    return image


def test_real_frames_have_a_bright_airlight_by_day_and_a_dark_one_at_night(shared_data):
    def airlight(name: str) -> torch.Tensor:
        picture = cv2.imread(str(shared_data / "fullres" / name))
        assert picture is not None
        image = torch.from_numpy(picture[..., ::-1].copy()).permute(2, 0, 1)[None].float() / 255
        return airlight_of_frame(image)[0]

    for name in ("ca280_pv_02.jpg", "us_resid_dsc00001.jpg", "us_losaltos_levinj_challenge3.jpg", "cn_pjlab_haze.jpg"):
        color = airlight(name)
        assert color.min() > 0.55, name
        assert color.max() - color.min() < 0.15, name
    for name in ("us_atx_night_112860.jpg", "us_atx_night_218460.jpg", "us_atx_night_374220.jpg"):
        assert airlight(name).max() < 0.45, name


def test_the_sky_is_cut_out_along_poles_and_filled_in_clouds():
    image = street((0.4, 0.6, 0.8), (0.3, 0.3, 0.3))
    image[:, :, 10:70, 100:103] = 0.15  # a pole
    image[:, :, 20:30, 30:60] = 0.95  # a cloud
    mask = sky_mask(image)[0, 0]
    assert not mask[15:60, 100:103].any()
    assert mask[15:58, 97].all()
    assert mask[20:30, 30:60].all()
    assert not mask[62:].any()
