import pytest
import torch

from torchrefract._tensor import cat_bands, rows_at_once


@pytest.mark.parametrize("dim", [1, 2])
@pytest.mark.parametrize("sizes", [[5], [2, 2, 1], [1, 4]])
def test_bands_are_joined_in_order(dim, sizes):
    whole = torch.randn(2, 5, 5)
    assert torch.equal(cat_bands(whole.split(sizes, dim=dim), dim=dim, length=5), whole)


@pytest.mark.parametrize(("each", "expected"), [(0, 64), (1, 64), (9, 7), (64, 1), (65, 1)])
def test_rows_of_a_band_stay_in_the_cache(each, expected):
    assert rows_at_once(torch.device("cpu"), 100, each=each, cached=64) == expected


def test_other_devices_take_all_rows_at_once():
    assert rows_at_once(torch.device("meta"), 100, each=9, cached=64) == 100


def test_each_band_is_placed_before_the_next_is_made():
    memory = torch.empty(1, 2)
    bands = (memory.fill_(i) for i in range(3))
    assert cat_bands(bands, dim=0, length=3).tolist() == [[0, 0], [1, 1], [2, 2]]


def test_gradients_reach_every_band():
    bands = [torch.randn(2, 3, requires_grad=True) for _ in range(3)]
    weights = torch.randn(6, 3)
    (cat_bands(bands, dim=0, length=6) * weights).sum().backward()
    for i, band in enumerate(bands):
        assert band.grad is not None
        assert torch.equal(band.grad, weights[2 * i : 2 * i + 2])


def test_bands_of_many_samples_are_joined_under_vmap():
    values = torch.randn(4, 6, 3)
    assert torch.equal(torch.vmap(lambda value: cat_bands(value.split(2), dim=0, length=6))(values), values)
