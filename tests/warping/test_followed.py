from dataclasses import replace

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from torchrefract import compose_flows
from torchrefract.warping.followed import FollowedFlow, Reading
from torchrefract.warping.grid import sampler_grid
from torchrefract.warping.lattice import FARTHEST, Lattice, SmoothFlow
from torchrefract.warping.mixed import dense
from torchrefract.warping.resample import look_up

SIZE = (131, 190)
LINEAR = {"padding": "border", "interpolation": "bilinear"}


def smooth(seed: int, stride: int, *, batch: int = 2, height: int = SIZE[0], width: int = SIZE[1]) -> SmoothFlow:
    lattice = Lattice(height, width, stride)
    size = [len(axis) for axis in lattice.axes()]
    return SmoothFlow(torch.randn(batch, 2, *size, generator=torch.Generator().manual_seed(seed)).double(), lattice)


def lines_between(values: Tensor, every: int, *, height: int, width: int) -> Tensor:
    """At every pixel, from values that are known every few px, by one line along each axis: without a sampler."""

    def along(values: Tensor, size: int) -> Tensor:
        place = torch.arange(size)
        first = (place // every).clamp(max=max(values.shape[-1] - 2, 0))
        return torch.lerp(values[..., first], values[..., first + 1], (place - every * first).double() / every)

    return along(along(values, width).mT, height).mT


@pytest.mark.parametrize("every", [2, 3, 4])
@pytest.mark.parametrize("stride", [2, 3, 5, 8, 12])
@pytest.mark.parametrize(("height", "width"), [(33, 48), (40, 41), (64, 25)])
def test_what_is_known_every_few_px_is_the_flow_there(every, stride, height, width):
    flow = replace(smooth(stride, stride, height=height, width=width), every=every)
    found, pixels = flow.read(), flow.dense()
    rows, columns = ((size - 1) // every + 1 for size in (height, width))
    torch.testing.assert_close(found[:, :, :rows, :columns], pixels[:, :, ::every, ::every], rtol=0, atol=1e-12)
    # Behind the frame it is what the cubics of the last cell, or a node behind it, say: all of the frame lies between.
    assert [every * (size - 1) for size in found.shape[2:]] == [
        -(-(size - 1) // every) * every for size in (height, width)
    ]
    more = Lattice(height + every, width + every, stride)
    around = F.pad(flow.nodes, (0, 9, 0, 9), mode="replicate")[:, :, : len(more.axes()[0]), : len(more.axes()[1])]
    behind = SmoothFlow(around, more).dense()[:, :, ::every, ::every][:, :, : found.shape[2], : found.shape[3]]
    inner = [axis[-1] >= every * (size - 1) for axis, size in zip(flow.lattice.axes(), found.shape[2:], strict=True)]
    assert all(inner)
    torch.testing.assert_close(found, behind, rtol=0, atol=1e-12)


@pytest.mark.parametrize("every", [1, 2, 4])
def test_a_flow_is_read_by_lines_between_what_is_known(every, oracle):
    flow = replace(smooth(1, 12), every=every)
    between = lines_between(flow.read(), every, height=SIZE[0], width=SIZE[1]) if every > 1 else flow.dense()
    then = 8 * dense(smooth(2, 16))
    grid, (height, width) = sampler_grid(then), SIZE
    found = (Reading.of(flow).followed(grid) - grid).movedim(-1, 1) * grid.new_tensor((width / 2, height / 2))[
        :, None, None
    ]
    expected = look_up(between, then, **LINEAR)
    oracle("flow read every few px", found, expected, 1e-9)
    assert (expected - look_up(flow.dense(), then, **LINEAR)).abs().max() > (1e-3 if every > 1 else -1)


def test_flows_in_a_row_are_the_composite(oracle):
    first, middle, last = smooth(1, 20), smooth(2, 12), smooth(3, 16)
    flow = FollowedFlow(last, (Reading.of(middle), Reading.of(first.dense())))
    composite = compose_flows(first.dense(), compose_flows(middle.dense(), last.dense()))
    oracle("composite of three flows", flow.dense(), composite, 1e-9)
    oracle(
        "composite of three flows, positions", flow.sampler_grid(torch.float64), sampler_grid(composite), 1e-9, unit=""
    )
    for row in (0, 1):
        alone = flow.rows(torch.tensor([row]))
        assert torch.equal(alone.dense(), flow.dense()[row : row + 1])


def test_kernels_read_what_is_read_without_them(monkeypatch, oracle):
    def single(flow: SmoothFlow, every: int) -> SmoothFlow:
        return replace(flow.with_nodes(flow.nodes.float()), every=every)

    flow = FollowedFlow(
        single(smooth(3, 16), 1), tuple(Reading.of(single(smooth(i, 12), every)) for i, every in enumerate((2, 4, 1)))
    )
    found = flow.sampler_grid(torch.float32)
    monkeypatch.setattr("torchrefract._compiled.kernels", lambda _: None)
    plain = flow.sampler_grid(torch.float32)
    oracle("flows in a row, without numba", found, plain, 1e-6, unit="")
    double = FollowedFlow(smooth(3, 16), tuple(own.to(torch.float64) for own in flow.earlier))
    oracle("flows in a row, float64", found.double(), double.sampler_grid(torch.float64), 1e-6, unit="")


def test_what_lies_anywhere_in_memory_is_not_read():
    flow = smooth(1, 12).dense().float().mT
    with pytest.raises(ValueError, match="values must have the planes of a row one after the other, got strides"):
        Reading(flow, 1, SIZE, FARTHEST).addresses()
    # What is made of a flow lies as it has to.
    assert Reading.of(flow).values[0].is_contiguous()
    assert torch.equal(Reading.of(flow).values, flow)
