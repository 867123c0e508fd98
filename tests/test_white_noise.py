import math

import pytest
import torch
from scipy import stats
from torch import Tensor

from torchrefract import draws, white_noise

COUNT = 400_000
# The chance of a false alarm of each statistical test; the draws are fixed, so each passes for good or never.
ALARM = 1e-4
# Correlations of independent numbers and means of standard normal ones stay below this.
LIMIT = stats.norm.isf(ALARM / 2) / math.sqrt(COUNT)
WORD = 2**32


def keys(seed: int = 5, samples: int = 3) -> Tensor:
    return draws.noise_key(draws.stream(seed, torch.arange(samples)))


def correlation(a: Tensor, b: Tensor) -> float:
    return torch.corrcoef(torch.stack([a.flatten(), b.flatten()]).double())[0, 1].item()


def noise_of_whole_numbers(key: list[int], i: int) -> tuple[float, float]:
    """The pair of index i, in Python's own integers and floats."""

    def word(add: int, then: int) -> int:
        x = (i * 0x9E3779B1 + add) % WORD
        x = ((x ^ x >> 16) * 0x7FEB352D + then) % WORD
        x = (x ^ x >> 15) * 0x846CA68B % WORD
        return x ^ x >> 16

    radius = math.sqrt(-2 * math.log(((word(key[0], key[1]) >> 9) + 0.5) / 2**23))
    angle = 2 * math.pi * word(key[2], key[3]) / WORD
    return radius * math.cos(angle), radius * math.sin(angle)


@pytest.mark.parametrize("index", [0, 1, 65_535, 65_536, 70_002])
def test_a_pair_is_the_transform_of_a_hash_in_whole_numbers(index):
    key = torch.cat([keys(), torch.tensor([[0, 0, 0, 0], [WORD - 1, 2**31, 2**31 - 1, WORD - 1]])])
    found = white_noise.noise(key, 70_003)
    for i, words in enumerate(key.tolist()):
        assert found[i, :, index].tolist() == pytest.approx(noise_of_whole_numbers(words, index), abs=1e-5)


def test_the_key_of_the_noise_is_of_the_sample_its_lane_and_nothing_else():
    source = draws.stream(5, torch.tensor([3, -4, 2**40]))
    found = draws.noise_key(source.at(2))
    assert found.shape == (3, 4)
    assert found.dtype == torch.int64
    assert ((found >= 0) & (found < WORD)).all()
    assert found.unique().numel() == 12
    assert torch.equal(draws.noise_key(draws.stream(5, torch.tensor([-4])).at(2))[0], found[1])
    assert not (draws.noise_key(source) == found).any()


def test_the_numbers_are_normal():
    for sample in white_noise.noise(keys(), COUNT).double():
        for numbers in sample:
            assert abs(numbers.mean()) < LIMIT
            assert abs(numbers.square().mean() - 1) < math.sqrt(2) * LIMIT  # whose variance is 2
            assert abs((numbers**4).mean() - 3) < math.sqrt(96) * LIMIT  # E x^8 - 9
            assert abs((numbers**3).mean()) < math.sqrt(15) * LIMIT
            assert stats.kstest(numbers.numpy(), "norm").pvalue > ALARM
        radius2 = sample.square().sum(dim=0)
        assert stats.kstest(radius2.numpy(), "chi2", args=(2,)).pvalue > ALARM


def test_tails_are_where_they_belong_and_bounded():
    numbers = white_noise.noise(keys(samples=8), COUNT)
    for bound in (3.0, 4.0, 4.5):
        expected = numbers.numel() * 2 * stats.norm.sf(bound)
        found = (numbers.abs() > bound).sum().item()
        assert abs(found - expected) < stats.norm.isf(ALARM / 2) * math.sqrt(expected)
    assert numbers.abs().max() <= math.sqrt(48 * math.log(2)) * (1 + 1e-6) < 5.8


def test_the_two_fields_and_their_magnitudes_do_not_correlate():
    for first, second in white_noise.noise(keys(), COUNT):
        assert abs(correlation(first, second)) < LIMIT
        assert abs(correlation(first.abs(), second.abs())) < LIMIT
        assert abs(correlation(first.square() - second.square(), first.square() + second.square())) < LIMIT


# Neighbors along rows, and along the columns of some frames.
@pytest.mark.parametrize("lag", [*range(1, 9), 64, 1024, 2048, 2100, 65_536])
def test_neighbors_do_not_correlate(lag):
    first, second = white_noise.noise(keys(samples=1), COUNT + lag)[0]
    for a in (first, second):
        for b in (first, second):
            assert abs(correlation(a[lag:], b[:-lag])) < LIMIT
            assert abs(correlation(a[lag:].abs(), b[:-lag].abs())) < LIMIT


def test_no_frequency_stands_out():
    side = 512
    numbers = white_noise.noise(keys(samples=4), side * side).view(-1, side, side)
    power = torch.fft.rfft2(numbers, norm="ortho").abs().square()[:, :, 1:-1].double()
    # The power of white noise follows the exponential law, so of n values the largest exceeds t with n exp(-t).
    assert power.max() < math.log(power.numel() / ALARM)
    assert stats.kstest(power.flatten().numpy()[::7], "expon").pvalue > ALARM


def test_samples_lanes_and_seeds_are_independent():
    base = draws.stream(5, torch.arange(4))
    key = torch.cat(
        [draws.noise_key(base), draws.noise_key(base.at(1)), draws.noise_key(draws.stream(6, base.low[:1]))]
    )
    fields = white_noise.noise(key, COUNT).flatten(0, 1).double()
    assert len(key) == 9
    off = torch.corrcoef(fields) - torch.eye(18)
    assert off.abs().max() < stats.norm.isf(ALARM / 2 / 153) / math.sqrt(COUNT)
    off = torch.corrcoef(fields.abs()) - torch.eye(18)
    assert off.abs().max() < stats.norm.isf(ALARM / 2 / 153) / math.sqrt(COUNT)


@pytest.mark.parametrize("count", [0, 1, 2, 3, 7, 8, 15, 16, 17, 1_021, 65_535, 65_536, 65_537, 131_075])
def test_fewer_numbers_are_the_first_of_more(count):
    whole = white_noise.noise(keys(), 200_003)
    assert torch.equal(white_noise.noise(keys(), count), whole[:, :, :count])


@pytest.mark.parametrize("count", [5, 1_021, 70_001])
def test_a_sample_does_not_depend_on_the_batch_around_it(count):
    key = keys(samples=9)
    together = white_noise.noise(key, count)
    for i in range(len(key)):
        assert torch.equal(white_noise.noise(key[i : i + 1], count)[0], together[i])
    assert torch.equal(white_noise.noise(key.flip(0)[:5], count), together.flip(0)[:5])
    assert white_noise.noise(key[:0], count).shape == (0, 2, count)


def test_threads_do_not_change_a_bit(on_threads):
    found = []
    for threads in range(1, 5):
        on_threads(threads)
        found.append(white_noise.noise(keys(), 200_003))
    assert all(torch.equal(numbers, found[0]) for numbers in found[1:])


def test_a_map_over_samples_gives_the_same_numbers():
    key = keys()
    mapped = torch.func.vmap(lambda one: white_noise.noise(one[None], 1_021)[0])(key)
    assert torch.equal(mapped, white_noise.noise(key, 1_021))


def test_compiled_code_gives_the_same_numbers():
    def field(sample_keys: Tensor) -> Tensor:
        return 2 * white_noise.noise(draws.noise_key(draws.stream(3, sample_keys).at(1)), 1_021)

    sample_keys = torch.tensor([0, -5, 2**40])
    assert torch.equal(torch.compile(field, fullgraph=True, backend="aot_eager")(sample_keys), field(sample_keys))


def test_nodes_of_a_lattice_depend_on_their_coordinates_alone():
    rows, columns = torch.arange(-5, 60).expand(3, -1), torch.arange(2**33, 2**33 + 80).expand(3, -1)
    key = keys(samples=3)
    whole = white_noise.lattice(key, [rows, columns], 3)
    window = white_noise.lattice(key[1:], [rows[1:, 7:20], columns[1:, 30:33]], 3)
    assert torch.equal(window, whole[1:, :, 7:20, 30:33])
    assert torch.equal(white_noise.lattice(key, [rows, columns], 2), whole[:, :2])


@pytest.mark.parametrize("axes", [1, 2, 3])
def test_numbers_on_a_lattice_are_uniform_and_independent(axes):
    sides = {1: (90_000,), 2: (300, 300), 3: (45, 40, 50)}[axes]
    numbers = white_noise.lattice(keys(samples=2), [torch.arange(n).expand(2, -1) for n in sides], 2).double()
    assert 0 < numbers.min() < 1e-4
    assert 1 - 1e-4 < numbers.max() < 1
    counts = torch.histc(numbers, 100, 0, 1)
    expected = numbers.numel() / 100
    assert ((counts - expected) ** 2 / expected).sum() < stats.chi2.ppf(1 - ALARM, 99)
    rows = numbers.flatten(2).flatten(0, 1) - 0.5
    bound = 5 / math.sqrt(rows.shape[1])
    assert (12 * rows @ rows.T / rows.shape[1] - torch.eye(4)).abs().max() < bound
    for dim in range(2, numbers.ndim):
        first, second = (numbers.narrow(dim, i, numbers.shape[dim] - 1) - 0.5 for i in (0, 1))
        assert (12 * first * second).mean().abs() < bound


def test_one_graph_gives_the_same_lattice():
    axes = [torch.arange(9).expand(3, -1), torch.arange(-4, 8).expand(3, -1)]
    key = keys(samples=3)
    compiled = torch.compile(lambda key: 2 * white_noise.lattice(key, axes, 2), fullgraph=True)
    assert torch.equal(compiled(key), 2 * white_noise.lattice(key, axes, 2))


@pytest.mark.parametrize("samples", [1, 3])
def test_what_numba_compiles_gives_the_same_bits(samples, monkeypatch, on_threads):
    on_threads(2)
    key, places = keys(samples=samples), torch.arange(40_000).flip(0) * 107_374
    found = white_noise.noise_at(key, places)
    monkeypatch.setattr(white_noise, "kernels", lambda _: None)
    assert torch.equal(found, white_noise.noise_at(key, places))
