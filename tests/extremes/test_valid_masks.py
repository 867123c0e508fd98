"""Valid pixels of a result fulfill its equations, computed by NumPy in double precision, for all valid arguments."""

import numpy as np
import pytest
import torch
from domain import IGNORE_STRENGTH, cases
from hypothesis import given
from hypothesis import strategies as st
from numpy_lens import NumpyLens, to_numpy

FLOATS = (torch.float32, torch.float64)
BOUND_PX = 0.05  # of `invert_flow`
pytestmark = [IGNORE_STRENGTH, pytest.mark.usefixtures("small_domains")]


def bilinear(flow: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Sample a flow (2, H, W) at points (n,), clamped to the frame -> (2, n)."""
    height, width = flow.shape[1:]
    x, y = x.clip(0, width - 1), y.clip(0, height - 1)
    left, top = np.floor(x).astype(int), np.floor(y).astype(int)
    right, bottom = np.minimum(left + 1, width - 1), np.minimum(top + 1, height - 1)
    s, t = x - left, y - top
    above = flow[:, top, left] * (1 - s) + flow[:, top, right] * s
    return above * (1 - t) + (flow[:, bottom, left] * (1 - s) + flow[:, bottom, right] * s) * t


@pytest.mark.parametrize("name", ["turbulence", "thin-plate spline", "divergence-free"])
@given(data=st.data())
def test_a_valid_restore_flow_undoes_the_flow(name, data):
    effect, image = data.draw(cases(name, dtypes=FLOATS, side=40))
    degraded = effect.degrade(image, seed=7)
    for flow, inverse, valid, restore_valid in zip(
        to_numpy(degraded.flow), to_numpy(degraded.restore_flow), degraded.valid, degraded.restore_valid, strict=True
    ):
        height, width = flow.shape[1:]
        y, x = np.nonzero(valid[0].numpy())
        position = np.stack([x, y]) + flow[:, y, x]
        assert (position >= -1e-3 - 1e-5).all()
        assert (position <= np.array([[width - 1], [height - 1]]) + 1e-3 + 1e-5).all()
        y, x = np.nonzero(restore_valid[0].numpy())
        u, v = inverse[:, y, x]
        residual = np.hypot(*(inverse[:, y, x] + bilinear(flow, x + u, y + v)))
        # The flow may change by thousands of pixels from one pixel to the next, which multiplies rounding.
        assert (residual <= BOUND_PX + 1e-5 * np.ptp(flow)).all()


@given(data=st.data())
def test_valid_flows_of_a_lens_follow_its_polynomial(data):
    effect, image = data.draw(cases("lens", dtypes=FLOATS, side=40))
    tolerance = effect.tolerance_px or 0.0
    degraded = effect.degrade(image, seed=7)
    if image.shape[2:] == (1, 1):  # warps move nothing
        assert not degraded.flow.any()
        assert not degraded.restore_flow.any()
        return
    for i in range(len(image)):
        lens = NumpyLens(degraded.params, i, *image.shape[2:])
        both = (degraded.flow, degraded.valid, False), (degraded.restore_flow, degraded.restore_valid, True)
        for flow, mask, is_restore in both:
            y, x = np.nonzero(mask[i, 0].numpy())
            shift = to_numpy(flow[i])[:, y, x]
            pixel = np.stack([x, y]).astype(float)
            # The polynomial maps the clean pixel to the distorted one; the flow starts at the distorted one, the
            # restore flow at the clean one.
            clean, distorted = (pixel, pixel + shift) if is_restore else (pixel + shift, pixel)
            ray = (clean - lens.clean_center) / lens.clean_focal
            error = lens.distorted(*ray) * lens.focal + lens.center - distorted
            jacobian = lens.jacobian(*ray)
            determinant = jacobian[0, 0] * jacobian[1, 1] - jacobian[0, 1] * jacobian[1, 0]
            rounding = 1e-5 * (lens.focal.max() * lens.magnitude(*ray) + np.abs(pixel).max(initial=1.0))
            assert (determinant > -1e-3 * np.abs(jacobian).max(initial=1.0) ** 2).all()
            stretch = np.abs(jacobian).max(axis=(0, 1), initial=1.0)
            stretch = stretch * (lens.focal / lens.clean_focal).max()
            assert (np.abs(error) <= 2e-3 + (2 * tolerance + 1e-5) * stretch + rounding).all()


@pytest.mark.parametrize("name", ["uniform fog", "heterogeneous fog", "flare"])
@given(data=st.data())
def test_the_clean_image_is_recovered_from_valid_pixels(name, data):
    fixed = {"blend": "add"} if name == "flare" else {"linear_light": False}
    effect, image = data.draw(cases(name, dtypes=FLOATS, fixed=fixed))
    degraded = effect.degrade(image, seed=7)
    valid = np.broadcast_to(degraded.valid.numpy(), image.shape)
    corrupted, tolerance = to_numpy(degraded.image), 1e-6 + (effect.tolerance or 0.0) / 255
    if name == "flare":
        recovered = corrupted - to_numpy(degraded.intensity) * to_numpy(degraded.params.color)[:, :, None, None]
        assert (np.abs(recovered - to_numpy(image))[valid] <= 2 * tolerance).all()
        return
    t, airlight = to_numpy(degraded.transmission), to_numpy(degraded.params.airlight)[:, :, None, None]
    assert (t[degraded.valid.numpy()] >= 1 / 255 - 1e-6).all()
    with np.errstate(divide="ignore", invalid="ignore"):  # division by a transmission of 0
        error = np.abs((corrupted - airlight * (1 - t)) / t - to_numpy(image)) * t
    assert (error[valid] <= 2 * tolerance).all()
