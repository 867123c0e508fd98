"""Plates through points that stay the same: sums of what each point does."""

import pytest
import torch
from torch import Tensor

from torchrefract.fields import drawn_plates as plates
from torchrefract.fields.drawn_plates import drawn_plates
from torchrefract.fields.spline import fit_spline, spline_at

pytest.importorskip("numba", reason="without numba no kernel adds plates up")
X, Y = torch.arange(-5.0, 240, 5).double().view(1, 1, 1, -1), torch.arange(-3.0, 160, 3).double().view(1, 1, -1, 1)


def drawn(samples: int = 3, *, count: int = 16, smoothing: float = 0.0) -> tuple[Tensor, Tensor, Tensor]:
    """Points that all samples share, displacements of their own, and the smoothing."""
    random = torch.Generator().manual_seed(7)
    points = 200 * torch.rand(1, count, 2, generator=random).expand(samples, -1, -1)
    return points, 10 * torch.randn(samples, count, 2, generator=random), torch.full((samples,), smoothing)


@pytest.mark.parametrize("count", [3, 4, 16, 25])
@pytest.mark.parametrize("smoothing", [0.0, 0.3])
def test_plates_are_those_of_the_spline(count, smoothing, oracle):
    numbers = drawn(count=count, smoothing=smoothing)
    found = drawn_plates(*numbers, X, Y)
    assert found is not None
    exact = spline_at(fit_spline(*numbers), X, Y, dtype=torch.float64)
    # To the rounding of numbers as large as what all points do together, whatever cancels.
    each = torch.eye(count)[:, :, None].expand(-1, -1, 2)
    alone = fit_spline(numbers[0][:1].expand(count, -1, -1), each, torch.full((count,), smoothing))
    does = spline_at(alone, X, Y, dtype=torch.float64)[:, 0].abs()
    most = torch.einsum("pnm,bpc->bcnm", does, numbers[1].double().abs()).max().item()
    oracle("plates as sums of what each point does", found, exact, 2**-22 * most, unit="px")
    assert exact.abs().max() > 5


def test_a_sample_has_the_same_bits_in_any_batch():
    points, displacement, smoothing = drawn()
    found = drawn_plates(points, displacement, smoothing, X, Y)
    assert found is not None
    for i in range(3):
        alone = drawn_plates(points[i : i + 1], displacement[i : i + 1], smoothing[i : i + 1], X, Y)
        assert alone is not None
        assert torch.equal(alone[0], found[i])


def test_what_is_kept_is_made_once_for_the_same_points_places_and_smoothing(monkeypatch):
    made = list[int]()
    monkeypatch.setattr(plates, "fit_spline", lambda *own, **more: made.append(1) or fit_spline(*own, **more))
    plates._kept.cache_clear()
    points, displacement, smoothing = drawn()
    for numbers in (
        (points, displacement, smoothing),
        (points, displacement.flip(1), smoothing),
        (points[:1], displacement[:1], smoothing[:1]),
    ):
        drawn_plates(*numbers, X, Y)
    assert len(made) == 1
    drawn_plates(points, displacement, smoothing + 0.1, X, Y)
    drawn_plates(points + 1, displacement, smoothing, X, Y)
    drawn_plates(points, displacement, smoothing, X + 1, Y)
    assert len(made) == 4


def test_other_plates_are_left_to_the_spline(monkeypatch):
    points, displacement, smoothing = drawn()
    other = points.clone()
    other[-1] += 7
    assert drawn_plates(other, displacement, smoothing, X, Y) is None
    assert drawn_plates(points, displacement, torch.tensor([0.0, 0.0, 0.1]), X, Y) is None
    assert drawn_plates(points, displacement.clone().requires_grad_(), smoothing, X, Y) is None
    assert drawn_plates(points.double(), displacement.double(), smoothing.double(), X, Y) is None
    assert drawn_plates(points, displacement, smoothing, X[..., :4], Y[:, :, :4]) is None
    monkeypatch.setattr(plates, "_MOST_KEPT", 16 * X.numel() * Y.numel() - 1)
    assert drawn_plates(points, displacement, smoothing, X, Y) is None


def test_made_in_inference_mode_it_serves_outside():
    plates._kept.cache_clear()
    numbers = drawn()
    with torch.inference_mode():
        inside = drawn_plates(*numbers, X, Y)
    outside = drawn_plates(*numbers, X, Y)
    assert inside is not None
    assert outside is not None
    assert torch.equal(inside, outside)
