"""What is marked valid is true, by NumPy in double precision, anywhere in the domain of an effect."""

import numpy as np
import pytest
import torch
from domain import WARNED, cases
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

import torchrefract as tr

FLOATS = (torch.float32, torch.float64)
BOUND_PX = 0.05  # that of invert_flow
pytestmark = [WARNED, pytest.mark.usefixtures("small_tori")]


def doubles(value: Tensor) -> np.ndarray:
    return value.detach().double().numpy()


def bilinear(flow: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """(2, n), a flow (2, H, W) at points (n,), outside the frame as at its border."""
    height, width = flow.shape[1:]
    x, y = x.clip(0, width - 1), y.clip(0, height - 1)
    left, top = np.floor(x).astype(int), np.floor(y).astype(int)
    right, bottom = np.minimum(left + 1, width - 1), np.minimum(top + 1, height - 1)
    s, t = x - left, y - top
    above = flow[:, top, left] * (1 - s) + flow[:, top, right] * s
    return above * (1 - t) + (flow[:, bottom, left] * (1 - s) + flow[:, bottom, right] * s) * t


class Lens:
    """The polynomial of one sample, its slope and what its rounding may be, written out."""

    def __init__(self, params: tr.LensParams, i: int, height: int, width: int):
        self.k, (self.p1, self.p2, *self.s) = np.split(doubles(params.coefficients[i]), [6])
        self.focal = doubles(params.focal[i]) * width
        self.center = (np.array([width, height]) - 1) / 2 + doubles(params.center[i]) * width

    def distorted(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        r2 = x * x + y * y
        g = 1 + sum(k * r2 ** (i + 1) for i, k in enumerate(self.k))
        s1, s2, s3, s4 = self.s
        return np.stack(
            [
                x * g + 2 * self.p1 * x * y + self.p2 * (r2 + 2 * x * x) + s1 * r2 + s2 * r2**2,
                y * g + self.p1 * (r2 + 2 * y * y) + 2 * self.p2 * x * y + s3 * r2 + s4 * r2**2,
            ]
        )

    def size(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Of all terms without their signs: its rounding is so many times epsilon."""
        r = np.hypot(x, y)
        others = sum(np.abs(v) for v in (self.p1, self.p1, self.p1, self.p2, self.p2, self.p2, self.s[0], self.s[2]))
        return (
            r * (1 + sum(abs(k) * r ** (2 * i + 2) for i, k in enumerate(self.k)))
            + others * r**2
            + (abs(self.s[1]) + abs(self.s[3])) * r**4
        )

    def slopes(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """(2, 2, n), by central differences."""
        h = 1e-6 * (1e-3 + np.hypot(x, y))
        along = (self.distorted(x + h, y) - self.distorted(x - h, y)) / (2 * h)
        down = (self.distorted(x, y + h) - self.distorted(x, y - h)) / (2 * h)
        return np.stack([along, down], axis=1)


@pytest.mark.parametrize("name", ["turbulence", "thin plate", "divergence-free"])
@given(data=st.data())
def test_where_a_flow_back_is_valid_it_undoes_the_flow(name, data):
    effect, image = data.draw(cases(name, dtypes=FLOATS, side=40))
    degraded = effect.degrade(image, seed=7)
    for flow, back, valid, sound in zip(
        doubles(degraded.flow), doubles(degraded.restore_flow), degraded.valid, degraded.restore_valid, strict=True
    ):
        height, width = flow.shape[1:]
        y, x = np.nonzero(valid[0].numpy())
        found = np.stack([x, y]) + flow[:, y, x]
        assert (found >= -1e-3 - 1e-5).all()
        assert (found <= np.array([[width - 1], [height - 1]]) + 1e-3 + 1e-5).all()
        y, x = np.nonzero(sound[0].numpy())
        u, v = back[:, y, x]
        missed = np.hypot(*(back[:, y, x] + bilinear(flow, x + u, y + v)))
        # Positions in single precision are read on slopes that may be thousands of pixels each.
        assert (missed <= BOUND_PX + 1e-5 * np.ptp(flow)).all()


@given(data=st.data())
def test_where_a_lens_is_valid_it_shows_the_ray_that_it_says(data):
    effect, image = data.draw(cases("lens", dtypes=FLOATS, side=40))
    tolerance = effect.tolerance_px or 0.0
    degraded = effect.degrade(image, seed=7)
    if image.shape[2:] == (1, 1):  # which warps leave alone
        assert not degraded.flow.any()
        assert not degraded.restore_flow.any()
        return
    for i in range(len(image)):
        lens = Lens(degraded.params, i, *image.shape[2:])
        valid, sound = (mask[i, 0].numpy() for mask in (degraded.valid, degraded.restore_valid))
        for flow, mask, there in ((degraded.flow, valid, False), (degraded.restore_flow, sound, True)):
            y, x = np.nonzero(mask)
            shift = doubles(flow[i])[:, y, x]
            pixel = np.stack([x, y]).astype(float)
            # Undistorted to distorted: the flow leads from the image back, the flow back from the clean frame there.
            clean, seen = (pixel, pixel + shift) if there else (pixel + shift, pixel)
            ray = (clean - lens.center[:, None]) / lens.focal[:, None]
            missed = lens.distorted(*ray) * lens.focal[:, None] + lens.center[:, None] - seen
            slopes = lens.slopes(*ray)
            determinant = slopes[0, 0] * slopes[1, 1] - slopes[0, 1] * slopes[1, 0]
            rounding = 1e-5 * (lens.focal.max() * lens.size(*ray) + np.abs(pixel).max(initial=1.0))
            assert (determinant > -1e-3 * np.abs(slopes).max(initial=1.0) ** 2).all()
            stretch = np.abs(slopes).max(axis=(0, 1), initial=1.0)
            assert (np.abs(missed) <= 2e-3 + (2 * tolerance + 1e-5) * stretch + rounding).all()


@pytest.mark.parametrize("name", ["uniform fog", "fog in drifts", "flare"])
@given(data=st.data())
def test_where_light_is_valid_the_clean_image_comes_back(name, data):
    fixed = {"blend": "add"} if name == "flare" else {"linear_light": False}
    effect, image = data.draw(cases(name, dtypes=FLOATS, fixed=fixed))
    degraded = effect.degrade(image, seed=7)
    valid = np.broadcast_to(degraded.valid.numpy(), image.shape)
    found, off = doubles(degraded.image), 1e-6 + (effect.tolerance or 0.0) / 255
    if name == "flare":
        back = found - doubles(degraded.intensity) * doubles(degraded.params.color)[:, :, None, None]
        assert (np.abs(back - doubles(image))[valid] <= 2 * off).all()
        return
    t, airlight = doubles(degraded.transmission), doubles(degraded.params.airlight)[:, :, None, None]
    assert (t[degraded.valid.numpy()] >= 1 / 255 - 1e-6).all()
    with np.errstate(divide="ignore", invalid="ignore"):  # where no light is left
        missed = np.abs((found - airlight * (1 - t)) / t - doubles(image)) * t
    assert (missed[valid] <= 2 * off).all()
