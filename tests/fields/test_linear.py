import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from torchrefract.fields.linear import solve


def systems(count: int, *, samples: int = 3, unknowns: int = 2) -> tuple[Tensor, Tensor]:
    """Random systems with zeros on the diagonal, as splines have them: without pivots none would be solved."""
    source = torch.Generator().manual_seed(count)
    system = torch.randn(samples, count, count, dtype=torch.float64, generator=source)
    system = system * (1 - torch.eye(count, dtype=torch.float64))
    return system, torch.randn(samples, count, unknowns, dtype=torch.float64, generator=source)


@pytest.mark.parametrize("count", [2, 5, 19, 103])
def test_solutions_are_those_of_lapack(count):
    system, right = systems(count)
    assert_close(solve(system, right), torch.linalg.solve(system, right), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("count", [2, 19, 103, 259])
def test_neither_threads_nor_the_batch_change_a_bit(count, on_threads):
    system, right = systems(count)
    found = []
    for threads in (1, 2, 3):
        on_threads(threads)
        found.append(solve(system, right))
    alone = torch.cat([solve(*one) for one in zip(system.split(1), right.split(1), strict=True)])
    for other in (*found[1:], alone):
        assert torch.equal(other, found[0])


def test_gradients_are_those_of_finite_differences():
    arguments = [value.requires_grad_() for value in systems(4, samples=2)]
    assert torch.autograd.gradcheck(solve, arguments)
    assert torch.autograd.gradgradcheck(solve, arguments)


def test_a_map_over_samples_is_the_batch():
    system, right = systems(5)
    mapped = torch.vmap(lambda a, b: solve(a[None], b[None])[0])(system, right)
    assert torch.equal(mapped, solve(system, right))
    one_for_all = torch.vmap(lambda b: solve(system, b[None]))(right)
    assert torch.equal(one_for_all[2], solve(system, right[2:].expand(3, -1, -1)))


def test_an_empty_batch_has_an_empty_solution():
    assert solve(torch.zeros(0, 4, 4), torch.zeros(0, 4, 2)).shape == (0, 4, 2)


def test_a_singular_system_has_no_solution_and_its_neighbors_have_theirs():
    system, right = systems(4)
    system[1] = 1.0
    found = solve(system, right)
    assert found[1].isnan().all()
    assert torch.equal(found[::2], solve(system[::2], right[::2]))
