import math
from pathlib import PurePosixPath, PureWindowsPath

import pytest
import torch
from scipy import stats
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from torchrefract import LensDistortion, key_of, random

WORD = 2**32
COUNT, NOISE_COUNT = 20_000, 400_000
# The chance of a false alarm of each statistical test; the draws are fixed, so each passes always or never.
ALARM = 1e-4
# Correlations of independent numbers, and means of standard normal ones, stay below this.
LIMIT = stats.norm.isf(ALARM / 2) / math.sqrt(NOISE_COUNT)


def threefry_by_definition(key: tuple[int, int], counter: tuple[int, int]) -> tuple[int, int]:
    """Compute Threefry-2x32-20 round by round as its paper defines it, in Python's integers."""
    keys = (*key, key[0] ^ key[1] ^ 0x1BD11BDA)
    x, y = (counter[0] + keys[0]) % WORD, (counter[1] + keys[1]) % WORD
    for i in range(20):
        x = (x + y) % WORD
        turn = (13, 15, 26, 6, 17, 29, 16, 24)[i % 8]
        y = (y << turn | y >> (32 - turn)) % WORD ^ x
        if i % 4 == 3:
            group = i // 4 + 1
            x, y = (x + keys[group % 3]) % WORD, (y + keys[(group + 1) % 3] + group) % WORD
    return x, y


def noise_by_definition(key: list[int], i: int) -> tuple[float, float]:
    """Compute pair i of the white noise in Python's integers and floats."""

    def word(add: int, then: int) -> int:
        x = (i * 0x9E3779B1 + add) % WORD
        x = ((x ^ x >> 16) * 0x7FEB352D + then) % WORD
        x = (x ^ x >> 15) * 0x846CA68B % WORD
        return x ^ x >> 16

    radius = math.sqrt(-2 * math.log(((word(key[0], key[1]) >> 9) + 0.5) / 2**23))
    angle = 2 * math.pi * word(key[2], key[3]) / WORD
    return radius * math.cos(angle), radius * math.sin(angle)


def noise_keys(seed: int = 5, samples: int = 3) -> Tensor:
    return random.noise_key(random.stream(seed, torch.arange(samples)))


def correlation(a: Tensor, b: Tensor) -> float:
    return torch.corrcoef(torch.stack([a.flatten(), b.flatten()]).double())[0, 1].item()


class MetaCalls(TorchDispatchMode):
    """Names of the operators called on the device "meta", which stands for an accelerator."""

    def __init__(self):
        super().__init__()
        self.names = list[str]()

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        result = func(*args, **(kwargs or {}))
        values = tree_leaves((args, kwargs, result))
        if any(isinstance(value, Tensor) and value.is_meta for value in values):
            self.names.append(func.overloadpacket.__name__)
        return result


@pytest.mark.quick
@pytest.mark.parametrize("keys", [range(3), torch.arange(50)], ids=["range", "tensor"])
def test_an_accelerator_only_receives_copies(keys):
    source = random.stream(5, keys, device=torch.device("meta"))
    with MetaCalls() as calls:
        drawn = [
            random.uniform(source, 4),
            random.uniform_in_ranges(source.at(1), [(0.0, 1.0)] * 3, dtype=torch.float64),
            random.normal(random.fold(source), 4),
            random.noise_key(source),
        ]
    assert all(value.is_meta for value in drawn)
    assert set(calls.names) <= {"_to_copy", "empty_strided", "copy_", "detach"}
    assert len(calls.names) <= 3 * len(drawn)
    assert not random.uniform(source.to(torch.device("cpu")), 4).is_meta


@pytest.mark.quick
@pytest.mark.parametrize(
    ("key", "counter", "answer"),
    [
        ((0, 0), (0, 0), (0x6B200159, 0x99BA4EFE)),
        ((WORD - 1, WORD - 1), (WORD - 1, WORD - 1), (0x1CB996FC, 0xBB002BE7)),
        ((0x13198A2E, 0x03707344), (0x243F6A88, 0x85A308D3), (0xC4923A9C, 0x483DF7A0)),
    ],
)
def test_threefry_gives_the_test_vectors_of_random123(key, counter, answer):
    signed = [high << 32 | low for high, low in (key, counter)]
    words = random.stream(signed[0], torch.tensor([signed[1] - 2**64 if signed[1] >= 2**63 else signed[1]])).words
    assert tuple(words[:, 0].tolist()) == answer == threefry_by_definition(key, counter)


@pytest.mark.quick
@pytest.mark.parametrize("seed", [0, -1, 2**32 + 5, -(2**63), 2**63 - 1, 2**64 + 5, -(10**30)])
@pytest.mark.parametrize("key", [0, -1, 2**32, 2**63 - 1, -(2**63)])
@pytest.mark.parametrize("count", [3, 40])  # computed with Python's integers, and with arrays
def test_uniform_numbers_follow_seed_key_and_lane_by_definition(seed, key, count):
    halves = [((value % 2**64) // WORD, value % WORD) for value in (seed, key)]
    parent = threefry_by_definition(halves[0], halves[1])
    first, second = zip(*(threefry_by_definition(parent, (i, 3)) for i in range((count + 1) // 2)), strict=True)
    expected = [((word >> 9) + 0.5) / 2**23 for word in (*first, *second)[:count]]
    assert random.uniform(random.stream(seed, torch.tensor([key])).at(3), count)[0].tolist() == expected


def test_seeds_and_keys_inside_vmap_and_as_tensors_give_the_same_numbers():
    keys = torch.tensor([9, -4, 2**40])
    expected = random.normal(random.stream(2**62, keys).at(1), 9)
    seed = torch.tensor(2**62)
    assert torch.equal(random.normal(random.stream(seed, keys).at(1), 9), expected)
    mapped = torch.func.vmap(lambda key: random.normal(random.stream(2**62, key[None]).at(1), 9)[0])(keys)
    torch.testing.assert_close(mapped, expected, atol=1e-6, rtol=0)
    key = noise_keys()
    noise = torch.func.vmap(lambda one: random.white_noise(one[None], 1_021)[0])(key)
    assert torch.equal(noise, random.white_noise(key, 1_021))


@pytest.mark.quick
def test_a_seed_and_keys_may_lie_on_different_devices():
    cpu, other = torch.device("cpu"), torch.device("meta")
    for of_seed, of_keys, expected in ((cpu, other, other), (other, cpu, other), (cpu, cpu, cpu)):
        source = random.stream(torch.tensor(7, device=of_seed), torch.arange(3, device=of_keys))
        assert source.words.shape == (2, 3)
        assert random.uniform(source, 4).device == expected
    image = torch.empty(3, 3, 8, 9, device=other)
    assert LensDistortion().degrade(image, keys=torch.arange(3, device=other)).flow.device == other


@pytest.mark.quick
def test_numbers_in_ranges_are_scaled_uniform_numbers():
    source = random.stream(2, range(20)).at(5)
    ranges = [(-1.0, 4.0), (0.3, 0.3), (0.0, 1e-3)]
    for dtype in (torch.float32, torch.float64):
        low, high = torch.tensor(ranges, dtype=dtype).T
        expected = low + (high - low) * random.uniform(source, 3).to(dtype)
        assert torch.equal(random.uniform_in_ranges(source, ranges, dtype=dtype), expected)


def test_normal_numbers_are_normal():
    numbers = random.normal(random.stream(1, torch.arange(4)), COUNT).double()
    assert stats.kstest(numbers.flatten().numpy(), "norm").pvalue > ALARM
    radius2 = torch.stack(numbers.chunk(2, dim=1)).square().sum(dim=0)
    assert stats.kstest(radius2.flatten().numpy(), "chi2", args=(2,)).pvalue > ALARM


@pytest.mark.parametrize("word", [0, WORD - 1])
@pytest.mark.parametrize("count", [4, 140])
def test_the_interval_is_open_and_the_normals_of_its_ends_are_finite(monkeypatch, word, count):
    monkeypatch.setattr(random, "_rounds", lambda *numbers: (sum(numbers) * 0 + word,) * 2)
    source = random.stream(0, range(1))
    assert (random.uniform(source, count) == (2.0**-24 if word == 0 else 1 - 2.0**-24)).all()
    assert random.normal(source, count).abs().max() <= math.sqrt(48 * math.log(2)) * (1 + 1e-6)


@pytest.mark.parametrize("count", [1, 3, 8, 17])
@pytest.mark.parametrize("draw", [random.uniform, random.normal])
def test_each_sample_gets_as_many_different_numbers_as_requested(draw, count):
    numbers = draw(random.stream(2, torch.arange(5)), count)
    assert numbers.shape == (5, count)
    assert numbers.unique().numel() == 5 * count
    assert draw(random.stream(2, range(0)), count).shape == (0, count)


@pytest.mark.quick
def test_a_sample_does_not_depend_on_its_batch():
    keys = torch.tensor([9, -4, 2**40, 7])
    together = random.normal(random.fold(random.stream(3, keys).at(1)), 33)
    for i in range(4):
        assert torch.equal(random.normal(random.fold(random.stream(3, keys[i : i + 1]).at(1)), 33)[0], together[i])
    assert torch.equal(random.normal(random.fold(random.stream(3, keys.flip(0)).at(1)), 33), together.flip(0))


def test_keys_lanes_folds_and_seeds_are_independent():
    base = random.stream(4, torch.tensor([0]))
    sources = {
        "base": base,
        "next key": random.stream(4, torch.tensor([1])),
        "key of another high word": random.stream(4, torch.tensor([2**32])),
        "next seed": random.stream(5, torch.tensor([0])),
        "seed of another high word": random.stream(4 + 2**32, torch.tensor([0])),
        "seed and key exchanged": random.stream(0, torch.tensor([4])),
        "next lane": base.at(1),
        "far lane": base.at(2**31),
        "fold": random.fold(base),
        "fold of a lane": random.fold(base.at(1)),
        "fold of a fold": random.fold(random.fold(base)),
    }
    numbers = torch.cat([random.uniform(source, COUNT) for source in sources.values()]).double()
    off_diagonal = torch.corrcoef(numbers) - torch.eye(len(sources))
    assert off_diagonal.abs().max() < stats.norm.isf(ALARM / 2) / math.sqrt(COUNT)


@pytest.mark.quick
def test_a_call_seed_follows_the_global_generator():
    torch.manual_seed(11)
    first = [random.call_seed().item() for _ in range(3)]
    torch.manual_seed(11)
    assert [random.call_seed().item() for _ in range(3)] == first
    assert len(set(first)) == 3
    torch.manual_seed(12)
    assert random.call_seed().item() != first[0]


def test_one_graph_draws_the_same_seeds_words_and_noise_as_eager_code():
    keys = torch.tensor([0, -5, 2**40])
    axes = [torch.arange(9).expand(3, -1), torch.arange(-4, 8).expand(3, -1)]

    def draw(keys: Tensor) -> tuple[Tensor, ...]:
        source = random.stream(3, keys)
        key = random.noise_key(source.at(1))
        return (
            random.call_seed() ^ 1,
            key,
            random.uniform(random.fold(source), 7),
            random.lattice_noise(key, axes, 2),
            random.white_noise(key, 1_021),
        )

    torch.manual_seed(11)
    expected = draw(keys)
    torch.manual_seed(11)
    drawn = torch.compile(draw, fullgraph=True)(keys)
    assert all(map(torch.equal, drawn[:4], expected[:4]))
    torch.testing.assert_close(drawn[4], expected[4], atol=2e-6, rtol=1e-6)  # which has other logarithms and cosines


@pytest.mark.quick
@pytest.mark.parametrize("index", [0, 1, 65_536, 70_002])
def test_a_pair_of_white_noise_is_the_box_muller_transform_of_a_hash(index):
    key = torch.cat([noise_keys(), torch.tensor([[0, 0, 0, 0], [WORD - 1, 2**31, 2**31 - 1, WORD - 1]])])
    noise = random.white_noise(key, 70_003)
    for i, words in enumerate(key.tolist()):
        assert noise[i, :, index].tolist() == pytest.approx(noise_by_definition(words, index), abs=1e-5)
    assert torch.equal(random.white_noise_at(key, torch.tensor([7, index]))[:, :, 1], noise[:, :, index])


@pytest.mark.quick
def test_a_noise_key_depends_on_its_sample_and_lane_only():
    source = random.stream(5, torch.tensor([3, -4, 2**40]))
    key = random.noise_key(source.at(2))
    assert key.shape == (3, 4)
    assert key.dtype == torch.int64
    assert ((key >= 0) & (key < WORD)).all()
    assert key.unique().numel() == 12
    assert torch.equal(random.noise_key(random.stream(5, torch.tensor([-4])).at(2))[0], key[1])
    assert not (random.noise_key(source) == key).any()


def test_white_noise_is_normal():
    for sample in random.white_noise(noise_keys(), NOISE_COUNT).double():
        for numbers in sample:
            assert abs(numbers.mean()) < LIMIT
            assert abs(numbers.square().mean() - 1) < math.sqrt(2) * LIMIT  # the variance of x^2 is 2
            assert abs((numbers**4).mean() - 3) < math.sqrt(96) * LIMIT  # E x^8 - 9
            assert abs((numbers**3).mean()) < math.sqrt(15) * LIMIT
            assert stats.kstest(numbers.numpy(), "norm").pvalue > ALARM
            assert numbers.abs().max() <= math.sqrt(48 * math.log(2)) * (1 + 1e-6) < random.LARGEST_NORMAL
        radius2 = sample.square().sum(dim=0)
        assert stats.kstest(radius2.numpy(), "chi2", args=(2,)).pvalue > ALARM


# Neighbors along rows, and along the columns of some frames.
@pytest.mark.parametrize("lag", [1, 2, 3, 4, 8, 64, 1024, 2100, 65_536])
def test_neighbors_in_white_noise_do_not_correlate(lag):
    first, second = random.white_noise(noise_keys(samples=1), NOISE_COUNT + lag)[0]
    for a in (first, second):
        for b in (first, second):
            assert abs(correlation(a[lag:], b[:-lag])) < LIMIT
            assert abs(correlation(a[lag:].abs(), b[:-lag].abs())) < LIMIT


def test_white_noise_of_samples_lanes_and_seeds_is_independent():
    base = random.stream(5, torch.arange(4))
    key = torch.cat([random.noise_key(source) for source in (base, base.at(1), random.stream(6, torch.arange(1)))])
    fields = random.white_noise(key, NOISE_COUNT).flatten(0, 1).double()
    limit = stats.norm.isf(ALARM / 2 / 153) / math.sqrt(NOISE_COUNT)  # 18 fields have 153 pairs
    assert (torch.corrcoef(fields) - torch.eye(18)).abs().max() < limit
    assert (torch.corrcoef(fields.abs()) - torch.eye(18)).abs().max() < limit


@pytest.mark.parametrize("count", [0, 1, 7, 1_021, 65_536, 131_075])
def test_white_noise_depends_neither_on_the_count_nor_on_the_batch(count):
    key = noise_keys()
    noise = random.white_noise(key, count)
    assert torch.equal(noise, random.white_noise(key, 200_003)[:, :, :count])
    assert torch.equal(random.white_noise(key[1:2], count), noise[1:2])
    assert torch.equal(random.white_noise(key.flip(0), count), noise.flip(0))
    assert random.white_noise(key[:0], count).shape == (0, 2, count)


@pytest.mark.quick
def test_lattice_noise_depends_on_the_coordinates_only():
    rows, columns = torch.arange(-5, 60).expand(3, -1), torch.arange(2**33, 2**33 + 80).expand(3, -1)
    key = noise_keys(samples=3)
    noise = random.lattice_noise(key, [rows, columns], 3)
    window = random.lattice_noise(key[1:], [rows[1:, 7:20], columns[1:, 30:33]], 3)
    assert torch.equal(window, noise[1:, :, 7:20, 30:33])
    assert torch.equal(random.lattice_noise(key, [rows, columns], 2), noise[:, :2])


@pytest.mark.parametrize("sides", [(90_000,), (300, 300), (45, 40, 50)], ids=["1d", "2d", "3d"])
def test_lattice_noise_is_uniform_and_independent(sides):
    axes = [torch.arange(n).expand(2, -1) for n in sides]
    numbers = random.lattice_noise(noise_keys(samples=2), axes, 2).double()
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


@pytest.mark.quick
@pytest.mark.parametrize(
    ("name", "digest"),  # as `printf NAME | b2sum -l 64` prints it
    [
        ("", 0xE4A6A0577479B2B4),
        ("drive/0001.jpg", 0xBA615AFDF666345B),
        ("Kap/Fähre.jpg", 0xDFC1EE6F450C9A8C),
        (b"\xff.png".decode(errors="surrogateescape"), 0x9364C752A966B744),
    ],
)
def test_the_key_of_a_name_is_its_blake2b_digest_on_every_machine(name, digest):
    assert key_of(name) == digest >> 1 < 2**63
    assert key_of(PurePosixPath(name)) == (digest >> 1 if name else key_of("."))
    assert key_of(PureWindowsPath("drive", "0001.jpg")) == key_of("drive/0001.jpg")
    assert random.uniform(random.stream(0, torch.tensor([key_of(name)])), 1).shape == (1, 1)


@pytest.mark.quick
@pytest.mark.parametrize("name", [7, None])
def test_what_is_no_name_has_no_key(name):
    with pytest.raises(TypeError, match="name must be a text or a path, got"):
        key_of(name)
