from itertools import pairwise

import cv2
import numpy as np
import pytest
import torch
import torch.nn.functional as F
from torch import Tensor
from torch.testing import assert_close

from torchrefract import compose_flows, folding, jacobian_determinant, warp
from torchrefract.warping.flow import Jacobian, is_shown_once, resize_flow, resize_image
from torchrefract.warping.grid import inside
from torchrefract.warping.invert import invert_flow

SIZE = (90, 120)


def test_the_composed_flow_is_the_analytic_one(pixels, waves):
    x, y = pixels(*SIZE)
    then = waves(x, y, 3.0, 25.0, phase=1.1)
    first = waves(x, y, 5.0, 40.0)
    expected = then + waves(x + then[0, 0], y + then[0, 1], 5.0, 40.0)
    error = (compose_flows(first, then) - expected).abs().amax(dim=1, keepdim=True)[inside(then)]
    # Bilinear interpolation of one wave errs by at most (|f_xx| + |f_yy|) / 8.
    assert error.max() <= 2 * 5.0 / 40.0**2 / 8
    assert error.max() <= 2e-3


@pytest.mark.parametrize("size", [(1, 1), (1, 9), (7, 1), (90, 120)])
def test_one_warp_of_a_ramp_is_two_exactly(pixels, waves, size):
    # Bilinear sampling of a ramp is exact, so any difference is an error of the composition.
    x, y = pixels(*size)
    ramp = torch.stack([x, y])[None]
    first, then = waves(x, y, 5.0, 40.0), waves(x, y, 3.0, 25.0, phase=1.1)
    once, seen_once = warp(ramp, first, padding="border")
    twice, seen_twice = warp(once, then, padding="border")
    composed = compose_flows(first, then)
    direct, seen = warp(ramp, composed, padding="border")
    # The second warp may mix only pixels that were valid in the first.
    is_valid = seen & seen_twice & (warp(seen_once.double(), then)[0] == 1)
    assert is_valid.any() or min(size) == 1
    assert_close(direct.where(is_valid, 0), twice.where(is_valid, 0), rtol=0, atol=1e-10)


@pytest.mark.parametrize(
    ("first", "then", "result"),
    [
        (torch.float32, torch.float32, torch.float32),
        (torch.float16, torch.bfloat16, torch.float32),
        (torch.float32, torch.float64, torch.float64),
    ],
)
def test_a_composed_flow_has_the_finer_type_and_is_never_half(pixels, waves, first, then, result):
    flow = waves(*pixels(8, 9), 1.0, 5.0)
    composed = compose_flows(flow.to(first), flow.to(then))
    exact = compose_flows(flow.to(first).double(), flow.to(then).double())
    assert composed.dtype == result
    assert_close(composed.double(), exact, rtol=0, atol=1e-5)


def test_gradients_of_composed_flows_are_those_of_finite_differences(pixels, waves):
    x, y = pixels(4, 5)
    first = waves(x, y, 1.0, 3.0).requires_grad_()
    then = (waves(x, y, 0.2, 3.0) + 0.4).requires_grad_()
    assert torch.autograd.gradcheck(compose_flows, [first, then])


def test_composing_flows_of_different_shapes_raises():
    with pytest.raises(ValueError, match=r"then must have the shape of first, \(1, 2, 4, 5\), got \(1, 2, 5, 4\)"):
        compose_flows(torch.zeros(1, 2, 4, 5), torch.zeros(1, 2, 5, 4))
    with pytest.raises(ValueError, match=r"first must have shape \(B, 2, H, W\)"):
        compose_flows(torch.zeros(2, 4, 5), torch.zeros(1, 2, 4, 5))


def test_an_affine_map_has_one_determinant(pixels):
    x, y = pixels(6, 7)
    matrices = torch.tensor([[[0.2, -0.3], [0.1, 0.4]], [[-2.0, 0.0], [0.0, 0.0]], [[-1.0, 1.0], [-1.0, -1.0]]])
    flow = torch.einsum("bij,jhw->bihw", matrices.double(), torch.stack([x, y])) + 3
    expected = torch.linalg.det(torch.eye(2) + matrices).double()  # pyright: ignore[reportCallIssue]  # missing in torch's annotations
    assert_close(jacobian_determinant(flow), expected.view(3, 1, 1, 1).expand(-1, -1, 6, 7), rtol=0, atol=1e-6)
    folds, least = folding(flow)
    assert_close(least, expected, rtol=0, atol=1e-6)
    assert folds.tolist() == [0, 1, 0]


def test_the_determinant_is_the_smallest_area_of_the_quadrilaterals_around_a_pixel():
    generator = torch.Generator().manual_seed(0)
    flow = 0.6 * torch.randn(2, 2, 12, 15, generator=generator, dtype=torch.float64)
    rows, columns = torch.meshgrid(torch.arange(12.0), torch.arange(15.0), indexing="ij")
    points = flow + torch.stack([columns, rows])
    # Each corner of a quadrilateral cell has twice the signed area of a triangle.
    a, b = points[..., :-1, :-1], points[..., :-1, 1:]
    d, c = points[..., 1:, :-1], points[..., 1:, 1:]
    least = torch.full((2, 12, 15), torch.inf, dtype=torch.float64)
    for (i, j), (before, corner, after) in {
        (0, 0): (d, a, b),
        (0, 1): (a, b, c),
        (1, 1): (b, c, d),
        (1, 0): (c, d, a),
    }.items():
        e, f = corner - before, after - corner
        area = e[:, 0] * f[:, 1] - e[:, 1] * f[:, 0]
        view = least[:, i : i + 11, j : j + 14]
        view.copy_(torch.minimum(view, area))
    assert_close(jacobian_determinant(flow)[:, 0], least, rtol=0, atol=1e-12)
    assert torch.equal(folding(flow).fraction, (least <= 0).double().mean(dim=(1, 2)))
    assert 0 < folding(flow).fraction[0] < 1


@pytest.mark.parametrize("size", [(1, 6), (6, 1), (1, 1)])
def test_the_determinant_of_one_row_or_column_is_its_stretch(pixels, size):
    x, y = pixels(*size)
    flow = torch.stack([0.5 * x, 0.25 * y])[None]
    expected = 1 + (0.5 if size[1] > 1 else 0) + (0.25 if size[0] > 1 else 0)
    assert torch.equal(jacobian_determinant(flow), torch.full((1, 1, *size), expected).double())


def test_gradients_of_the_determinant_are_those_of_finite_differences():
    generator = torch.Generator().manual_seed(1)
    flow = torch.randn(1, 2, 4, 5, generator=generator, dtype=torch.float64).requires_grad_()
    assert torch.autograd.gradcheck(jacobian_determinant, [flow])


@pytest.mark.quick
@pytest.mark.parametrize("valid", [torch.ones(2, 1, 4, 5), torch.ones(4, 5).bool(), torch.ones(2, 1, 3, 5).bool()])
def test_a_mask_of_another_shape_or_type_than_that_of_the_flow_raises(valid):
    with pytest.raises(ValueError, match=r"valid must be bool of shape \(2, 1, 4, 5\), as the flow, got "):
        folding(torch.zeros(2, 2, 4, 5), valid)


def test_folding_of_another_shape_raises():
    with pytest.raises(ValueError, match=r"flow must have shape \(B, 2, H, W\)"):
        folding(torch.zeros(2, 4, 5))


RESIZED = [(1, 1), (7, 9), (20, 24), (57, 61), (20, 5)]


def lines(x: Tensor, y: Tensor) -> Tensor:
    """Return a flow (1, 2, H, W), px of a frame of 20 x 24, that is linear in x and y."""
    return torch.stack([0.3 * x - 0.2 * y + 1, 0.1 * x + 0.5 * y - 2])[None]


@pytest.mark.parametrize("size", RESIZED)
def test_a_linear_flow_is_resized_exactly(pixels, oracle, size):
    x, y = pixels(*size)
    # Pixel centers lie at the same fraction of the frame in both sizes.
    expected = lines((x + 0.5) * 24 / size[1] - 0.5, (y + 0.5) * 20 / size[0] - 0.5)
    expected *= torch.tensor([size[1] / 24, size[0] / 20], dtype=torch.float64).view(1, 2, 1, 1)
    oracle("resized flow, lines", resize_flow(lines(*pixels(20, 24)), size), expected, 1e-12)


def test_resizing_to_the_same_size_keeps_the_flow(waves, pixels):
    flow = waves(*pixels(13, 17), 3.0, 4.0).float()
    assert torch.equal(resize_flow(flow, (13, 17)), flow)


def test_resized_flows_agree_with_the_cubics_of_torch(waves, pixels, oracle):
    flow = waves(*pixels(20, 24), 3.0, 4.0)
    # With antialias torch enlarges with a = -1/2; it treats the border differently.
    expected = F.interpolate(flow, (57, 61), mode="bicubic", antialias=True)
    expected *= torch.tensor([61 / 24, 57 / 20], dtype=torch.float64).view(1, 2, 1, 1)
    inner = (..., slice(9, -9), slice(9, -9))
    oracle("resized flow, torch's cubics", resize_flow(flow, (57, 61))[inner], expected[inner], 1e-12)


def test_gradients_of_resized_flows_are_those_of_finite_differences(waves, pixels):
    flow = waves(*pixels(4, 5), 1.0, 2.0).requires_grad_()
    assert torch.autograd.gradcheck(lambda value: resize_flow(value, (6, 3)), (flow,))


@pytest.mark.parametrize("size", [(1, 1), (13, 20), (61, 9)])
def test_a_smaller_image_is_the_area_mean_of_opencv(oracle, size):
    image = torch.rand(2, 3, 61, 47, generator=torch.Generator().manual_seed(0))
    arrays = [sample.permute(1, 2, 0).numpy() for sample in image]
    small = [cv2.resize(array, (size[1], size[0]), interpolation=cv2.INTER_AREA) for array in arrays]
    expected = torch.from_numpy(np.stack(small)).permute(0, 3, 1, 2)
    oracle("smaller image, OpenCV", resize_image(image, size), expected, 1e-5, unit="")


def test_a_larger_image_keeps_the_range_of_its_values():
    image = (torch.rand(1, 3, 8, 9, generator=torch.Generator().manual_seed(0)) > 0.5).float()
    large = resize_image(image, (40, 30))
    assert (large.min(), large.max()) == (0, 1)
    assert torch.equal(resize_image(image, (8, 9)), image)


@pytest.mark.parametrize("size", [(0, 4), (4, -1)])
def test_sizes_below_one_pixel_raise(size):
    with pytest.raises(ValueError, match="size must be at least 1, got"):
        resize_flow(torch.zeros(1, 2, 4, 4), size)
    with pytest.raises(ValueError, match="size must be at least 1, got"):
        resize_image(torch.zeros(1, 3, 4, 4), size)


def test_resizing_an_image_of_another_shape_raises():
    with pytest.raises(ValueError, match=r"image must be \(B, C, H, W\) of floats, got \(3, 4, 4\) of torch.float32"):
        resize_image(torch.zeros(3, 4, 4), (2, 2))


@pytest.mark.quick
def test_jacobians_multiply_and_solve_like_matrices():
    generator = torch.Generator().manual_seed(0)
    first, second = (torch.eye(2) + 0.3 * torch.rand(2, 2, 2, 5, generator=generator)[i].movedim(-1, 0) for i in (0, 1))
    a, b = (Jacobian(*matrix.flatten(1).unbind(1)) for matrix in (first, second))
    assert_close(torch.stack(b.after(a), dim=1), (second @ first).flatten(1))
    assert_close(a.determinant, torch.linalg.det(first))
    right = torch.rand(5, 2, generator=generator)
    assert_close(torch.stack(a.solve(*right.unbind(1)), dim=1), torch.linalg.solve(first, right))


@pytest.mark.quick
def test_pixels_that_a_fold_shows_several_times_are_not_shown_once():
    x = torch.arange(200, dtype=torch.float64)
    # x + 20 sin(x / 10) goes back between the pixels 21 and 42, from 39 to 24.
    u = (20 * torch.sin(x / 10)).expand(1, 1, 30, 200)
    flow = torch.cat([u, torch.zeros_like(u)], dim=1)
    once = is_shown_once(flow, *invert_flow(flow)[:2])[0, 0]
    positions = x + u[0, 0, 0]
    counts = torch.zeros(200)
    for low, high in pairwise(positions.tolist()):
        counts += (x >= min(low, high)) & (x < max(low, high))
    assert (counts > 1).any()
    assert not once[:, counts > 1].any()
    # A slope of 1 + 2 cos(x / 10) keeps ||J^-1|| below 4 where it is above 0.26.
    is_gentle = 1 + 2 * torch.cos(x / 10) > 0.4
    solved = positions[is_gentle].round().long().unique()
    solved = solved[(solved > 0) & (solved < 199) & (counts[solved.clamp(0, 199)] == 1)]
    assert once[:, solved].float().mean() > 0.8


def test_a_flow_that_shrinks_little_is_shown_once_everywhere():
    x = torch.arange(40, dtype=torch.float64).expand(1, 1, 30, 40)
    flow = torch.cat([-0.7 * x, torch.zeros_like(x)], dim=1)
    assert is_shown_once(flow, *invert_flow(flow)[:2]).all()
    assert not is_shown_once(flow * 1.2, *invert_flow(flow * 1.2)[:2])[..., :6].any()
    nothing = torch.zeros(1, 1, 30, 40, dtype=torch.bool)
    assert is_shown_once(flow * 1.2, flow, nothing, nothing).all()


@pytest.mark.quick
def test_pixels_that_a_flow_without_a_fold_shows_twice_are_not_shown_once(pixels):
    # A column becomes a circle around the middle, run through 1.25 times: the first quarter is shown twice.
    x, y = pixels(100, 100)
    radius, angle = 8 + 0.4 * x, 2.5 * torch.pi * y / 99
    flow = torch.stack([50 + radius * angle.cos() - x, 50 + radius * angle.sin() - y])[None]
    assert folding(flow).min_determinant > 0.1
    inverse, exists, _ = invert_flow(flow, steps=50)
    once = is_shown_once(flow, inverse, exists)[0, 0]
    radius, angle = torch.hypot(x - 50, y - 50), torch.atan2(y - 50, x - 50) % (2 * torch.pi)
    is_in_ring = (radius > 9) & (radius < 46)
    assert not once[is_in_ring & exists[0, 0] & (angle < torch.pi / 2)].any()
    assert once[is_in_ring & exists[0, 0] & (angle > 2) & (angle < 5.9)].float().mean() > 0.95
