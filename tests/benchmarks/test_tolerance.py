import json

import pytest
import tolerance
import torch
from tolerance import Trial, attempt, summary


def test_a_seed_repeats_its_configuration():
    trial = attempt("LensDistortion", 1, (120, 160))  # tests of plans try all kinds
    assert 64 <= trial.height <= 120
    assert trial == attempt("LensDistortion", 1, (120, 160))


def test_splines_in_small_frames_keep_the_tolerance_of_their_composition():
    assert attempt("Compose", 91, (270, 480)).share < 0.5  # eight cells of a lattice along each axis tell its error


def test_deep_folds_keep_a_small_tolerance():
    assert attempt("Compose", 288, (270, 480)).share < 0.1  # which stretches errors of single flows by 124


# A strong lens in a narrow frame; a lens at points far outside the frame; lattices whose corners have no ray.
@pytest.mark.parametrize(("name", "seed"), [("LensDistortion", 9), ("Compose", 60), ("Rectification", 82)])
def test_configurations_at_the_edge_of_their_error_bounds_keep_their_tolerance(name, seed):
    assert attempt(name, seed, (360, 640)).share <= 1


@pytest.mark.quick
def test_exceeded_tolerances_are_counted_and_end_the_command(monkeypatch, tmp_path, run_program, capsys):
    trials = [Trial("lens", 64, 64, 0.1, error) for error in (0.02, 0.05, 0.3)]
    assert summary("lens", trials) == (
        "lens: 3 configurations, tolerance EXCEEDED by 1; error / tolerance: largest 3.00, median 0.500; "
        "restore flow: largest 0.00, median 0.000"
    )
    out = tmp_path / "new" / "tolerance.json"
    monkeypatch.setattr(tolerance, "attempt", lambda name, seed, largest: trials[seed])
    with pytest.raises(SystemExit):
        run_program(tolerance, "--count", "3", "--only", "Compose", "--out", out)
    assert "EXCEEDED by 1" in capsys.readouterr().out
    assert [trial["error"] for trial in json.loads(out.read_text())] == [0.02, 0.05, 0.3]


# Flows that fold: pixels are shown several times, or next to a fold. The last one folds outside of the frame.
@pytest.mark.parametrize(
    ("name", "seed"),
    [
        *[("Turbulence", 0), ("rough Turbulence", 1), ("DivergenceFree", 1), ("DivergenceFree", 124)],
        # The inverse of one warp stretches the error of another; a pixel lies between two sheets of a fold.
        *[("Compose", 13), ("Compose", 294), ("Compose", 128)],
    ],
)
def test_restore_flows_next_to_folds_keep_their_tolerance(name, seed):
    trial = attempt(name, seed, (270, 480))
    assert 0 < trial.restore_share <= 1


@pytest.mark.quick
def test_only_valid_pixels_count():
    flow, expected = torch.zeros(1, 2, 1, 3), torch.zeros(1, 2, 1, 3).double()
    flow[0, 0, 0, 0], flow[0, 1, 0, 1] = 5.0, 0.25
    valid = torch.tensor([False, True, True]).view(1, 1, 1, 3)
    assert tolerance._largest_distance(flow, expected, valid) == pytest.approx(0.25)
