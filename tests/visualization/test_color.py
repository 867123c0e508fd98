import colorsys
import math

import pytest
import torch
from matplotlib import colormaps
from torch.testing import assert_close

from torchrefract.visualization import (
    checkerboard,
    flow_to_rgb,
    flow_wheel,
    full_color_px,
    hatch_invalid,
    mark_folded,
    transmission_to_rgb,
)
from torchrefract.visualization.color import round_up

pytestmark = pytest.mark.quick


def color_of(u: float, v: float, *, max_px: float = 1.0) -> torch.Tensor:
    """Return the color of one flow, (3,)."""
    return flow_to_rgb(torch.tensor([u, v], dtype=torch.float32).view(1, 2, 1, 1), max_px=max_px).flatten()


def mask(size: tuple[int, int], *positions: tuple[int, int]) -> torch.Tensor:
    """Return (1, 1, *size), bool, True at the positions (row, column)."""
    value = torch.zeros(1, 1, *size, dtype=torch.bool)
    for row, column in positions:
        value[0, 0, row, column] = True
    return value


@pytest.mark.parametrize(
    ("u", "v", "rgb"),
    [
        (1, 0, (1, 0, 0)),
        (0, 1, (1, 13.75 / 15, 0)),  # a quarter turn is hue 13.75 of 55, between red (0) and yellow (15)
        (-1, 0, (0, 1 - 2.5 / 11, 1)),
        (0, -1, (5.25 / 13, 0, 1)),
    ],
)
def test_right_is_red_down_yellow_left_azure_up_violet(u, v, rgb):
    assert_close(color_of(u, v), torch.tensor(rgb, dtype=torch.float32), atol=1e-5, rtol=0)


def test_the_published_55_hues_lie_evenly_around_a_circle_without_seam():
    # From each color to the next, one channel rises or falls in 15, 6, 4, 11, 13 and 6 equal steps.
    ends = torch.tensor([(1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 1, 1), (0, 0, 1), (1, 0, 1), (1, 0, 0)]).float()
    published = [
        torch.lerp(first, last, k / count)
        for first, last, count in zip(ends, ends[1:], (15, 6, 4, 11, 13, 6), strict=False)
        for k in range(count)
    ]
    turn = 2 * math.pi * torch.arange(55) / 55
    flow = torch.stack([turn.cos(), turn.sin()]).view(1, 2, 1, 55)
    assert_close(flow_to_rgb(flow, max_px=1.0)[0, :, 0].T, torch.stack(published), atol=1e-4, rtol=0)
    assert_close(color_of(0.5, 1e-6), color_of(0.5, -1e-6), atol=1e-4, rtol=0)


@pytest.mark.parametrize("angle_deg", [5, 100, 222, 301])
def test_saturation_is_the_share_of_the_scale_and_longer_flows_are_darker(angle_deg):
    u, v = math.cos(math.radians(angle_deg)), math.sin(math.radians(angle_deg))
    hue = colorsys.rgb_to_hsv(*color_of(u, v, max_px=1.001).tolist())[0]
    for share in (0.1, 0.4, 0.9):
        hsv = colorsys.rgb_to_hsv(*color_of(8 * share * u, 8 * share * v, max_px=8.0).tolist())
        assert hsv == pytest.approx((hue, share, 1.0), abs=3e-4)
    assert_close(
        color_of(50 * u, 50 * v, max_px=2.0), 0.75 * color_of(1.999 * u, 1.999 * v, max_px=2.0), atol=1e-3, rtol=0
    )


def test_the_default_scale_is_the_largest_magnitude_of_the_batch():
    flow = torch.randn(3, 2, 6, 7)
    flow[1, :, 2, 3] = torch.tensor([30.0, -40.0])
    assert_close(flow_to_rgb(flow), flow_to_rgb(flow, max_px=50.0))
    assert flow_to_rgb(flow)[1, :, 2, 3].min() == 0
    assert flow_to_rgb(flow[:0]).shape == (0, 3, 6, 7)


def test_a_flow_that_is_not_finite_is_gray_and_leaves_other_pixels_unchanged():
    flow = torch.randn(1, 2, 4, 5)
    gray = mask((4, 5), (0, 0), (1, 1), (2, 2))
    changed = flow.clone()
    changed[0, 0, 0, 0], changed[0, 1, 1, 1], changed[0, :, 2, 2] = math.nan, math.inf, -math.inf
    expected = torch.where(gray, 0.5, flow_to_rgb(torch.where(gray, 0, flow)))
    assert_close(flow_to_rgb(changed), expected)


def test_a_half_precision_flow_has_the_colors_of_the_same_float_flow():
    flow = 300 * torch.randn(1, 2, 5, 5).half()  # its square would overflow
    assert_close(flow_to_rgb(flow), flow_to_rgb(flow.float()))


@pytest.mark.parametrize("size", [1, 8, 33])
def test_a_pixel_of_the_wheel_has_the_color_of_the_flow_that_points_to_it(size):
    wheel = flow_wheel(size)
    for row in range(size):
        for column in range(size):
            x, y = column - (size - 1) / 2, row - (size - 1) / 2
            expected = color_of(x, y, max_px=size / 2) if math.hypot(x, y) <= size / 2 else torch.ones(3)
            assert_close(wheel[:, row, column], expected, atol=1e-4, rtol=0)


def test_transmission_follows_viridis_brightens_monotonically_and_is_gray_where_nan():
    transmission = torch.linspace(0, 1, 257)
    rgb = transmission_to_rgb(transmission.view(1, 1, 1, -1))[0, :, 0].T
    viridis = torch.from_numpy(colormaps["viridis"](transmission.numpy())[:, :3]).float()
    assert_close(rgb[::32], viridis[::32], atol=1e-3, rtol=0)
    assert_close(rgb, viridis, atol=0.07, rtol=0)
    assert (rgb @ torch.tensor([0.2126, 0.7152, 0.0722])).diff().min() > 0
    assert transmission_to_rgb(torch.full((1, 1, 1, 1), math.nan)).flatten().tolist() == [0.5, 0.5, 0.5]


def test_a_checkerboard_changes_color_every_cell_and_starts_white():
    top, bottom = [1, 1, 1, 0, 0, 0, 1], [0, 0, 0, 1, 1, 1, 0]
    expected = torch.tensor([top, top, top, bottom, bottom], dtype=torch.float32)
    assert_close(checkerboard(5, 7, cell=3), expected.expand(1, 3, 5, 7))


def test_a_round_scale_is_the_largest_valid_magnitude_rounded_up_to_two_digits():
    flow = torch.zeros(1, 2, 2, 3)
    flow[0, :, 0, 0] = torch.tensor([3.0, -4.01])  # 5.008
    flow[0, 0, 1, 1] = 80.0
    flow[0, 1, 1, 2] = math.inf
    assert full_color_px(flow, ~mask((2, 3), (1, 1))) == pytest.approx(5.1)
    assert full_color_px(flow, ~mask((2, 3))) == 80
    assert full_color_px(flow, mask((2, 3), (0, 1))) == 1


@pytest.mark.parametrize(
    ("value", "expected"),
    [(0.0, 1), (56.1, 57), (5.008, 5.1), (0.29, 0.29), (0.0331, 0.034), (99.01, 100), (123456, 130000), (1e-9, 1e-9)],
)
def test_a_number_of_a_legend_has_two_digits_and_is_rounded_up(value, expected):
    assert round_up(value) == pytest.approx(expected, rel=1e-12)


def test_stripes_cover_invalid_pixels_only():
    image = torch.rand(1, 3, 40, 60, dtype=torch.float64)
    valid = ~mask((2, 3), (0, 1), (1, 2))  # each of its pixels is 20 x 20 of the image
    hatched = hatch_invalid(image, valid)
    covered = torch.kron((~valid)[0, 0].double(), torch.ones(20, 20, dtype=torch.float64)).bool()
    assert torch.equal(hatched[0][:, ~covered], image[0][:, ~covered])
    stripe = hatched[0, :, :20, 20:40]
    assert torch.equal(stripe, stripe[:1].expand(3, -1, -1))
    assert_close(stripe.unique(), torch.tensor([0.62, 0.86], dtype=torch.float64), atol=1e-6, rtol=0)
    assert torch.equal(stripe[0, 0, 8:], stripe[0, 0, :-8])  # the period is 8 px
    assert torch.equal(stripe[0, 1:, :-1], stripe[0, :-1, 1:])  # along the diagonal


def test_a_reduced_image_takes_the_valid_flag_under_the_center_of_each_pixel():
    center = hatch_invalid(torch.zeros(1, 3, 2, 2), ~mask((6, 6), (1, 4), (3, 0)))  # (1, 4) is the center of 3 x 3
    assert (center[0, 0] > 0).tolist() == [[False, True], [False, False]]


def test_folded_pixels_are_mixed_with_magenta_and_others_do_not_change():
    image, folded = torch.rand(1, 3, 5, 7, dtype=torch.float64), mask((5, 7), (0, 0), (3, 6))
    magenta = torch.tensor([1.0, 0.0, 1.0], dtype=torch.float64)[:, None, None]
    assert_close(mark_folded(image, folded), torch.where(folded, 0.25 * image + 0.75 * magenta, image))


def test_one_folded_pixel_is_marked_at_its_position_in_reduced_and_enlarged_images():
    reduced = mark_folded(torch.zeros(1, 3, 4, 6), mask((12, 18), (5, 13)))  # 3 x 3 to 1
    assert reduced[0, 0].nonzero().tolist() == [[1, 4]]
    enlarged = mark_folded(torch.zeros(1, 3, 36, 48), mask((12, 16), (5, 13)))
    assert torch.equal(enlarged[0, 0] > 0, torch.kron(mask((12, 16), (5, 13))[0, 0].float(), torch.ones(3, 3)) > 0)


@pytest.mark.parametrize(
    ("function", "arguments", "message"),
    [
        (flow_to_rgb, (torch.zeros(2, 4, 4),), r"flow must have shape \(B, 2, H, W\), got \(2, 4, 4\)"),
        (flow_to_rgb, (torch.zeros(1, 2, 4, 4, dtype=torch.int32),), "flow must be of a floating type"),
        (transmission_to_rgb, (torch.zeros(1, 3, 4, 4),), r"transmission must have shape \(B, 1, H, W\)"),
        (flow_wheel, (0,), "size must be at least 1, got 0"),
        (round_up, (-1.0,), "value must be a finite number of at least 0, got -1"),
        (round_up, (math.nan,), "value must be a finite number of at least 0, got nan"),
        (hatch_invalid, (torch.rand(2, 3, 4, 5), mask((4, 5))), r"valid must have shape \(2, 1, h, w\), got \(1, 1, 4"),
        (hatch_invalid, (torch.rand(1, 1, 4, 5), mask((4, 5))), r"image must have shape \(B, 3, H, W\)"),
        (mark_folded, (torch.rand(1, 3, 4, 5), mask((4, 5)).float()), "folded must be of type bool"),
        (full_color_px, (torch.rand(1, 2, 4, 5), mask((2, 5))), r"valid must have shape \(1, 1, 4, 5\), got"),
    ],
)
def test_invalid_arguments_raise(function, arguments, message):
    with pytest.raises((ValueError, TypeError), match=message):
        function(*arguments)


def test_invalid_options_raise():
    with pytest.raises(ValueError, match="max_px must be above 0, got 0"):
        flow_to_rgb(torch.zeros(1, 2, 4, 4), max_px=0)
    with pytest.raises(ValueError, match="cell must be at least 1, got 0"):
        checkerboard(4, 4, cell=0)
