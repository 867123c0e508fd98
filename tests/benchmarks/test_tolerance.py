import pytest
import tolerance
import torch
from tolerance import CONFIGURATIONS, Trial, attempt, summary


@pytest.mark.parametrize("name", list(CONFIGURATIONS))
def test_a_random_configuration_keeps_its_tolerance(monkeypatch, name):
    monkeypatch.setattr(tolerance, "LARGEST", (120, 160))
    trial = attempt(name, seed=1)
    assert 64 <= trial.height <= 120
    assert 0 <= trial.share <= 1
    assert trial == attempt(name, seed=1)


@pytest.mark.quick
def test_exceeded_tolerances_are_counted():
    trials = [Trial("lens", 64, 64, 0.1, error) for error in (0.02, 0.05, 0.3)]
    assert summary("lens", trials) == (
        "lens: 3 configurations, tolerance EXCEEDED by 1; error / tolerance: largest 3.00, median 0.500"
    )


def test_pixels_that_rounding_moves_are_compared_with_the_rounded_flow():
    expected = torch.zeros(1, 2, 1, 3).double()
    rounded, flow = torch.zeros(1, 2, 1, 3), torch.zeros(1, 2, 1, 3)
    rounded[0, 0, 0, 0] = flow[0, 0, 0, 0] = 5.0  # a fold: the exact flow is off in float32, too
    flow[0, 1, 0, 1] = 0.25
    assert tolerance._flow_error(flow, expected, lambda: rounded, 0.3) == pytest.approx(0.25)
    assert tolerance._flow_error(flow, expected, lambda: torch.zeros(1, 2, 1, 3), 0.3) == pytest.approx(5.0)
