import pytest
import torch

from torchrefract._tensor import exact_matmul


@pytest.mark.parametrize("told", ["highest", "high", "medium"])
def test_products_keep_the_digits_of_their_type_whatever_a_training_asks_for(told):
    left, right = torch.rand(2, 33, 70), torch.rand(2, 70, 41)
    exact = left.double() @ right.double()
    torch.set_float32_matmul_precision(told)
    try:
        found, wide = exact_matmul(left, right), exact_matmul(left.double(), right.double())
    finally:
        torch.set_float32_matmul_precision("highest")
    assert torch.equal(found, left @ right if told == "highest" else exact.float())
    assert (found - exact).abs().max() < 1e-5
    assert torch.equal(wide, exact)
