import colorsys
import math

import pytest
import torch
from matplotlib import colormaps
from torch.testing import assert_close

from torchrefract.visualization.color import (
    checkerboard,
    flow_to_rgb,
    flow_wheel,
    full_color_px,
    hatch_invalid,
    mark_folded,
    rounded_up,
    transmission_to_rgb,
)


def arrow(u: float, v: float, *, max_px: float | None = 1.0) -> torch.Tensor:
    """(3,), the color of one flow."""
    return flow_to_rgb(torch.tensor([u, v], dtype=torch.float32).view(1, 2, 1, 1), max_px=max_px).flatten()


def hue_deg(rgb: torch.Tensor) -> float:
    r, g, b = rgb.tolist()
    return 360 * colorsys.rgb_to_hsv(r, g, b)[0]


def published_wheel() -> torch.Tensor:
    """(55, 3): from each color to the next, one channel rises or falls in 15, 6, 4, 11, 13 and 6 equal steps."""
    ends = [(1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 1, 1), (0, 0, 1), (1, 0, 1), (1, 0, 0)]
    hues = []
    for first, last, count in zip(ends, ends[1:], (15, 6, 4, 11, 13, 6), strict=False):
        hues += [[a + (b - a) * k / count for a, b in zip(first, last, strict=True)] for k in range(count)]
    return torch.tensor(hues)


def test_no_motion_is_white():
    assert_close(flow_to_rgb(torch.zeros(2, 2, 3, 4)), torch.ones(2, 3, 3, 4))


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
    assert_close(arrow(u, v), torch.tensor(rgb, dtype=torch.float32), atol=1e-5, rtol=0)


def test_the_published_55_hues_lie_evenly_around_the_circle():
    turn = 2 * math.pi * torch.arange(55) / 55
    flow = torch.stack([turn.cos(), turn.sin()]).view(1, 2, 1, 55)
    assert_close(flow_to_rgb(flow, max_px=1.0)[0, :, 0].T, published_wheel(), atol=1e-4, rtol=0)


def test_the_circle_has_no_seam():
    assert_close(arrow(0.5, 1e-6), arrow(0.5, -1e-6), atol=1e-4, rtol=0)
    assert_close(arrow(-0.5, 1e-6), arrow(-0.5, -1e-6), atol=1e-4, rtol=0)


@pytest.mark.parametrize("angle_deg", range(0, 360, 15))
def test_opposite_directions_have_roughly_complementary_hues(angle_deg):
    u, v = math.cos(math.radians(angle_deg)), math.sin(math.radians(angle_deg))
    assert 140 < abs(hue_deg(arrow(u, v)) - hue_deg(arrow(-u, -v))) < 220


@pytest.mark.parametrize("angle_deg", [5, 100, 222, 301])
def test_hue_depends_on_direction_only_and_saturation_is_the_share_of_the_scale(angle_deg):
    u, v = math.cos(math.radians(angle_deg)), math.sin(math.radians(angle_deg))
    for share in (0.1, 0.4, 0.9):
        rgb = arrow(8 * share * u, 8 * share * v, max_px=8.0)
        assert hue_deg(rgb) == pytest.approx(hue_deg(arrow(u, v, max_px=1.001)), abs=0.1)
        _, saturation, value = colorsys.rgb_to_hsv(*rgb.tolist())
        assert (saturation, value) == pytest.approx((share, 1.0), abs=1e-4)


def test_motion_beyond_the_scale_keeps_its_hue_and_is_darker():
    assert_close(arrow(0, 50, max_px=2.0), 0.75 * arrow(0, 2, max_px=2.0))


def test_without_a_scale_the_longest_flow_of_the_batch_has_full_color():
    flow = torch.randn(3, 2, 6, 7)
    flow[1, :, 2, 3] = torch.tensor([30.0, -40.0])
    assert_close(flow_to_rgb(flow), flow_to_rgb(flow, max_px=50.0))
    assert flow_to_rgb(flow)[1, :, 2, 3].min() == 0


def test_flow_that_is_not_finite_is_gray_and_leaves_the_others_as_they_are():
    flow = torch.randn(1, 2, 4, 5)
    spoiled = flow.clone()
    spoiled[0, 0, 0, 0], spoiled[0, 1, 1, 1], spoiled[0, :, 2, 2] = math.nan, math.inf, -math.inf
    gray = torch.zeros(4, 5, dtype=torch.bool)
    gray[0, 0] = gray[1, 1] = gray[2, 2] = True
    rgb = flow_to_rgb(spoiled)[0]
    assert (rgb[:, gray] == 0.5).all()
    assert_close(rgb[:, ~gray], flow_to_rgb(torch.where(gray, 0, flow))[0][:, ~gray])


def test_a_half_precision_flow_has_the_colors_of_the_same_float_flow():
    flow = 300 * torch.randn(1, 2, 5, 5).half()  # its square would overflow
    assert_close(flow_to_rgb(flow), flow_to_rgb(flow.float()))


@pytest.mark.parametrize("size", [1, 8, 33])
def test_a_place_of_the_wheel_has_the_color_of_the_flow_that_points_there(size):
    wheel = flow_wheel(size)
    for row in range(size):
        for column in range(size):
            x, y = column - (size - 1) / 2, row - (size - 1) / 2
            inside = math.hypot(x, y) <= size / 2
            expected = arrow(x, y, max_px=size / 2) if inside else torch.ones(3)
            assert_close(wheel[:, row, column], expected, atol=1e-4, rtol=0)


def test_transmission_follows_viridis_and_brightens_all_the_way():
    transmission = torch.linspace(0, 1, 257)
    rgb = transmission_to_rgb(transmission.view(1, 1, 1, -1))[0, :, 0].T
    viridis = torch.from_numpy(colormaps["viridis"](transmission.numpy())[:, :3]).float()
    assert_close(rgb[::32], viridis[::32], atol=1e-3, rtol=0)
    assert_close(rgb, viridis, atol=0.07, rtol=0)
    assert (rgb @ torch.tensor([0.2126, 0.7152, 0.0722])).diff().min() > 0


def test_transmission_that_is_nan_is_gray():
    rgb = transmission_to_rgb(torch.tensor([math.nan, 0.0]).view(1, 1, 1, 2))
    assert rgb[0, :, 0, 0].tolist() == [0.5, 0.5, 0.5]
    assert_close(rgb[0, :, 0, 1], torch.tensor([0.267, 0.005, 0.329]))


def test_a_checkerboard_changes_color_every_cell_and_starts_white():
    board = checkerboard(5, 7, cell=3)
    top, bottom = [1, 1, 1, 0, 0, 0, 1], [0, 0, 0, 1, 1, 1, 0]
    expected = torch.tensor([top, top, top, bottom, bottom], dtype=torch.float32)
    assert_close(board, expected.expand(1, 3, 5, 7))


def test_wrong_arguments_are_refused():
    with pytest.raises(ValueError, match=r"flow must have shape \(B, 2, H, W\), got \(2, 4, 4\)"):
        flow_to_rgb(torch.zeros(2, 4, 4))
    with pytest.raises(TypeError, match="flow must be of a floating type"):
        flow_to_rgb(torch.zeros(1, 2, 4, 4, dtype=torch.int32))
    with pytest.raises(ValueError, match="max_px must be a finite number above 0, got 0"):
        flow_to_rgb(torch.zeros(1, 2, 4, 4), max_px=0)
    with pytest.raises(ValueError, match=r"transmission must have shape \(B, 1, H, W\)"):
        transmission_to_rgb(torch.zeros(1, 3, 4, 4))
    with pytest.raises(ValueError, match="size must be at least 1, got 0"):
        flow_wheel(0)
    with pytest.raises(ValueError, match="cell must be at least 1, got 0"):
        checkerboard(4, 4, cell=0)


def mask(size: tuple[int, int], *places: tuple[int, int]) -> torch.Tensor:
    """(1, 1, *size), bool: True at the places."""
    value = torch.zeros(1, 1, *size, dtype=torch.bool)
    for row, column in places:
        value[0, 0, row, column] = True
    return value


def test_a_round_scale_is_the_longest_valid_flow_rounded_up_to_two_digits():
    flow = torch.zeros(1, 2, 2, 3)
    flow[0, :, 0, 0] = torch.tensor([3.0, -4.01])  # 5.008
    flow[0, 0, 1, 1] = 80.0
    flow[0, 1, 1, 2] = math.inf
    assert full_color_px(flow, ~mask((2, 3), (1, 1))) == pytest.approx(5.1)
    assert full_color_px(flow, ~mask((2, 3))) == 80
    assert full_color_px(1e-3 * flow, ~mask((2, 3), (1, 1))) == pytest.approx(0.0051)
    assert full_color_px(flow, mask((2, 3), (0, 1))) == 1


@pytest.mark.parametrize(
    ("value", "expected"),
    [(0.0, 1), (56.1, 57), (5.008, 5.1), (0.29, 0.29), (0.0331, 0.034), (99.01, 100), (123456, 130000), (1e-9, 1e-9)],
)
def test_a_number_for_a_legend_has_two_digits_and_is_not_below(value, expected):
    assert rounded_up(value) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("value", [-1.0, math.nan, math.inf])
def test_what_is_no_number_for_a_legend_is_refused(value):
    with pytest.raises(ValueError, match="value must be a finite number of at least 0, got"):
        rounded_up(value)


def test_stripes_cover_what_is_not_valid_and_nothing_else():
    image = torch.rand(1, 3, 40, 60, dtype=torch.float64)
    valid = ~mask((2, 3), (0, 1), (1, 2))  # each of its pixels is 20 x 20 of the picture
    hatched = hatch_invalid(image, valid)
    covered = torch.kron((~valid)[0, 0].double(), torch.ones(20, 20, dtype=torch.float64)).bool()
    assert torch.equal(hatched[0][:, ~covered], image[0][:, ~covered])
    center = hatch_invalid(torch.zeros(1, 3, 2, 2), ~mask((6, 6), (1, 4), (3, 0)))  # (1, 4) is the center of 3 x 3
    assert (center[0, 0] > 0).tolist() == [[False, True], [False, False]]
    for stripe in (hatched[0, :, :20, 20:40], hatched[0, :, 20:, 40:]):
        assert torch.equal(stripe, stripe[:1].expand(3, -1, -1))
        row = stripe[0, 0]
        assert_close(row.unique(), torch.tensor([0.62, 0.86], dtype=torch.float64), atol=1e-6, rtol=0)
        assert torch.equal(row[8:], row[:-8])  # the period is 8 px
        assert torch.equal(stripe[0, 1:, :-1], stripe[0, :-1, 1:])  # along the diagonal


def test_folded_pixels_are_mixed_with_magenta_and_nothing_else_changes():
    image = torch.rand(1, 3, 5, 7, dtype=torch.float64)
    folded = mask((5, 7), (0, 0), (3, 6))
    marked = mark_folded(image, folded)
    there = folded[0, 0]
    magenta = torch.tensor([1.0, 0.0, 1.0], dtype=torch.float64)[:, None]
    assert_close(marked[0][:, there], 0.25 * image[0][:, there] + 0.75 * magenta)
    assert torch.equal(marked[0][:, ~there], image[0][:, ~there])


def test_one_folded_pixel_outlives_shrinking_and_keeps_its_place_in_enlarging():
    small, large = torch.zeros(1, 3, 4, 6), torch.zeros(1, 3, 36, 48)
    folded = mask((12, 18), (5, 13))  # 3 x 3 of its pixels are one of the small picture
    assert mark_folded(small, folded)[0, 0].nonzero().tolist() == [[1, 4]]
    expected = torch.kron(mask((12, 16), (5, 13))[0, 0].float(), torch.ones(3, 3))
    assert torch.equal(mark_folded(large, mask((12, 16), (5, 13)))[0, 0] > 0, expected > 0)


def test_masks_that_do_not_fit_are_refused():
    image, valid = torch.rand(2, 3, 4, 5), torch.ones(2, 1, 4, 5, dtype=torch.bool)
    with pytest.raises(ValueError, match=r"valid must have shape \(2, 1, h, w\), got \(1, 1, 4, 5\)"):
        hatch_invalid(image, valid[:1])
    with pytest.raises(TypeError, match="folded must be of type bool"):
        mark_folded(image, valid.float())
    with pytest.raises(ValueError, match=r"image must have shape \(B, 3, H, W\)"):
        mark_folded(image[:, :1], valid)
    with pytest.raises(ValueError, match=r"valid must have shape \(2, 1, 4, 5\), got \(2, 1, 2, 5\)"):
        full_color_px(image[:, :2], valid[:, :, :2])
