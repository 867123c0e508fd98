import math

import pytest
import SimpleITK
import torch
from scipy import ndimage
from torch import Tensor
from torch.testing import assert_close

from torchrefract import invert_flow
from torchrefract.warping.grid import inside

SIZE = (80, 110)


def sample_by_scipy(flow: Tensor, at: Tensor) -> Tensor:
    """Sample a flow (1, 2, H, W) bilinearly at p + at(p)."""
    y, x = torch.meshgrid(*(torch.arange(n).double() for n in flow.shape[2:]), indexing="ij")
    positions = [(y + at[0, 1]).numpy(), (x + at[0, 0]).numpy()]
    planes = [ndimage.map_coordinates(plane.numpy(), positions, order=1, mode="nearest") for plane in flow[0]]
    return torch.stack([torch.from_numpy(plane) for plane in planes])[None]


def solve_waves(waves, x: Tensor, y: Tensor, amplitude_px: float, length: float) -> Tensor:
    """Solve v(q) + u(q + v) = 0 for the analytic flow u by 60 Newton steps in float64."""

    def u(at: Tensor) -> Tensor:
        return waves(at[0], at[1], amplitude_px, length)[0]

    q, step = torch.stack([x, y]), 1e-4
    at = q
    for _ in range(60):
        moved = [at + step * direction.view(2, 1, 1) for direction in torch.eye(2, dtype=torch.float64)]
        (a, c), (b, d) = [(u(plus) + plus - u(2 * at - plus) - 2 * at + plus) / (2 * step) for plus in moved]
        e, f = at - q + u(at)
        at = at - torch.stack([d * e - b * f, a * f - c * e]) / (a * d - b * c)
    assert (at - q + u(at)).abs().max() < 1e-12
    return (at - q)[None]


@pytest.mark.parametrize(("amplitude_px", "length"), [(5.0, 40.0), (4.0, 20.0), (1.0, 8.0), (0.02, 60.0)])
def test_the_inverse_of_a_wave_is_the_analytic_one_up_to_interpolation(pixels, waves, amplitude_px, length, oracle):
    x, y = pixels(*SIZE)
    flow = waves(x, y, amplitude_px, length)
    inverse, valid, _ = invert_flow(flow, steps=20)
    exact = solve_waves(waves, x, y, amplitude_px, length)
    # Sampled bilinearly u is off by amplitude / (4 length^2), which the inverse passes on times 1 / (1 - slope).
    slope = 2**0.5 * amplitude_px / length
    floor = amplitude_px / (4 * length**2) / (1 - slope)
    assert valid.float().mean() > 0.75
    assert (inverse - exact).norm(dim=1, keepdim=True)[valid].max() <= 2**0.5 * floor
    if length == 60.0:
        assert floor < 1.5e-6
        inside = valid.expand_as(exact)
        oracle("inverse of a weak wave, 60 Newton steps", inverse[inside], exact[inside], 1e-6)


@pytest.mark.quick
def test_an_affine_flow_is_inverted_exactly(pixels):
    x, y = pixels(*SIZE)
    matrix = torch.tensor([[0.1, -0.2], [0.15, -0.05]], dtype=torch.float64)
    shift = torch.tensor([-6.0, 3.0], dtype=torch.float64).view(2, 1, 1)
    p = torch.stack([x, y])
    flow = torch.einsum("ij,jhw->ihw", matrix, p) + shift
    inverse, valid, residual = invert_flow(flow[None])
    # p + A p + b = q has p = (I + A)^-1 (q - b).
    exact = torch.einsum("ij,jhw->ihw", torch.linalg.inv(torch.eye(2) + matrix), p - shift) - p
    expected = inside(exact[None])
    assert torch.equal(valid, expected)
    assert 0.5 < expected.double().mean() < 1
    assert_close(inverse.where(valid, 0), exact[None].where(valid, 0), rtol=0, atol=1e-9)
    assert residual[valid].max() < 1e-9


def test_the_residual_is_the_length_of_inverse_plus_flow(pixels, waves):
    flow = waves(*pixels(*SIZE), 4.0, 20.0)
    inverse, valid, residual = invert_flow(flow, steps=2)
    expected = (inverse + sample_by_scipy(flow, inverse)).norm(dim=1, keepdim=True)
    assert_close(residual, expected, rtol=0, atol=1e-10)
    inverse, valid, residual = invert_flow(flow, steps=20)
    assert residual[valid].max() < 1e-6


def test_a_pixel_is_valid_if_its_residual_is_within_the_tolerance(pixels, waves):
    flow = waves(*pixels(*SIZE), 8.0, 12.0)
    _, loose, residual = invert_flow(flow, steps=1, tolerance_px=1.0)
    _, tight, _ = invert_flow(flow, steps=1, tolerance_px=1e-3)
    assert torch.equal(tight, loose & (residual <= 1e-3))
    assert tight.sum() < loose.sum()


def test_pixels_whose_inverse_leaves_the_frame_are_not_valid():
    flow = torch.zeros(1, 2, 8, 12, dtype=torch.float64)
    flow[:, 0] = 3.0
    inverse, valid, _ = invert_flow(flow)
    expected = torch.ones(1, 1, 8, 12, dtype=torch.bool)
    expected[..., :3] = False  # q - 3 is off the frame
    assert torch.equal(valid, expected)
    assert torch.equal(inverse.where(valid, -flow), -flow)


def test_mirrored_and_collapsed_maps_are_not_valid(pixels):
    x, y = pixels(9, 11)
    mirror = torch.stack([-2 * (x - 5), 0 * y])[None]
    collapse = torch.stack([5.5 - x, 4.5 - y])[None]
    for flow in (mirror, collapse):
        inverse, valid, residual = invert_flow(flow, steps=20)
        assert not valid.any()
        assert inverse.isfinite().all()
        assert residual.isfinite().all()


def test_valid_pixels_of_a_folding_map_have_a_positive_determinant(pixels):
    x, y = pixels(40, 200)
    length = 8.0
    flow = torch.stack([-1.5 * length * torch.sin(x / length), 0 * y])[None]
    inverse, valid, _ = invert_flow(flow, steps=40)
    stretch = 1 - 1.5 * torch.cos((x + inverse[0, 0]) / length)
    # Central differences, one pixel long, do not resolve the very edge of a fold.
    assert (stretch[valid[0, 0]] > -2 / length).all()
    assert_close(inverse.where(valid, 0), -sample_by_scipy(flow, inverse).where(valid, 0), rtol=0, atol=0.05)
    assert 0.1 < valid.double().mean() < 1
    assert inverse.isfinite().all()


@pytest.mark.parametrize("amplitude_px", [1e3, 1e6, 1e9, 1e11, 9e11])
def test_inverse_and_residual_of_huge_flows_are_finite(amplitude_px):
    source = torch.Generator().manual_seed(0)
    spikes = torch.rand(40, 1, 23, 31, generator=source) < 0.2  # next to which the map turns over
    noise = torch.randn(40, 2, 23, 31, generator=source).clamp(-1, 1)
    inverse, _, residual = invert_flow(amplitude_px * noise * spikes)
    assert inverse.isfinite().all()
    assert residual.isfinite().all()


@pytest.mark.parametrize("way", ["vmap", "compile"])
def test_vmap_and_compiled_graphs_give_the_same_inverse(pixels, waves, way):
    flow = torch.cat([waves(*pixels(48, 64), amplitude_px, 12.0) for amplitude_px in (0.5, 3.0, 8.0)]).float()
    expected, valid, _ = invert_flow(flow, steps=4)
    if way == "vmap":
        result, result_valid, _ = torch.vmap(
            lambda sample: tuple(value[0] for value in invert_flow(sample[None], steps=4))
        )(flow)
    else:
        result, result_valid, _ = torch.compile(invert_flow, fullgraph=True, backend="eager")(flow, steps=4)
    both = valid & result_valid
    # The last flow folds, and either solver may find another solution there.
    assert torch.equal(valid[:2], result_valid[:2])
    assert both.sum() > 0.99 * valid.sum()
    # A residual of 1/1000 px at most in either, which a slope of 1/4 along an axis passes on by a third more.
    assert (result - expected).norm(dim=1, keepdim=True)[:2][both[:2]].max() <= 2 * 1e-3 / (1 - 0.25)


@pytest.mark.parametrize(
    ("options", "rule"),
    [({"steps": 0}, "steps must be at least 1"), ({"tolerance_px": 0.0}, "tolerance_px must be above 0")],
)
def test_options_out_of_range_raise(options, rule):
    with pytest.raises(ValueError, match=rule):
        invert_flow(torch.zeros(1, 2, 5, 6), **options)


def test_flows_of_another_shape_raise():
    with pytest.raises(ValueError, match=r"flow must have shape \(B, 2, H, W\)"):
        invert_flow(torch.zeros(1, 3, 5, 6))


@pytest.mark.parametrize(("amplitude_px", "length"), [(4.0, 20.0), (3.0, 12.0)])
def test_the_inverse_agrees_with_simpleitk(pixels, waves, amplitude_px, length, oracle):
    x, y = pixels(*SIZE)
    flow = waves(x, y, amplitude_px, length)
    field = SimpleITK.GetImageFromArray(flow[0].movedim(0, -1).numpy(), isVector=True)
    # The defaults stop at a tenth of a pixel.
    inverted = SimpleITK.InvertDisplacementField(
        field, maximumNumberOfIterations=200, maxErrorToleranceThreshold=1e-5, meanErrorToleranceThreshold=1e-6
    )
    expected = torch.from_numpy(SimpleITK.GetArrayFromImage(inverted)).movedim(-1, 0)[None]
    inverse, valid, _ = invert_flow(flow)
    # SimpleITK keeps the border fixed, which affects pixels within the largest displacement.
    margin = 2 * math.ceil(amplitude_px) + 2
    inner = torch.zeros_like(valid)
    inner[..., margin:-margin, margin:-margin] = True
    at = (valid & inner).expand_as(inverse)
    oracle("inverse, SimpleITK", inverse[at], expected[at], 1e-2)
    assert (valid & inner).double().mean() > 0.5
    assert (expected + flow).abs().max() > 0.5  # the inverse is not just -flow
