import math
import sys

import pytest
import torch
from scipy import stats
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from torchrefract import draw_operators, draws
from torchrefract.threefry import threefry

WORD = 2**32
COUNT = 20_000
# The chance of a false alarm of each statistical test; the draws are fixed, so each passes for good or never.
ALARM = 1e-4


def words(high: int, low: int) -> tuple[Tensor, Tensor]:
    return torch.tensor([high]), torch.tensor([low])


def threefry_of_whole_numbers(key: tuple[int, int], counter: tuple[int, int]) -> tuple[int, int]:
    """Threefry-2x32-20 as its paper states it, round by round, in Python's own integers."""
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


def correlation(a: Tensor, b: Tensor) -> float:
    return torch.corrcoef(torch.stack([a.flatten(), b.flatten()]).double())[0, 1].item()


class Calls(TorchDispatchMode):
    """The operators that are called on the device "meta", which stands for one that is far."""

    def __init__(self):
        super().__init__()
        self.names = list[str]()

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        result = func(*args, **(kwargs or {}))
        values = tree_leaves((args, kwargs, result))
        if any(isinstance(value, Tensor) and value.is_meta for value in values):
            self.names.append(func.overloadpacket.__name__)
        return result


@pytest.mark.parametrize("keys", [range(3), range(50), torch.arange(50)], ids=["few", "many", "tensor"])
def test_a_device_that_is_far_only_gets_copies(keys):
    source = draws.stream(5, keys, device=torch.device("meta"))
    with Calls() as calls:
        found = [
            draws.uniform(source, 4),
            draws.between(source.at(1), [(0.0, 1.0)] * 3, dtype=torch.float64),
            draws.normal(draws.fold(source), 4),
            draws.noise_key(source),
        ]
    assert all(value.is_meta for value in found)
    assert set(calls.names) <= {"_to_copy", "empty_strided", "copy_", "detach"}
    assert len(calls.names) <= 3 * len(found)
    assert not draws.uniform(source.to(torch.device("cpu")), 4).is_meta


@pytest.mark.parametrize(
    ("key", "counter", "answer"),
    [
        ((0, 0), (0, 0), (0x6B200159, 0x99BA4EFE)),
        ((WORD - 1, WORD - 1), (WORD - 1, WORD - 1), (0x1CB996FC, 0xBB002BE7)),
        ((0x13198A2E, 0x03707344), (0x243F6A88, 0x85A308D3), (0xC4923A9C, 0x483DF7A0)),
    ],
)
def test_threefry_gives_the_known_answers_of_random123(key, counter, answer):
    assert tuple(word.item() for word in threefry(words(*key), words(*counter))) == answer
    assert threefry_of_whole_numbers(key, counter) == answer


@pytest.mark.parametrize("count", [0, 1, 8, 9, 50])  # whole numbers, arrays and tensors each have their turn
@pytest.mark.parametrize("mapped", [False, True], ids=["plain", "vmap"])
def test_threefry_agrees_with_whole_number_arithmetic_on_random_words(count, mapped):
    table = torch.randint(WORD, (4, count), generator=torch.Generator().manual_seed(count))

    def draw(words: Tensor) -> Tensor:
        return torch.stack(threefry((words[0], words[1]), (words[2], words[3])))

    found = torch.func.vmap(draw, in_dims=1, out_dims=1)(table) if mapped and count else draw(table)
    expected = [threefry_of_whole_numbers((a, b), (c, d)) for a, b, c, d in table.T.tolist()]
    assert list(map(tuple, found.T.tolist())) == expected


def test_the_words_of_keys_and_counters_that_broadcast_are_those_of_each_pair():
    keys, counters = torch.tensor([[3], [5]]), torch.tensor([[0, 1, 2]])
    x, y = threefry((keys, keys), (counters, torch.zeros_like(counters)))
    assert x.shape == y.shape == (2, 3)
    for i, key in enumerate((3, 5)):
        for j in range(3):
            assert (x[i, j].item(), y[i, j].item()) == threefry_of_whole_numbers((key, key), (j, 0))


@pytest.mark.parametrize("seed", [0, 1, -1, 7, 2**31, 2**32 + 5, -(2**63), 2**63 - 1, 2**64 - 1, 2**64 + 5, -(10**30)])
@pytest.mark.parametrize("key", [0, 1, -1, 2**32, 2**63 - 1, -(2**63)])
def test_uniform_numbers_follow_seed_key_and_lane_by_definition(seed, key):
    halves = [((value % 2**64) // WORD, value % WORD) for value in (seed, key)]
    parent = threefry_of_whole_numbers(halves[0], halves[1])
    source = draws.stream(seed, torch.tensor([key])).at(3)
    first, second = (threefry_of_whole_numbers(parent, (i, 3)) for i in (0, 1))
    expected = [((word >> 9) + 0.5) / 2**23 for word in (first[0], second[0], first[1])]
    assert draws.uniform(source, 3)[0].tolist() == expected


def test_a_seed_may_be_a_tensor():
    keys = torch.arange(4)
    for seed in (5, -5, 2**62):
        as_tensor = draws.stream(torch.tensor(seed), keys)
        assert torch.equal(draws.uniform(as_tensor, 8), draws.uniform(draws.stream(seed, keys), 8))


def test_seed_and_key_do_not_stand_for_each_other():
    assert not torch.equal(
        draws.uniform(draws.stream(1, torch.tensor([2])), 8), draws.uniform(draws.stream(2, torch.tensor([1])), 8)
    )


def test_uniform_numbers_are_uniform():
    numbers = draws.uniform(draws.stream(0, torch.arange(4)), COUNT).double()
    assert stats.kstest(numbers.flatten().numpy(), "uniform").pvalue > ALARM
    # Equidistribution of pairs of neighbors, which a test of single numbers does not see.
    pairs = numbers.view(-1, 2).mul(16).long()
    cells = torch.bincount(pairs[:, 0] * 16 + pairs[:, 1], minlength=256)
    assert stats.chisquare(cells.numpy()).pvalue > ALARM


def test_normal_numbers_are_normal():
    numbers = draws.normal(draws.stream(1, torch.arange(4)), COUNT).double()
    assert stats.kstest(numbers.flatten().numpy(), "norm").pvalue > ALARM
    radius2 = torch.stack(numbers.chunk(2, dim=1)).square().sum(dim=0)
    assert stats.kstest(radius2.flatten().numpy(), "chi2", args=(2,)).pvalue > ALARM


@pytest.mark.parametrize("word", [0, WORD - 1])
@pytest.mark.parametrize("count", [4, 140])  # as whole numbers, and as arrays
def test_the_ends_of_the_range_are_open_and_their_normals_finite(monkeypatch, word, count):
    monkeypatch.setattr(draw_operators, "kernels", lambda _: None)
    for module in (draws, draw_operators, sys.modules["torchrefract.threefry"]):
        monkeypatch.setattr(module, "rounds", lambda *numbers: (sum(numbers) * 0 + word,) * 2)
    source = draws.Stream(words(0, 0))
    numbers = draws.uniform(source, count)
    assert (numbers == (2.0**-24 if word == 0 else 1 - 2.0**-24)).all()
    assert draws.normal(source, count).abs().max() <= math.sqrt(48 * math.log(2)) * (1 + 1e-6)


@pytest.mark.parametrize("count", [1, 2, 3, 8, 17])
@pytest.mark.parametrize("kind", [draws.uniform, draws.normal])
def test_every_count_gives_so_many_different_numbers_for_each_sample(kind, count):
    numbers = kind(draws.stream(2, torch.arange(5)), count)
    assert numbers.shape == (5, count)
    assert numbers.unique().numel() == 5 * count


def test_a_sample_does_not_depend_on_the_batch_around_it():
    keys = torch.tensor([9, -4, 2**40, 7])
    together = draws.normal(draws.stream(3, keys).at(1), 33)
    for i in range(4):
        assert torch.equal(draws.normal(draws.stream(3, keys[i : i + 1]).at(1), 33)[0], together[i])
    assert torch.equal(draws.normal(draws.stream(3, keys.flip(0)).at(1), 33), together.flip(0))


def test_keys_lanes_folds_and_seeds_are_independent():
    base = draws.stream(4, torch.tensor([0]))
    others = {
        "next key": draws.stream(4, torch.tensor([1])),
        "key of another high word": draws.stream(4, torch.tensor([2**32])),
        "next seed": draws.stream(5, torch.tensor([0])),
        "seed of another high word": draws.stream(4 + 2**32, torch.tensor([0])),
        "next lane": base.at(1),
        "far lane": base.at(2**31),
        "fold": draws.fold(base),
        "fold of a lane": draws.fold(base.at(1)),
        "fold of a fold": draws.fold(draws.fold(base)),
    }
    numbers = {"base": draws.uniform(base, COUNT)} | {name: draws.uniform(s, COUNT) for name, s in others.items()}
    limit = stats.norm.isf(ALARM / 2) / math.sqrt(COUNT)
    names = list(numbers)
    for i, a in enumerate(names):
        for b in names[:i]:
            assert abs(correlation(numbers[a], numbers[b])) < limit, (a, b)


def test_a_fold_keeps_its_samples_apart_and_ignores_the_batch():
    parent = draws.stream(6, torch.arange(3)).at(2)
    numbers = draws.uniform(draws.fold(parent), 4)
    assert numbers.unique().numel() == 12
    alone = draws.stream(6, torch.tensor([1])).at(2)
    assert torch.equal(draws.uniform(draws.fold(alone), 4)[0], numbers[1])


def test_a_call_seed_follows_the_global_generator():
    torch.manual_seed(11)
    first = [draws.call_seed().item() for _ in range(3)]
    torch.manual_seed(11)
    assert [draws.call_seed().item() for _ in range(3)] == first
    assert len(set(first)) == 3
    torch.manual_seed(12)
    assert draws.call_seed().item() != first[0]


def test_compiled_code_takes_the_same_seeds_as_eager_code():
    compiled = torch.compile(lambda: draws.call_seed() ^ 1, fullgraph=True)
    torch.manual_seed(11)
    expected = [(draws.call_seed() ^ 1).item() for _ in range(3)]
    torch.manual_seed(11)
    assert [compiled().item() for _ in range(3)] == expected


def test_compiled_code_draws_the_same_numbers_as_eager_code():
    keys = torch.tensor([0, -5, 2**40])
    compiled = torch.compile(lambda keys: draws.normal(draws.stream(3, keys), 7), fullgraph=True, backend="aot_eager")
    assert torch.equal(compiled(keys), draws.normal(draws.stream(3, keys), 7))
