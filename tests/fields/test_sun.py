"""The light of the sun: the energy of its glare, its disk, and its ghosts."""

import math

import numpy as np
import pytest
import torch
from scipy.integrate import quad
from torch import Tensor
from torch.testing import assert_close

from torchrefract.fields.sun import Sun, glare_tail, sun_light


def row(*values: float) -> Tensor:
    return torch.tensor([values], dtype=torch.float64)


def sun(**changes: Tensor) -> Sun:
    """Return a sun at (60, 40) px, with two ghosts and two channels."""
    values = {
        "center": row(60.0, 40.0),
        "luminance": row(1e4)[0],
        "scatter": row(0.1)[0],
        "scale": row(0.7)[0],
        "shape": row(0.5)[0],
        "color": row(1.0, 0.5),
        "ghosts": torch.tensor([[[-0.5, 0.5, 1e-3], [0.4, 0.3, 2e-3]]], dtype=torch.float64),
        "tints": torch.tensor([[[1.0, 0.25], [0.5, 1.0]]], dtype=torch.float64),
    }
    return Sun(**(values | changes))


def light(of: Sun, *, height: int = 80, width: int = 120, px_per_degree: float = 20.0) -> Tensor:
    x, y = (torch.arange(size, dtype=torch.float64) for size in (width, height))
    return sun_light(of, x, y, principal_point=(50.0, 35.0), px_per_degree=px_per_degree)(slice(None))


@pytest.mark.quick
@pytest.mark.parametrize("scale", [0.05, 0.7, 5.0])
@pytest.mark.parametrize("shape", [0.3, 0.5, 1.0, 2.0])
@pytest.mark.parametrize("scatter", [0.02, 0.3, 1.0])
def test_the_energy_of_the_spread_is_one(scatter, scale, shape):
    def ring(u: float) -> float:
        """Return the light of a ring, with r = scale u^(1/shape), which makes the integrand smooth."""
        r = scale * u ** (1 / shape)
        tail = glare_tail(row(r * r), row(scatter), row(scale), row(shape)).item()
        return tail * 2 * math.pi * r * r / (shape * u)

    scattered = quad(ring, 1e-9, 10, limit=200)[0] + quad(ring, 10, 80, limit=200)[0]
    assert 1 - scatter + scattered == pytest.approx(1, abs=1e-4)


def test_the_glare_is_the_fitted_form():
    r = np.geomspace(0.1, 60, 50)
    actual = glare_tail(torch.from_numpy(r**2), row(0.2), row(0.7), row(0.5))[0]
    p3, p4 = 0.7**-0.5, 0.5
    p2 = 0.2 * p4 * p3 ** (2 / p4) / (2 * math.pi * math.gamma(2 / p4))
    assert_close(actual, torch.from_numpy(p2 * np.exp(-p3 * r**p4)), rtol=1e-4, atol=0)


def test_the_disk_has_the_light_that_is_not_scattered():
    none = {"ghosts": torch.zeros(1, 0, 3, dtype=torch.float64), "tints": torch.zeros(1, 0, 2, dtype=torch.float64)}
    whole = light(sun(scatter=row(0.0)[0], **none), px_per_degree=40.0)[0]
    area = (whole[0] / 1e4).sum().item() / 40**2
    assert area == pytest.approx(math.pi * 0.265**2, rel=0.01)
    rows, columns = torch.nonzero(whole[0], as_tuple=True)
    assert (rows.double().mean().item(), columns.double().mean().item()) == pytest.approx((40, 60))
    assert_close(whole[1], 0.5 * whole[0])


def test_ghosts_are_disks_on_the_line_through_sun_and_principal_point():
    dark = light(sun(tints=torch.zeros(1, 2, 2, dtype=torch.float64)))
    for k, (place, radius, share) in enumerate(((-0.5, 0.5, 1e-3), (0.4, 0.3, 2e-3))):
        tints = torch.zeros(1, 2, 2, dtype=torch.float64)
        tints[0, k] = row(1.0, 0.25)
        ghost = (light(sun(tints=tints)) - dark)[0]
        weight = ghost[0] / ghost[0].sum()
        y, x = (torch.arange(size, dtype=torch.float64) for size in (80, 120))
        assert (weight.sum(dim=0) @ x).item() == pytest.approx(50 + place * 10, abs=0.05)
        assert (weight.sum(dim=1) @ y).item() == pytest.approx(35 + place * 5, abs=0.05)
        energy = 1e4 * math.pi * 0.265**2 * share
        assert ghost[0].sum().item() / 20**2 == pytest.approx(energy, rel=0.02)
        assert_close(ghost[1], 0.25 * ghost[0])
        assert (
            ghost[0][((x - 50 - place * 10) ** 2 + (y[:, None] - 35 - place * 5) ** 2) > (radius * 20 + 1) ** 2].max()
            < 1e-9
        )


def test_rows_are_those_of_the_frame():
    x, y = (torch.arange(size, dtype=torch.float64) for size in (30, 20))
    light_at = sun_light(sun(), x, y, principal_point=(14.0, 9.0), px_per_degree=5.0)
    assert_close(torch.cat([light_at(slice(0, 7)), light_at(slice(7, 20))], dim=2), light_at(slice(None)))


def test_gradients_of_all_parameters_match_finite_differences():
    given = sun(center=row(3.3, 2.2), luminance=row(3.0)[0], scale=row(1.7)[0])
    inputs = [value.clone().requires_grad_() for value in given]

    def lit(*values: Tensor) -> Tensor:
        return light(Sun(*values), height=5, width=7, px_per_degree=2.0)

    assert torch.autograd.gradcheck(lit, inputs)
