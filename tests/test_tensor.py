from functools import partial

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from torch import Tensor
from torch.testing import assert_close

from torchrefract import Compose, LensFlare, _tensor
from torchrefract._tensor import (
    exact_matmul,
    highest_nearby,
    in_bands,
    interpolate_channels,
    round_to_dtype,
    rows_at_once,
    shareable,
    sharing_results,
    to_float,
    to_uint8,
)


@pytest.mark.quick
def test_uint8_to_float_and_back_keeps_every_level():
    levels = torch.arange(256, dtype=torch.uint8).view(1, 1, 16, 16)
    image = to_float(levels)
    assert image.flatten().tolist() == (np.arange(256, dtype=np.float32) / np.float32(255)).tolist()
    assert torch.equal(to_uint8(image), levels)
    assert torch.equal(to_uint8(image.double()), levels)


def test_uint16_is_divided_by_65535():
    levels = torch.from_numpy(np.array([0, 1, 32768, 65535], np.uint16))
    assert to_float(levels).tolist() == (np.array([0, 1, 32768, 65535], np.float32) / np.float32(65535)).tolist()


def test_to_uint8_clamps_and_rounds_to_the_nearest_level():
    values = torch.tensor([-torch.inf, -1.0, -1e-3, 0.4 / 255, 0.6 / 255, 100.4 / 255, 1.0, 1.01, 1e30, torch.inf])
    assert to_uint8(values.view(1, 1, 2, 5)).flatten().tolist() == [0, 0, 0, 0, 1, 100, 255, 255, 255, 255]


@pytest.mark.parametrize("layout", [torch.contiguous_format, torch.channels_last])
def test_bands_of_rows_change_no_level_and_no_memory_format(on_threads, layout, monkeypatch):
    on_threads(2)
    monkeypatch.setattr(_tensor, "_CACHED_VALUES", 3000)  # a row of both samples
    image = torch.rand(2, 3, 41, 499, generator=torch.Generator().manual_seed(0)).to(memory_format=layout)
    result = to_uint8(image)
    assert torch.equal(result, torch.from_numpy(np.rint(image.numpy() * np.float32(255)).astype(np.uint8)))
    assert result.stride() == image.stride()


def test_to_uint8_under_vmap_gives_the_levels_of_each_sample():
    images = torch.rand(4, 1, 3, 20, 30, generator=torch.Generator().manual_seed(0))
    assert torch.equal(torch.func.vmap(to_uint8)(images), torch.stack([to_uint8(image) for image in images]))


@pytest.mark.parametrize(
    ("dtype", "low", "high"), [(torch.uint8, 0, 255), (torch.int16, -32768, 32767), (torch.bool, 0, 1)]
)
def test_rounded_values_stay_in_the_range_of_the_type(dtype, low, high):
    values = torch.tensor([-1e9, -0.6, 0.4, 0.6, 1e9])
    assert round_to_dtype(values, dtype).tolist() == [low, max(low, -1), 0, 1, high]


def test_uint8_images_pass_through_one_graph():
    effect, frame = Compose([LensFlare()]), torch.randint(0, 256, (2, 3, 24, 32), dtype=torch.uint8)
    params = effect.sample(frame, seed=0)
    compiled = torch.compile(lambda image: effect.apply(image, params).image, fullgraph=True, backend="eager")
    assert_close(compiled(frame).int(), effect.apply(frame, params).image.int(), rtol=0, atol=1)


@pytest.mark.quick
@pytest.mark.parametrize("dim", [1, 2])
@pytest.mark.parametrize("band", [9, 5, 2])
def test_bands_are_concatenated_in_order(dim, band):
    values = torch.randn(2, 5, 5)
    part = partial(slice_of, values, dim)
    assert torch.equal(in_bands(part, length=5, band=band, dim=dim), values)


def test_a_band_is_copied_before_the_next_one_is_made():
    memory = torch.empty(1, 2)
    assert in_bands(lambda i, _: memory.fill_(i), length=3, band=1, dim=0).tolist() == [[0, 0], [1, 1], [2, 2]]


def test_gradients_reach_every_band():
    values, weights = torch.randn(5, 3, requires_grad=True), torch.randn(5, 3)
    (in_bands(partial(slice_of, values, 0), length=5, band=2, dim=0) * weights).sum().backward()
    assert values.grad is not None
    assert torch.equal(values.grad, weights)


def test_bands_are_concatenated_under_vmap():
    values = torch.randn(4, 6, 3)
    banded = torch.vmap(lambda value: in_bands(partial(slice_of, value, 0), length=6, band=2, dim=0))(values)
    assert torch.equal(banded, values)


def slice_of(values: Tensor, dim: int, start: int, stop: int) -> Tensor:
    return values.narrow(dim, start, stop - start)


@pytest.mark.parametrize(("each", "expected"), [(0, 64), (1, 64), (9, 7), (64, 1), (65, 1)])
def test_the_rows_of_a_band_fit_into_the_cache(each, expected):
    assert rows_at_once(torch.device("cpu"), 100, each=each, cached=64) == expected


def test_other_devices_compute_all_rows_at_once():
    assert rows_at_once(torch.device("meta"), 100, each=9, cached=64) == 100


@pytest.mark.parametrize("precision", ["highest", "high", "medium"])
def test_products_keep_full_precision_at_any_matmul_precision(precision):
    generator = torch.Generator().manual_seed(0)
    left, right = (torch.rand(2, *size, generator=generator) for size in ((33, 70), (70, 41)))
    exact = left.double() @ right.double()
    torch.set_float32_matmul_precision(precision)
    try:
        product, product_double = exact_matmul(left, right), exact_matmul(left.double(), right.double())
    finally:
        torch.set_float32_matmul_precision("highest")
    assert torch.equal(product, left @ right if precision == "highest" else exact.float())
    assert (product - exact).abs().max() < 1e-5
    assert torch.equal(product_double, exact)


@pytest.mark.quick
def test_maxima_and_interpolation_are_those_of_pytorch():
    value = torch.randn(2, 3, 7, 9)
    for reach in (1, 3):
        assert torch.equal(highest_nearby(value, reach), F.max_pool2d(value, 2 * reach + 1, 1, reach))
    assert_close(interpolate_channels(value, (15, 32)), F.interpolate(value, (15, 32), mode="bilinear"))


@pytest.mark.quick
def test_results_are_shared_within_a_block_for_equal_values_without_a_gradient():
    calls = []

    @shareable
    def double(values, *, scale=2):
        calls.append(scale)
        return scale * values

    x = torch.arange(3.0)
    with sharing_results():
        assert double(x) is double(x.clone())
        assert double(x.double()).dtype is torch.float64
        assert double(x + 1).tolist() == [2, 4, 6]
        assert double(x, scale=3).tolist() == [0, 3, 6]
        learned = x.clone().requires_grad_()
        assert double(learned) is not double(learned)
    assert calls == [2, 2, 2, 3, 2, 2]
    double(x)
    double(x)
    assert len(calls) == 8
