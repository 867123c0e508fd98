from typing import Any

import pytest
import torch

from torchrefract import warp
from torchrefract.warping.lattice import Lattice, LatticeFlow, StreamFlow
from torchrefract.warping.mixed import Flow, MixedFlow, dense, flow_rows, grid_of, known
from torchrefract.warping.warp import sample_image

HEIGHT, WIDTH = 33, 47


def smooth(seed: int, rows: int, stride: int) -> LatticeFlow:
    lattice = Lattice(HEIGHT, WIDTH, stride)
    size = [len(axis) for axis in lattice.axes()]
    return LatticeFlow(torch.randn(rows, 2, *size, generator=torch.Generator().manual_seed(seed)), lattice)


@pytest.fixture
def forms() -> tuple[LatticeFlow, LatticeFlow, torch.Tensor]:
    return smooth(0, 2, 8), smooth(1, 1, 5), dense(smooth(2, 2, 6))


@pytest.fixture
def flow(forms) -> MixedFlow:
    return MixedFlow(tuple(zip((torch.tensor([4, 1]), torch.tensor([2]), torch.tensor([0, 3])), forms, strict=True)))


@pytest.fixture
def rows(forms) -> list[Flow]:
    """Each row by itself."""
    first, second, third = forms
    order = ((third, 0), (first, 1), (second, 0), (third, 1), (first, 0))
    return [flow_rows(form, torch.tensor([i])) for form, i in order]


def test_each_row_is_what_it_is_alone(flow, rows):
    assert torch.equal(dense(flow), torch.cat([dense(row) for row in rows]))
    assert torch.equal(grid_of(flow, torch.float32), torch.cat([grid_of(row, torch.float32) for row in rows]))
    image = torch.rand(5, 3, HEIGHT, WIDTH)
    options: dict[str, Any] = {"padding": "border", "interpolation": "bilinear"}
    found = sample_image(image, flow, **options)
    assert torch.equal(found, torch.cat([sample_image(image[i : i + 1], row, **options) for i, row in enumerate(rows)]))
    assert torch.allclose(found, warp(image, dense(flow), padding="border")[0], rtol=0, atol=1e-5)


def test_some_rows_are_those_in_their_order(flow, rows):
    for index in ([3], [4, 0, 2], [1, 1, 3, 3], [0, 1, 2, 3, 4]):
        expected = torch.cat([dense(rows[i]) for i in index])
        assert torch.equal(dense(flow_rows(flow, torch.tensor(index))), expected)


def test_it_knows_its_type_and_its_gradient(flow):
    assert flow.dtype is torch.float32
    assert known(flow) is flow.parts[0][1].nodes
    assert not flow.requires_grad
    leaf = flow.parts[2][1].clone().requires_grad_()
    learning = MixedFlow((*flow.parts[:2], (flow.parts[2][0], leaf)))
    assert learning.requires_grad
    assert not learning.detach().requires_grad
    dense(learning).sum().backward()
    assert torch.equal(leaf.grad, torch.ones_like(leaf))


@pytest.mark.parametrize("form", ["lattice", "stream", "dense"])
def test_rows_that_are_one_are_computed_once(form):
    lattice = Lattice(HEIGHT, WIDTH, 5, before=3, after=2)
    size = [len(axis) for axis in lattice.axes()]
    noise = torch.randn(1, 2, *size, generator=torch.Generator().manual_seed(8))
    nodes = noise[:, :1] if form == "stream" else noise
    forms: dict[str, tuple[Flow, Flow]] = {
        "lattice": (LatticeFlow(nodes, lattice), LatticeFlow(nodes.expand(6, -1, -1, -1), lattice)),
        "stream": (StreamFlow(nodes, lattice), StreamFlow(nodes.expand(6, -1, -1, -1), lattice)),
        "dense": (dense(smooth(0, 1, 8)), dense(smooth(0, 1, 8)).expand(6, -1, -1, -1)),
    }
    one, many = forms[form]
    found, grid = dense(many), grid_of(many, torch.float32)
    assert torch.equal(found, dense(one).expand_as(found))
    assert torch.equal(grid, grid_of(one, torch.float32).expand_as(grid))
    assert grid.stride(0) == found.stride(0) == 0
    image = torch.rand(6, 3, HEIGHT, WIDTH)
    options: dict[str, Any] = {"padding": "zeros", "interpolation": "bilinear"}
    assert torch.equal(sample_image(image, many, **options)[3:4], sample_image(image[3:4], one, **options))
