import math
import warnings
from typing import Any

import cv2
import pytest
import torch
from scipy import stats
from torch import Tensor
from torch.testing import assert_close

from torchrefract import Compose, LensDistortion, LensParams, OneOf, warp
from torchrefract.cameras.brown_conrady import POLYNOMIAL12

FOLDING: dict[str, Any] = {"k1_range": (-0.6, -0.6), "k2_range": (0.0, 0.0), "focal_range": (0.7, 0.7)}


def lenses(coefficients: dict[str, float], focal: float = 0.8, batch: int = 1) -> LensParams:
    row = [coefficients.get(name, 0.0) for name in POLYNOMIAL12]
    return LensParams(
        applied=torch.ones(batch, dtype=torch.bool),
        coefficients=torch.tensor([row] * batch),
        focal=torch.full((batch, 2), focal),
        center=torch.zeros(batch, 2),
    )


def psnr(image: Tensor, clean: Tensor, valid: Tensor) -> float:
    """Return the peak signal-to-noise ratio over the valid pixels, dB."""
    error = (image - clean).square().mean(dim=-3, keepdim=True)[valid].mean()
    return -10 * math.log10(error.item())


@pytest.fixture(scope="module")
def frames(shared_data) -> Tensor:
    """Return real frames of three drives, (3, 3, 360, 640)."""
    names = ["ca_p1_*", "br_es_*", "us_losaltos_*"]
    paths = [sorted((shared_data / "frames" / "val").glob(f"{name}.jpg"))[0] for name in names]
    pictures = [cv2.cvtColor(cv2.imread(str(path)), cv2.COLOR_BGR2RGB) for path in paths]  # pyright: ignore  # imread may give None
    return torch.stack([torch.from_numpy(picture).movedim(-1, 0) for picture in pictures]).float() / 255


def test_the_restore_flow_restores_real_frames_and_the_negative_flow_does_not(frames):
    totals = []
    for interpolation in ("bilinear", "bicubic"):
        d = LensDistortion(interpolation=interpolation, frame="pad").degrade(frames, seed=7, keys=[0, 1, 2])
        naive_error = (d.flow + d.restore_flow).norm(dim=1, keepdim=True)
        restored, negated = (warp(d.image, flow, interpolation=interpolation)[0] for flow in (d.restore_flow, -d.flow))
        totals.append(psnr(restored, frames, d.restore_valid))
        for i, clean in enumerate(frames):
            valid = d.restore_valid[i]
            assert valid.float().mean() > 0.5
            # An error of 2.3 px costs 4.6 dB.
            assert naive_error[i][valid].max() > 2.3
            score = psnr(restored[i], clean, valid)
            assert score > psnr(negated[i], clean, valid) + 4.6
            assert score > psnr(d.image[i], clean, valid) + 4.6
    assert totals[1] > totals[0] + 1


def test_parameters_are_relative_to_the_width_of_the_frame():
    params = lenses({"k1": -0.25, "k2": 0.08, "p1": 1e-3}).to(torch.float64)
    effect = LensDistortion()
    small = effect.apply(torch.zeros(1, 1, 45, 80, dtype=torch.float64), params).flow
    large = effect.apply(torch.zeros(1, 1, 135, 240, dtype=torch.float64), params).flow
    # Every third pixel of the larger frame has its center where a pixel of the smaller one has.
    assert_close(large[..., 1::3, 1::3], 3 * small, rtol=0, atol=1e-9)


def test_all_numbers_are_uniform_in_their_ranges_and_independent():
    count = 3000
    coefficients: dict[str, Any] = {f"{name}_range": (-1.0 - i, 2.0 + i) for i, name in enumerate(POLYNOMIAL12)}
    effect = LensDistortion(
        **coefficients,
        focal_range=(0.5, 2.0),
        aspect_range=(0.5, 3.0),
        center_x_range=(-1.0, 0.0),
        center_y_range=(2.0, 5.0),
        frame="pad",  # filling thousands of frames takes long, and does not change these numbers
    )
    params = effect.sample(torch.zeros(count, 1, 1, 1), seed=7)
    fx, fy = params.focal.double().T
    columns = [*params.coefficients.double().T, fx, fy / fx, *params.center.double().T]
    ranges = [(-1.0 - i, 2.0 + i) for i in range(12)] + [(0.5, 2.0), (0.5, 3.0), (-1.0, 0.0), (2.0, 5.0)]
    for column, (low, high) in zip(columns, ranges, strict=True):
        assert stats.kstest(((column - low) / (high - low)).numpy(), "uniform").pvalue > 1e-4
    others = torch.corrcoef(torch.stack(columns)).fill_diagonal_(0).abs()
    assert others.max() < stats.norm.isf(1e-4 / 240) / math.sqrt(count)


@pytest.mark.parametrize("size", [(36, 64), (64, 64)])
def test_default_lenses_fold_nowhere(size):
    degraded = LensDistortion(strict=True).degrade(torch.zeros(300, 1, *size), seed=7)
    assert (degraded.params.coefficients[:, 0] < 0).all()


def test_pixels_beyond_a_fold_are_padded_and_invalid_after_one_warning():
    effect = LensDistortion(**FOLDING)
    image = torch.ones(3, 1, 36, 64)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("default")
        first, *_ = [effect.degrade(image, seed=7) for _ in range(3)]
    assert [warning.category for warning in caught] == [UserWarning]
    assert "fold" in str(caught[0].message)
    y, x = torch.meshgrid(torch.arange(36) - 17.5, torch.arange(64) - 31.5, indexing="ij")
    center = first.params.center[0] * 64
    r = torch.hypot(x - center[0], y - center[1]) / (0.7 * 64)
    edge = 2 / 3 / math.sqrt(1.8)
    # Decentering by a thousandth moves the edge a little.
    assert not first.valid[0, 0][r > 1.03 * edge].any()
    assert first.valid[0, 0][r < 0.5 * edge].all()
    assert not first.image[0, 0][r > 1.03 * edge].any()
    assert (r > 1.03 * edge).any()


def test_a_ring_near_a_fold_whose_border_has_a_source_is_reported():
    image = torch.ones(1, 1, 108, 192)
    ring = LensDistortion(k1_range=(-0.6, -0.6), k2_range=(0.17, 0.17), focal_range=(0.88, 0.88))
    with pytest.warns(UserWarning, match="must not fold back inside the frame"):
        degraded = ring.degrade(image, seed=0)
    assert degraded.valid[..., [0, -1], :][..., [0, -1]].all()
    assert 0 < (~degraded.valid).sum() < 200


@pytest.mark.parametrize("around", [lambda lens: Compose([lens]), lambda lens: OneOf([lens, lens])])
def test_a_fold_is_reported_inside_a_composition_too(around):
    image = torch.ones(2, 1, 36, 64)
    with pytest.raises(ValueError, match="must not fold back inside the frame"):
        around(LensDistortion(**FOLDING, strict=True)).degrade(image, seed=7)
    with pytest.warns(UserWarning, match="must not fold back inside the frame"):
        around(LensDistortion(**FOLDING)).degrade(image, seed=7)


def test_a_fold_of_a_lens_that_is_not_applied_or_outside_the_frame_is_not_reported():
    image = torch.rand(1, 1, 36, 64)
    LensDistortion(**FOLDING, strict=True, p=0.0).degrade(image, seed=7)
    far: dict[str, Any] = FOLDING | {"focal_range": (3.0, 3.0)}
    LensDistortion(**far, strict=True).degrade(image, seed=7)


@pytest.mark.parametrize("k1", [1.0, 4.0, 10.0])
def test_strong_pincushions_converge_everywhere(k1):
    degraded = LensDistortion().apply(torch.rand(1, 1, 36, 64), lenses({"k1": k1}))
    assert degraded.image.isfinite().all()
    assert degraded.valid.all()


@pytest.mark.filterwarnings("ignore:.*must not fold back inside the frame:UserWarning")  # the lens folds on purpose
def test_the_residual_of_pixels_without_an_inverse_is_finite():
    none = (0.0, 0.0)
    lens = LensDistortion(
        k1_range=(-0.3, -0.3),
        k2_range=none,
        k6_range=(0.1, 0.1),
        p1_range=none,
        p2_range=none,
        focal_range=(0.1, 0.1),
        frame="pad",
    )
    degraded = lens.degrade(torch.zeros(1, 1, 60, 1), seed=0)
    assert degraded.restore_flow.abs().max() > 1e20  # its square is no number of float32
    assert degraded.restore_residual.isfinite().all()


@pytest.mark.parametrize(("padding", "outside"), [("zeros", 0.0), ("border", 1.0), ("reflection", 1.0)])
def test_padding_fills_pixels_that_show_points_outside_the_frame(padding, outside):
    # The corners of a barrel distortion show points outside the clean frame.
    effect = LensDistortion(padding=padding)
    degraded = effect.apply(torch.ones(1, 1, 36, 64), lenses({"k1": -0.2, "k2": 0.05}))
    assert not degraded.valid[0, 0, 0, 0]
    assert degraded.image[0, 0, 0, 0] == outside
    assert degraded.image[0, 0, 18, 32] == 1


def test_restore_valid_holds_where_the_degraded_frame_shows_the_pixel():
    # A pincushion distortion moves the corners of the scene out of the frame.
    degraded = LensDistortion().apply(torch.ones(1, 1, 36, 64), lenses({"k1": 0.3}))
    restore_flow, restore_valid = degraded.restore_flow, degraded.restore_valid
    back, seen = warp(degraded.image, restore_flow)
    assert degraded.valid.all()
    assert torch.equal(restore_valid, seen)
    assert not restore_valid[0, 0, 0, 0]
    assert restore_valid[0, 0, 18, 32]
    assert_close(back[restore_valid], torch.ones_like(back[restore_valid]), rtol=0, atol=1e-5)
