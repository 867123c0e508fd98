import math
import pickle
import warnings

import pytest
import torch
from torch.testing import assert_close

from torchrefract import Compose, DivergenceFree, LensDistortion, Turbulence, UniformFog, folding


def turbulence(amplitude: float) -> Turbulence:
    return Turbulence(amplitude_range=(amplitude, amplitude), length_range=(9.0, 9.0), aperture_range=(0.0, 0.0))


def degrade(effect, *shape):
    with pytest.warns(UserWarning, match="fold"):
        return effect.degrade(torch.rand(shape), seed=7)


def test_compositions_do_not_interpolate_between_sheets_of_a_fold():
    image = torch.zeros(4, 1, 180, 320)
    effect = Compose([LensDistortion(), DivergenceFree(amplitude_range=(10.0, 30.0))])
    for seed in (2, 3, 5):
        degraded = effect.degrade(image, seed=seed)
        assert degraded.folding.fraction.amax() > 0.02
        assert degraded.restore_valid.float().mean() > 0.6
        assert degraded.restore_residual[degraded.restore_valid].max() <= 0.1


def test_pixels_that_a_lens_does_not_show_are_not_folded():
    lens = LensDistortion(k1_range=(-0.4, -0.4), k2_range=(0.0, 0.0), focal_range=(0.5, 0.5))
    degraded = degrade(lens, 1, 1, 36, 64)
    assert not degraded.valid.all()
    assert degraded.folding.fraction == 0
    assert degraded.folding.min_determinant > 0


def test_folding_of_a_composition_is_that_of_the_composed_flow():
    degraded = degrade(Compose([turbulence(2.0), LensDistortion(), UniformFog()]), 2, 1, 40, 50)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # maps are computed when they are read, and warn again
        expected = folding(degraded.flow, degraded.valid)
    assert torch.equal(degraded.folding.fraction, expected.fraction)
    assert (degraded.folding.fraction > 0.01).all()


@pytest.mark.parametrize("effect", [Turbulence(p=0.0), Compose([LensDistortion()], p=0.0)])
def test_a_sample_that_is_not_degraded_is_not_folded(effect):
    result = effect.degrade(torch.rand(2, 3, 9, 8), seed=0).folding
    assert result.fraction.tolist() == [0, 0]
    assert result.min_determinant.tolist() == [1, 1]


def test_photometric_effects_have_no_folding():
    assert UniformFog().degrade(torch.rand(1, 3, 9, 8), seed=0).folding is None


def test_folding_can_be_pickled_and_loses_its_batch_with_the_image():
    lens = LensDistortion()
    alone = lens.degrade(torch.rand(3, 9, 16), seed=0)
    together = lens.degrade(torch.rand(1, 3, 9, 16), seed=0)
    assert alone.folding.fraction.shape == ()
    assert alone.folding.min_determinant == together.folding.min_determinant[0]
    assert pickle.loads(pickle.dumps(alone)).folding == alone.folding
    assert 0 < alone.folding.min_determinant < math.inf


def test_only_pixels_with_valid_neighbors_count():
    flow = torch.zeros(1, 2, 5, 9)
    flow[:, 0, :, 5:] = -1.5  # folds between the columns 4 and 5
    valid = torch.ones(1, 1, 5, 9, dtype=torch.bool)
    assert folding(flow, valid).fraction.item() == pytest.approx(2 / 9)
    valid[..., 3] = False
    assert folding(flow, valid).fraction.item() == pytest.approx(1 / 9)
    valid[..., 6] = False
    assert folding(flow, valid).fraction == 0
    assert folding(flow, valid).min_determinant == 1
    assert_close(folding(flow, torch.zeros_like(valid)).min_determinant, torch.tensor([torch.inf]))
