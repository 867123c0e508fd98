import dataclasses
from typing import Any

import numpy as np
import pytest
import torch
from numpy_lens import NumpyLens
from torch import Tensor
from torch.testing import assert_close

from torchrefract import LensDistortion, OneOf, Rectification, presets, warp_points
from torchrefract.cameras import Camera
from torchrefract.cameras.brown_conrady import POLYNOMIAL12

DECENTERED: dict[str, Any] = {
    "center_x_range": (-0.15, 0.15),
    "center_y_range": (-0.1, 0.1),
    "p1_range": (-0.01, 0.01),
    "p2_range": (-0.01, 0.01),
}


def pixels(height: int, width: int) -> np.ndarray:
    """Return x and y of all pixels, (2, n)."""
    return np.stack(np.meshgrid(np.arange(width), np.arange(height))).reshape(2, -1).astype(float)


def at_least(value: Tensor | None) -> Tensor:
    assert value is not None
    return value


@pytest.mark.parametrize("severity", presets.SEVERITIES)
def test_no_pixel_of_10000_drawn_lenses_is_without_a_source(severity):
    d = presets.cheap_dashcam(severity).degrade(torch.zeros(2000, 1, 27, 48), seed=severity)
    assert d.valid.all()
    assert d.params.zoom.max() <= 1


@pytest.mark.parametrize("arguments", [{}, DECENTERED], ids=["default", "decentered"])
def test_the_zoom_is_the_largest_that_fits_every_pixel(arguments):
    height, width = 72, 128
    params = LensDistortion(**arguments).sample(torch.zeros(20, 1, height, width), seed=2)
    for i in range(20):
        reached = NumpyLens(params, i, height, width).source(pixels(height, width))
        gaps = [reached.min(axis=1), np.array([width, height]) - 1 - reached.max(axis=1)]
        assert np.min(gaps) >= 0
        # Along one axis the view reaches both borders, or the frame would be seen larger; the margin is 1/16 px, and
        # fitting the corners of the pixels takes up to half a pixel more.
        assert (gaps[0] + gaps[1]).min() < 0.125 + 1.0


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_both_flows_agree_with_an_independent_lens_in_float64(dtype):
    height, width = 72, 128
    effect = LensDistortion(**DECENTERED, s1_range=(-0.01, 0.01), tolerance_px=None)
    d = effect.degrade(torch.zeros(6, 1, height, width, dtype=dtype), seed=3)
    limit = 2e-3 if dtype is torch.float32 else 1e-7
    grid = pixels(height, width)
    for i in range(6):
        lens = NumpyLens(d.params, i, height, width)
        flow, restore = (value[i].flatten(1).numpy() for value in (d.flow, d.restore_flow))
        assert np.abs(grid + flow - lens.source(grid)).max() < limit
        valid = d.restore_valid[i].flatten().numpy()
        assert valid.mean() > 0.4
        assert np.abs(grid + restore - lens.target(grid))[:, valid].max() < limit


def test_planned_flows_of_filled_frames_are_within_the_tolerance():
    for severity in (1, 5):
        effect = presets.cheap_dashcam(severity)
        image = torch.zeros(3, 1, 270, 480)
        planned, exact = effect.degrade(image, seed=4), effect.exact().degrade(image.double(), seed=4)
        assert_close(planned.params.zoom, exact.params.zoom.float())
        assert (planned.flow - exact.flow).norm(dim=1).max() <= 0.02


def test_points_move_to_where_the_camera_shows_them():
    height, width = 90, 160
    effect = LensDistortion(**DECENTERED)
    d = effect.degrade(torch.zeros(4, 1, height, width, dtype=torch.float64), seed=5)
    cameras = effect.cameras(d.params, height=height, width=width)
    clean = effect.clean_cameras(d.params, height=height, width=width)
    points = torch.tensor([[[60.0, 40.0], [80.0, 45.0], [100.0, 60.0]]], dtype=torch.float64)
    for i in range(4):
        rays = clean[i].unproject(points[0]).points
        moved, valid = warp_points(points, d.flow[i : i + 1])
        assert valid.all()
        assert (moved[0] - cameras[i].project(rays).points).norm(dim=1).max() < 0.05


def test_pincushion_lenses_need_no_zoom():
    effect = LensDistortion(k1_range=(0.1, 0.3), k2_range=(0.0, 0.0), p1_range=(0.0, 0.0), p2_range=(0.0, 0.0))
    d = effect.degrade(torch.zeros(8, 1, 45, 80), seed=0)
    assert (d.params.zoom == 1).all()
    assert (d.params.shift == 0).all()
    assert d.valid.all()


def test_lenses_that_were_drawn_for_one_size_fill_frames_of_other_sizes():
    effect = LensDistortion(**DECENTERED)
    params = effect.sample(torch.zeros(20, 1, 90, 160), seed=6)
    for size in ((45, 80), (91, 161), (180, 320)):
        assert effect.apply(torch.zeros(20, 1, *size), params).valid.all()


def test_another_zoom_than_that_of_the_plan_is_computed_exactly():
    effect = LensDistortion(tolerance_px=0.5)
    image = torch.zeros(2, 1, 72, 128)
    params = effect.sample(image, seed=0)._replace(zoom=torch.tensor([0.4, 0.3]))
    d, grid = effect.apply(image, params), pixels(72, 128)
    for i in range(2):
        expected = NumpyLens(params, i, 72, 128).source(grid)
        assert np.abs(grid + d.flow[i].flatten(1).numpy() - expected).max() < 2e-3


@pytest.mark.parametrize(("name", "value", "message"), [("zoom", 1.5, "zoom must"), ("zoom", 0.0, "zoom must")])
def test_a_zoom_out_of_range_raises(name, value, message):
    effect = LensDistortion()
    image = torch.rand(1, 1, 12, 20)
    params = effect.sample(image, seed=0)._replace(**{name: torch.tensor([value])})
    with pytest.raises(ValueError, match=message):
        effect.apply(image, params)


def test_scenes_fill_their_frames_but_those_of_the_paper():
    assert presets.cheap_dashcam().frame == "fill"
    effects = presets.paper_refractive().effects
    assert isinstance(presets.paper_refractive(), OneOf)
    assert [effect.frame for effect in effects if isinstance(effect, LensDistortion)] == ["pad"]


def test_padded_frames_keep_the_focal_length():
    effect = LensDistortion(frame="pad")
    params = effect.sample(torch.zeros(3, 1, 45, 80), seed=0)
    filled = LensDistortion().sample(torch.zeros(3, 1, 45, 80), seed=0)
    assert (params.zoom == 1).all()
    assert not params.shift.any()
    assert params.coefficients.equal(filled.coefficients)
    assert not effect.degrade(torch.zeros(3, 1, 45, 80), seed=0).valid.all()


def camera(**coefficients: float) -> Camera:
    row = tuple(coefficients.get(name, 0.0) for name in POLYNOMIAL12)
    return Camera(width=160, height=90, fx=120.0, fy=121.0, cx=76.0, cy=47.0, coefficients=row, model="polynomial12")


@pytest.mark.parametrize(
    "raw",
    [
        camera(k1=0.3, p1=0.01),
        camera(k1=-0.3, k2=0.4, p2=-0.02),
        dataclasses.replace(camera(), coefficients=(0.3, 0.1, 0.0, 0.0), model="fisheye"),
    ],
    ids=["pincushion", "mustache", "fisheye"],
)
def test_a_cropped_rectification_shows_valid_pixels_only_and_as_many_as_it_can(raw):
    image = torch.zeros(1, 1, 90, 160, dtype=torch.float64)
    effect, padded = Rectification(raw, frame="crop"), Rectification(raw)
    d = effect.degrade(image, seed=0)
    assert d.valid.all()
    pinhole = effect.clean_camera(90, 160)
    zoom = pinhole.fx / raw.fx
    assert_close(d.params.zoom, torch.tensor([zoom], dtype=torch.float64))
    if zoom == 1:
        assert padded.degrade(image, seed=0).valid.all()
    else:
        # With 1 % less zoom some pixel looks outside.
        rays = dataclasses.replace(pinhole, fx=0.99 * pinhole.fx, fy=0.99 * pinhole.fy).unproject(pinhole.grid(99))
        shown = raw.project(rays.points)
        outside = (shown.points < 0) | (shown.points > torch.tensor([159.0, 89.0]))
        assert outside.any() or not shown.valid.all()
    # The pixel of a ray in the rectified frame is taken from its pixel in the raw one.
    grid = torch.from_numpy(pixels(90, 160).T)
    expected = raw.project(pinhole.unproject(grid).points)
    assert_close(grid + d.flow[0].flatten(1).T, expected.points, atol=0.02, rtol=0)
    residual = d.restore_residual[d.restore_valid]
    assert residual.max() < 0.2


def test_lenses_outside_the_ranges_fill_their_frames_too():
    effect, wide = LensDistortion(), LensDistortion(k1_range=(-1.5, -1.2), k2_range=(1.0, 1.2), focal_range=(0.6, 0.6))
    image = torch.zeros(4, 1, 45, 80)
    params = wide.sample(image, seed=0)
    with_view = effect.fill(params, 45, 80)
    assert_close(with_view.zoom, params.zoom)
    assert_close(with_view.shift, params.shift)


def test_the_zoom_of_a_lens_next_to_a_fold_does_not_depend_on_its_batch():
    folding = LensDistortion(k2_range=(-3.0, 1.0), p1_range=(-1.0, 0.0))
    image = torch.zeros(12, 1, 9, 16)
    together = folding.sample(image, seed=3)
    for i in range(12):
        alone = folding.sample(image[:1], seed=3, keys=[i])
        assert torch.equal(alone.zoom[0], at_least(together.zoom)[i])
        assert torch.equal(alone.shift[0], at_least(together.shift)[i])


def test_the_zoom_has_the_gradient_of_the_lens():
    effect = LensDistortion(p1_range=(0.0, 0.0), p2_range=(0.0, 0.0))
    params = effect.sample(torch.zeros(3, 1, 60, 90, dtype=torch.float64), seed=1)

    def zoom(coefficients: Tensor, focal: Tensor) -> Tensor:
        filled = effect.fill(params._replace(coefficients=coefficients, focal=focal), 60, 90)
        return torch.ones(3) if filled.zoom is None else filled.zoom

    for name in ("coefficients", "focal"):
        value = getattr(params, name).clone().requires_grad_()
        of = {"coefficients": params.coefficients, "focal": params.focal}
        (gradient,) = torch.autograd.grad(zoom(**of | {name: value}).sum(), value)
        for column in range(3 if name == "coefficients" else 2):
            step = torch.zeros_like(value)
            step[:, column] = 1e-3  # the zoom is rounded to 2^-22
            low, high = (zoom(**of | {name: value.detach() + sign * step}) for sign in (-1, 1))
            assert_close(gradient[:, column], (high - low) / 2e-3, rtol=0, atol=5e-4)
