import cv2
import pytest
import torch
from torch.testing import assert_close

from torchrefract.fields.airlight import airlight_of_frame
from torchrefract.fields.sky import sky_mask


def street(sky: tuple[float, float, float], road: tuple[float, float, float]) -> torch.Tensor:
    """Return a frame (1, 3, 120, 200) whose upper half has one color, and whose lower half another with texture."""
    image = torch.tensor(sky).view(1, 3, 1, 1).repeat(1, 1, 120, 200)
    noise = 0.06 * (torch.rand(1, 1, 60, 200, generator=torch.Generator().manual_seed(0)) - 0.5)
    image[:, :, 60:] = torch.tensor(road).view(1, 3, 1, 1) + noise
    return image


def test_a_gray_sky_is_the_airlight():
    assert_close(
        airlight_of_frame(street((0.8, 0.8, 0.8), (0.3, 0.3, 0.3))), torch.full((1, 3), 0.8).double(), atol=1e-4, rtol=0
    )


def test_a_blue_sky_gives_a_fog_that_is_nearly_gray():
    (color,) = airlight_of_frame(street((0.4, 0.6, 0.8), (0.3, 0.3, 0.3)))
    gray = 0.2126 * 0.4 + 0.7152 * 0.6 + 0.0722 * 0.8
    expected = [gray + 0.35 * (value - gray) for value in (0.4, 0.6, 0.8)]
    assert color.tolist() == pytest.approx(expected, abs=1e-4)


def test_lamps_at_night_are_not_the_airlight():
    image = street((0.08, 0.08, 0.1), (0.2, 0.18, 0.15))
    image[:, :, 20:40, 90:110] = 1.0
    assert airlight_of_frame(image).max() < 0.2


def test_haze_without_sky_is_found_by_the_dark_channel():
    image = street((0.45, 0.5, 0.4), (0.45, 0.42, 0.4))
    image[:, :, :60] += 0.1 * (torch.rand(1, 3, 60, 200, generator=torch.Generator().manual_seed(1)) - 0.5)
    image[:, :, 50:70, 80:120] = torch.tensor([0.7, 0.72, 0.74]).view(1, 3, 1, 1)
    assert_close(airlight_of_frame(image), torch.tensor([[0.7, 0.72, 0.74]]).double(), atol=1e-3, rtol=0)


def test_the_airlight_has_equal_bits_in_every_batch():
    images = torch.rand(5, 3, 90, 160, generator=torch.Generator().manual_seed(2))
    images[::2] = torch.cat([street((0.7, 0.8, 0.9), (0.3, 0.3, 0.3))[:, :, ::1, :160][:, :, :90]] * 3)
    together = airlight_of_frame(images)
    assert torch.equal(together, torch.cat([airlight_of_frame(image[None]) for image in images]))


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
