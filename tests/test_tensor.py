"""Numbers in [0, 1] and levels of 8 bits."""

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from torchrefract import Compose, LensFlare, UniformFog, _levels
from torchrefract._tensor import round_to_dtype, to_float, to_uint8


def test_levels_are_their_numbers_again():
    levels = torch.arange(256, dtype=torch.uint8).view(1, 1, 16, 16)
    numbers = to_float(levels)
    assert numbers.flatten().tolist() == (np.arange(256, dtype=np.float32) / np.float32(255)).tolist()
    assert torch.equal(to_uint8(numbers), levels)
    assert torch.equal(to_uint8(numbers.double()), levels)


def test_numbers_of_sixteen_bits_are_over_their_own_largest():
    levels = torch.from_numpy(np.array([0, 1, 32768, 65535], np.uint16))
    assert to_float(levels).tolist() == (np.array([0, 1, 32768, 65535], np.float32) / np.float32(65535)).tolist()


def test_levels_are_the_nearest_whole_numbers_of_what_is_cut_to_the_range():
    numbers = torch.tensor([-torch.inf, -1.0, -1e-3, 0.4 / 255, 0.6 / 255, 100.4 / 255, 1.0, 1.01, 1e30, torch.inf])
    assert to_uint8(numbers.view(1, 1, 2, 5)).flatten().tolist() == [0, 0, 0, 0, 1, 100, 255, 255, 255, 255]


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("layout", [torch.contiguous_format, torch.channels_last])
def test_bands_change_no_level_and_no_layout(on_threads, threads, layout, monkeypatch):
    on_threads(threads)
    monkeypatch.setattr(_levels, "_CACHED", 3000)  # a row of both samples
    numbers = torch.rand(2, 3, 41, 499, generator=torch.Generator().manual_seed(0)).to(memory_format=layout)
    found = to_uint8(numbers)
    assert torch.equal(found, torch.from_numpy(np.rint(numbers.numpy() * np.float32(255)).astype(np.uint8)))
    assert found.stride() == numbers.stride()


def test_levels_of_each_are_those_of_all_under_vmap():
    numbers = torch.rand(4, 1, 3, 20, 30, generator=torch.Generator().manual_seed(0))
    assert torch.equal(torch.func.vmap(to_uint8)(numbers), torch.stack([to_uint8(own) for own in numbers]))


@pytest.mark.parametrize(
    ("dtype", "low", "high"), [(torch.uint8, 0, 255), (torch.int16, -32768, 32767), (torch.bool, 0, 1)]
)
def test_whole_numbers_end_where_their_type_ends(dtype, low, high):
    values = torch.tensor([-1e9, -0.6, 0.4, 0.6, 1e9])
    expected = [max(low, v) for v in (-1e9, -1)] + [0, 1, high]
    assert round_to_dtype(values, dtype).tolist() == expected


@pytest.mark.parametrize("kind", [UniformFog, LensFlare, lambda: Compose([LensFlare()])])
def test_one_graph_takes_levels(kind):
    effect, frame = kind(), torch.randint(0, 256, (2, 3, 24, 32), dtype=torch.uint8)
    params = effect.sample(frame, seed=0)
    compiled = torch.compile(lambda image: effect.apply(image, params).image, fullgraph=True, backend="eager")
    assert_close(compiled(frame).int(), effect.apply(frame, params).image.int(), rtol=0, atol=1)
