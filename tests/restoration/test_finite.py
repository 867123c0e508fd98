import pytest
import torch

from torchrefract.restoration.finite import NotFiniteError, check_finite


@pytest.mark.parametrize(("value", "told"), [(float("nan"), "nan"), (float("inf"), "inf"), (-float("inf"), "-inf")])
def test_a_loss_that_is_no_number_is_told_with_its_step_and_keys(value, told):
    loss = torch.tensor(value, requires_grad=True)
    keys = torch.tensor([7, -(2**63), 2**62])
    message = f"^loss must be finite, got {told} in step 12 of epoch 3 for the keys 7, {-(2**63)}, {2**62}$"
    with pytest.raises(NotFiniteError, match=message):
        check_finite(loss, keys, step=12, epoch=3)


@pytest.mark.parametrize("value", [0.0, 3e38])
def test_any_number_passes(value):
    check_finite(torch.tensor(value), torch.tensor([1]), step=0, epoch=0)
