import math
import pickle

import pytest
import torch
from torch.testing import assert_close

from torchrefract import Compose, DivergenceFree, LensDistortion, Turbulence, UniformFog, folding, jacobian_determinant


def air(amplitude: float) -> Turbulence:
    return Turbulence(amplitude_range=(amplitude, amplitude), length_range=(9.0, 9.0), aperture_range=(0.0, 0.0))


def degrade(effect, *shape):
    with pytest.warns(UserWarning, match="fold"):
        return effect.degrade(torch.rand(shape), seed=7)


def test_each_sample_tells_how_much_of_it_is_folded():
    made = degrade(air(2.0), 3, 1, 40, 50)
    determinant = jacobian_determinant(made.flow)
    for i in range(3):
        counted = torch.zeros(40, 50, dtype=torch.bool)
        for y in range(40):
            for x in range(50):
                near = made.valid[i, 0, max(y - 1, 0) : y + 2, max(x - 1, 0) : x + 2]
                counted[y, x] = bool(near.all())
        values = determinant[i, 0]
        assert made.folding.min_determinant[i] == values[counted].min()
        assert made.folding.fraction[i].item() == pytest.approx((values[counted] <= 0).sum().item() / 2000)
    assert (made.folding.fraction > 0.02).all()


def test_folded_pixels_are_not_valid_in_the_flow_back():
    made = degrade(air(2.0), 1, 1, 40, 50)
    calm = air(0.05).degrade(torch.rand(1, 1, 40, 50), seed=7)
    assert calm.folding.fraction == 0
    assert calm.restore_valid.double().mean() > 0.9
    assert made.restore_valid.double().mean() < 0.6
    assert made.restore_residual[made.restore_valid].max() <= 0.05


def test_compositions_do_not_mix_the_sheets_of_a_fold():
    image = torch.zeros(4, 1, 180, 320)
    effect = Compose([LensDistortion(), DivergenceFree(amplitude_range=(10.0, 30.0))])
    for seed in (2, 3, 5):
        degraded = effect.degrade(image, seed=seed)
        assert degraded.folding.fraction.amax() > 0.02
        assert degraded.restore_valid.float().mean() > 0.6
        assert degraded.restore_residual[degraded.restore_valid].max() <= 0.5


def test_what_a_lens_shows_nothing_at_is_not_folded():
    lens = LensDistortion(k1_range=(-0.4, -0.4), k2_range=(0.0, 0.0), focal_range=(0.5, 0.5))
    made = degrade(lens, 1, 1, 36, 64)
    assert not made.valid.all()
    assert made.folding.fraction == 0
    assert made.folding.min_determinant > 0


def test_a_whole_composition_is_looked_at():
    made = degrade(Compose([air(2.0), LensDistortion(), UniformFog()]), 2, 1, 40, 50)
    expected = folding(made.flow, made.valid)
    assert torch.equal(made.folding.fraction, expected.fraction)
    assert (made.folding.fraction > 0.01).all()


@pytest.mark.parametrize("effect", [Turbulence(p=0.0), Compose([LensDistortion()], p=0.0)])
def test_a_sample_left_alone_is_not_folded(effect):
    found = effect.degrade(torch.rand(2, 3, 9, 8), seed=0).folding
    assert found.fraction.tolist() == [0, 0]
    assert found.min_determinant.tolist() == [1, 1]


def test_what_moves_nothing_has_no_folds():
    assert UniformFog().degrade(torch.rand(1, 3, 9, 8), seed=0).folding is None


def test_it_travels_and_loses_its_batch_with_the_image():
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
