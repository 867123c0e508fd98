"""The sky of painted and of real frames."""

from pathlib import Path

import pytest
import torch
from torch import Tensor

from torchrefract.data.images import read_image
from torchrefract.fields.sky import find_sky, sky_mask

HEIGHT, WIDTH = 90, 160


def painted(sky: tuple[float, float, float] = (0.45, 0.6, 0.85)) -> tuple[Tensor, Tensor]:
    """Return a frame (1, 3, H, W) with trees of rough texture and a gray road, and its sky (1, 1, H, W)."""
    generator = torch.Generator().manual_seed(0)
    y, x = torch.meshgrid(torch.arange(HEIGHT), torch.arange(WIDTH), indexing="ij")
    is_sky = y < 40
    is_sky &= ~((x > 60) & (x < 90) & (y > 15))  # a tree
    is_sky &= ~((x > 62) & (x < 64))  # and a mast above it, around which the sky is connected
    frame = 0.1 + 0.4 * torch.rand(3, HEIGHT, WIDTH, generator=generator)
    frame = torch.where(y >= 45, 0.4 + 0.02 * torch.rand(3, HEIGHT, WIDTH, generator=generator), frame)
    frame = torch.where(is_sky, torch.tensor(sky)[:, None, None] + 0.001 * y, frame)
    frame[:, 70:80, 30:60] = 0.9  # a white car, bright and smooth, but not connected to the top row
    return frame[None], is_sky[None, None]


@pytest.mark.quick
@pytest.mark.parametrize("sky", [(0.45, 0.6, 0.85), (0.3, 0.35, 0.6), (0.95, 0.95, 0.95), (0.7, 0.65, 0.6)])
def test_blue_white_and_hazy_skies_are_found_up_to_the_rim(sky):
    frame, expected = painted(sky)
    actual = sky_mask(frame)
    assert actual.shape == expected.shape
    assert not (actual & ~expected).any()
    assert (actual & expected).sum() > 0.9 * expected.sum()


def test_sky_that_only_corners_connect_to_the_top_row_is_found():
    frame, expected = painted()
    frame[:, :, :3, :40] = 0.05  # a frame of the windscreen, above sky that is reached from its right
    expected[:, :, :3, :40] = False
    assert (sky_mask(frame) & expected).sum() > 0.85 * expected.sum()


@pytest.mark.parametrize(("share", "is_sky"), [(0.5, True), (0.02, False)])
def test_blue_below_a_cloud_is_sky_if_more_of_the_sky_is_blue_and_else_glass(share, is_sky):
    frame, _ = painted((0.45, 0.55, 0.7))
    cloud = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    cloud[:20] = True
    cloud[:, round((1 - share) * WIDTH) :] = False  # blue, down to the trees
    cloud[20:40, 92:] = True  # a tree, which cuts off what is below the cloud
    frame[0, :, cloud] = 0.9
    frame[0, :, 20:40, 92:] = 0.1 + 0.4 * torch.rand(3, 20, WIDTH - 92, generator=torch.Generator().manual_seed(3))
    part = sky_mask(frame)[:, :, 22:39, :59].float().mean()
    assert part > 0.95 if is_sky else part < 0.05


@pytest.mark.parametrize("name", ["road from above", "night", "trees", "black", "white", "one pixel"])
def test_frames_without_sky_have_none(name):
    frame, _ = painted()
    grain = 0.02 * torch.rand(1, 3, HEIGHT, WIDTH, generator=torch.Generator().manual_seed(1))
    frame = {
        "road from above": 0.48 + grain + 0.08 * torch.linspace(1, 0, HEIGHT)[:, None],
        "night": torch.where(frame > 0.85, frame, frame * 0.3),
        "trees": torch.rand(1, 3, HEIGHT, WIDTH, generator=torch.Generator().manual_seed(2)),
        "black": torch.zeros(1, 3, HEIGHT, WIDTH),
        "white": torch.ones(1, 3, HEIGHT, WIDTH),
        "one pixel": torch.ones(1, 3, 1, 1),
    }[name]
    assert not sky_mask(frame).any()


def test_a_frame_is_judged_alone_and_in_any_type():
    frames = torch.cat([painted(sky)[0] for sky in ((0.45, 0.6, 0.85), (0.95, 0.95, 0.95), (0.1, 0.1, 0.1))])
    together = sky_mask(frames)
    for i, frame in enumerate(frames.split(1)):
        assert torch.equal(sky_mask(frame), together[i : i + 1])
    stored = (255 * frames).round()
    assert torch.equal(sky_mask(stored.to(torch.uint8)), sky_mask(stored.double() / 255))
    assert sky_mask(frames.requires_grad_()).requires_grad is False
    assert sky_mask(frames[:0]).shape == (0, 1, HEIGHT, WIDTH)
    assert sky_mask(frames.detach()[:, :1])[1].any()  # gray frames have white skies


def test_a_larger_frame_has_the_same_sky():
    frame, expected = painted()
    larger = frame.repeat_interleave(12, 2).repeat_interleave(12, 3)
    actual = sky_mask(larger)[:, :, 6::12, 6::12]
    assert (actual == expected).float().mean() > 0.95


@pytest.mark.parametrize(
    ("prefix", "low", "high"),
    # The share of frames with at least 5 % of sky. The Brazilian ones show the road from above, and Austin at night.
    [
        ("ca280", 1.0, 1.0),
        ("in_rdd_[cd]", 0.95, 1.0),
        ("us_losaltos", 0.7, 1.0),
        ("br", 0.0, 0.06),
        ("us_atx", 0.0, 0.06),
    ],
)
def test_real_frames_have_sky_by_day_and_where_the_camera_looks_ahead(shared_data: Path, prefix, low, high):
    paths = sorted((shared_data / "frames").glob(f"*/{prefix}*.jpg"))[::5]
    shares = [sky_mask(read_image(path)[None]).float().mean() for path in paths]
    assert low <= (torch.stack(shares) > 0.05).float().mean() <= high


def test_haze_at_the_horizon_and_sky_behind_poles_belong_to_the_sky():
    frame, expected = painted((0.56, 0.6, 0.64))
    # The sky fades to a gray that is too dark to be taken for sky by itself.
    faded = 0.45 + torch.linspace(1, 0, 30) * (torch.tensor([0.56, 0.6, 0.64])[:, None] - 0.45)
    frame[..., 10:40, :] = torch.where(expected[..., 10:40, :], faded[..., None], frame[..., 10:40, :])
    for pole in ((slice(40), slice(10, 12)), (slice(30, 32), slice(12))):  # a pole to the ground, and its arm
        frame[..., *pole], expected[..., *pole] = 0.1, False
    actual = sky_mask(frame)
    assert (actual & ~expected).sum() < 0.01 * expected.sum()  # the rim, where the trees are as bright
    assert (actual & expected)[..., 33:39, :].sum() > 0.9 * expected[..., 33:39, :].sum()
    frame[..., 5, 100] = torch.nan
    assert (sky_mask(frame) == actual).float().mean() > 0.999


@pytest.mark.parametrize("rows", [1, 2, 15])
def test_a_black_line_or_bar_above_the_frame_does_not_hide_the_sky(rows):
    frame, expected = painted()
    padded = torch.nn.functional.pad(frame, (0, 0, rows, 0))
    padded[:, :, rows - 1] += 0.02 * torch.rand(3, WIDTH, generator=torch.Generator().manual_seed(4))  # compressed
    actual = sky_mask(padded)
    assert not actual[:, :, :rows].any()
    assert (actual[:, :, rows:] != sky_mask(frame)).float().mean() < 0.02
    assert (actual[:, :, rows:] & expected).sum() > 0.9 * expected.sum()
    assert not find_sky(padded).nodes[:, :, :rows].any()


def test_smooth_concrete_and_a_road_in_haze_below_a_white_sky_are_not_sky():
    frame, expected = painted((0.95, 0.95, 0.95))
    frame[..., :40, 100:130], expected[..., :40, 100:130] = 0.6, False  # a viaduct from below
    assert not (sky_mask(frame) & ~expected).any()
    # White haze, without an edge between the sky and the road, which is as bright as a gray sky.
    frame[..., :, 130:] = torch.linspace(1, 0.55, HEIGHT)[:, None]
    actual = sky_mask(frame)[0, 0, :, 132:158]
    assert actual[:30].all()
    assert not actual[70:].any()


@pytest.mark.quick
def test_a_frame_that_was_written_to_has_a_sky_of_its_new_values():
    frame = torch.full((1, 3, HEIGHT, WIDTH), 0.2)
    assert not sky_mask(frame).any()
    frame[:, :, : HEIGHT // 2] = 0.9
    first = sky_mask(frame)
    assert first.any()
    assert torch.equal(sky_mask(frame.clone()), first)
    frame.fill_(0.2)
    assert not sky_mask(frame).any()
    with torch.inference_mode():
        frame = torch.rand(1, 3, HEIGHT, WIDTH)
        sky_mask(frame)
    assert not (sky_mask(frame) & torch.ones(1, requires_grad=True).bool()).requires_grad
