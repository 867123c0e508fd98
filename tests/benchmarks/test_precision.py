import precision
import pytest
import torch


def test_a_flow_that_is_off_is_said_to_be_so_far_off():
    image, true = torch.rand(1, 1, 40, 60), torch.rand(1, 2, 40, 60, dtype=torch.float64)
    off = true.clone()
    off[:, 0, 20, 30] += 0.3
    off[:, 1, 20, 30] -= 0.4
    assert precision.far(off, true) == pytest.approx(0.5)
    assert precision.landing(image.double(), off, true) == pytest.approx(0.5, abs=1e-9)
    assert precision.landing(image, true.float(), true) < 60 * 2.0**-22


def test_the_worst_case_of_an_effect_is_named():
    found = [
        precision.Error("lens", "float32", 8, 9, 1e-5, 2e-5, None),
        precision.Error("lens", "float32", 80, 90, 1e-4, 2e-4, None),
        precision.Error("fog", "float16 image", 8, 9, None, None, 0.06),
    ]
    lens, fog = precision.worst(found)
    assert "lens: 2.0e-04 px, float32, 80 x 90" in lens
    assert "fog: 6.0e-02 levels, float16 image, 8 x 9" in fog


def test_second_derivatives_are_those_of_float64():
    assert all(error < 1e-3 for error in precision.second_derivatives().values())
