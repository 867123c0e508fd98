import pytest
import torch
from scipy.interpolate import RBFInterpolator
from torch.testing import assert_close

from torchrefract import ThinPlateParams, ThinPlateSpline


def spline_params(points: torch.Tensor, displacement: torch.Tensor, smoothing: float = 0.0) -> ThinPlateParams:
    applied = torch.ones(len(points), dtype=torch.bool)
    return ThinPlateParams(applied, points, displacement, torch.full((len(points),), smoothing, dtype=points.dtype))


def test_drawn_splines_have_a_lattice_of_points_and_normal_displacements():
    effect = ThinPlateSpline(amplitude_range=(3.0, 3.0), lattice=(3, 5))
    params = effect.sample(torch.zeros(400, 1, 21, 41), seed=1)
    expected = torch.cartesian_prod(torch.linspace(0, 20, 3), torch.linspace(0, 40, 5)).flip(1)
    assert_close(params.points, expected.expand(400, -1, -1))
    assert params.displacement.std().item() == pytest.approx(3, rel=0.02)
    assert params.displacement.mean().abs() < 0.06
    sides = torch.corrcoef(params.displacement.flatten(0, 1).T)
    assert sides[0, 1].abs() < 0.04


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_nine_hundred_points_give_the_flow_of_scipys_spline(dtype):
    effect, image = ThinPlateSpline(lattice=(30, 30), tolerance_px=None), torch.zeros(1, 1, 90, 160, dtype=dtype)
    degraded = effect.degrade(image, seed=1)
    points, displacement = (degraded.params[i][0].double().numpy() for i in (1, 2))
    x, y = torch.arange(0, 160, 7), torch.arange(0, 90, 5)
    at = torch.cartesian_prod(x, y)
    expected = RBFInterpolator(points, displacement, kernel="thin_plate_spline")(at.double().numpy())
    displacement = degraded.flow[0, :, at[:, 1], at[:, 0]].T.double()
    assert (displacement - torch.from_numpy(expected)).abs().max() < (1e-3 if dtype == torch.float32 else 1e-6)


def test_control_points_on_pixels_have_finite_gradients():
    points = torch.tensor([[[0.0, 0.0], [11.0, 0.0], [0.0, 7.0], [11.0, 7.0], [5.0, 3.0], [6.0, 3.0]]])
    displacement = torch.full_like(points, 0.3).mul(torch.arange(6.0).view(1, 6, 1))
    params = spline_params(points, displacement)
    inputs = [params.points.requires_grad_(), params.displacement.requires_grad_(), params.smoothing.requires_grad_()]
    degraded = ThinPlateSpline().apply(torch.rand(1, 1, 8, 12), params)
    loss = degraded.image.square().sum() + degraded.restore_flow.square().sum()
    for gradient in torch.autograd.grad(loss, inputs):
        assert gradient.isfinite().all()
        assert gradient.any()


@pytest.mark.parametrize("points", ["of another frame", "one moved"])
def test_splines_that_cannot_be_drawn_for_a_frame_are_exact(points):
    effect, image = ThinPlateSpline(), torch.rand(1, 1, 180, 320)
    params = effect.sample(image, seed=3)
    assert effect.for_params(params, 180, 320) is effect
    assert effect.for_params(params.to(torch.float64), 180, 320) is effect
    if points == "of another frame":
        params = effect.sample(image[..., :60, :80], seed=3)
    else:
        params = params._replace(points=params.points + torch.eye(16)[:, 5:6])
    assert torch.equal(effect.apply(image, params).flow, effect.exact().apply(image, params).flow)


def test_parameters_with_gradients_work_without_grad_mode():
    effect, image = ThinPlateSpline(), torch.rand(2, 3, 120, 200, dtype=torch.float64)
    params = effect.sample(image, seed=1)
    trainable = type(params)(*(value.clone().requires_grad_(value.is_floating_point()) for value in params))
    with torch.no_grad():
        degraded = effect.apply(image, trainable)
    assert torch.equal(degraded.image, effect.apply(image, params).image)
    effect.apply(image, trainable).image.sum().backward()
    assert trainable.displacement.grad.abs().max() > 0
