import pytest
import torch
from torch.testing import assert_close

from torchrefract import compose_flows, warp
from torchrefract.warping.grid import inside

SIZE = (90, 120)


def test_the_composite_of_smooth_flows_is_the_analytic_one(pixels, waves):
    x, y = pixels(*SIZE)
    then = waves(x, y, 3.0, 25.0, phase=1.1)
    first = waves(x, y, 5.0, 40.0)
    expected = then + waves(x + then[0, 0], y + then[0, 1], 5.0, 40.0)
    error = (compose_flows(first, then) - expected).abs().amax(dim=1, keepdim=True)[inside(then)]
    # Bilinear interpolation of one wave errs by at most (|f_xx| + |f_yy|) / 8.
    assert error.max() <= 2 * 5.0 / 40.0**2 / 8
    assert error.max() <= 2e-3


@pytest.mark.parametrize("size", [(1, 1), (1, 9), (7, 1), (90, 120)])
def test_two_warps_of_a_ramp_are_one_exactly(pixels, waves, size):
    # A ramp is read without error, so that the law has no interpolation to hide behind.
    x, y = pixels(*size)
    ramp = torch.stack([x, y])[None]
    first, then = waves(x, y, 5.0, 40.0), waves(x, y, 3.0, 25.0, phase=1.1)
    once, seen_once = warp(ramp, first, padding="border")
    twice, seen_twice = warp(once, then, padding="border")
    composed = compose_flows(first, then)
    direct, seen = warp(ramp, composed, padding="border")
    # What the second warp mixes must all have been on the frame in the first.
    whole = seen & seen_twice & (warp(seen_once.double(), then)[0] == 1)
    assert whole.any() or min(size) == 1
    assert_close(direct.where(whole, 0), twice.where(whole, 0), rtol=0, atol=1e-10)


def test_two_warps_of_a_picture_are_one_up_to_interpolation(pixels, waves):
    x, y = pixels(*SIZE)
    image = waves(x, y, 0.5, 10.0)
    first, then = waves(x, y, 5.0, 40.0), waves(x, y, 3.0, 25.0, phase=1.1)
    once, seen_once = warp(image, first)
    twice, _ = warp(once, then)
    direct, seen = warp(image, compose_flows(first, then))
    whole = seen & (warp(seen_once.double(), then)[0] == 1)
    # Three look-ups of a wave whose slope reaches 0.05 and whose curvature sum is at most 0.01, stretched by 1.2^2.
    bound = 2 * 0.01 / 8 * 1.44 + 0.05 * 2 * 5.0 / 40.0**2 / 8 + 0.01 / 8
    assert (direct - twice).abs().amax(dim=1, keepdim=True)[whole].max() <= bound
    reverse, _ = warp(image, compose_flows(then, first))
    assert (reverse - twice).abs().amax(dim=1, keepdim=True)[whole].max() > 5 * bound


def test_a_flow_composed_with_none_stays_as_it_is(pixels, waves):
    flow = waves(*pixels(*SIZE), 5.0, 40.0)
    still = torch.zeros_like(flow)
    assert_close(compose_flows(flow, still), flow, rtol=0, atol=1e-12)
    assert_close(compose_flows(still, flow), flow, rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("first", "then", "result"),
    [
        (torch.float32, torch.float32, torch.float32),
        (torch.float16, torch.bfloat16, torch.float32),
        (torch.float32, torch.float64, torch.float64),
    ],
)
def test_the_composite_is_of_the_finer_type_and_never_half(pixels, waves, first, then, result):
    flow = waves(*pixels(8, 9), 1.0, 5.0)
    composed = compose_flows(flow.to(first), flow.to(then))
    exact = compose_flows(flow.to(first).double(), flow.to(then).double())
    assert composed.dtype == result
    assert_close(composed.double(), exact, rtol=0, atol=1e-5)


def test_gradients_are_those_of_finite_differences(pixels, waves):
    x, y = pixels(4, 5)
    first = waves(x, y, 1.0, 3.0).requires_grad_()
    then = (waves(x, y, 0.2, 3.0) + 0.4).requires_grad_()
    assert torch.autograd.gradcheck(compose_flows, [first, then])


def test_flows_of_different_shapes_raise():
    with pytest.raises(ValueError, match=r"then must have the shape of first, \(1, 2, 4, 5\), got \(1, 2, 5, 4\)"):
        compose_flows(torch.zeros(1, 2, 4, 5), torch.zeros(1, 2, 5, 4))


@pytest.mark.parametrize(("first", "then", "name"), [((2, 4, 5), (1, 2, 4, 5), "first"), ((1, 2, 4), (4,), "first")])
def test_what_is_no_flow_raises(first, then, name):
    with pytest.raises(ValueError, match=rf"{name} must have shape \(B, 2, H, W\)"):
        compose_flows(torch.zeros(first), torch.zeros(then))
