from dataclasses import replace
from typing import Any

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from torchrefract import _compiled as compiled
from torchrefract import compose_flows
from torchrefract.warping.followed import FollowedFlow, followed, of_readings
from torchrefract.warping.grid import sampler_grid
from torchrefract.warping.lattice import Lattice, LatticeFlow
from torchrefract.warping.mixed import dense
from torchrefract.warping.warp import sample_image

SIZE = (131, 190)
LINEAR: dict[str, Any] = {"padding": "border", "interpolation": "bilinear"}


def smooth(seed: int, stride: int, *, batch: int = 2, height: int = SIZE[0], width: int = SIZE[1]) -> LatticeFlow:
    lattice = Lattice(height, width, stride)
    size = [len(axis) for axis in lattice.axes()]
    return LatticeFlow(torch.randn(batch, 2, *size, generator=torch.Generator().manual_seed(seed)).double(), lattice)


def wave(x: Tensor, y: Tensor, seed: int) -> Tensor:
    """(2, n, m), px, up to 6 px, anywhere; its waves are 140 px long and more."""
    a, b, c, d = 0.015 + 0.03 * torch.rand(4, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return 3 * torch.stack([(a * x + b * y + seed).sin() + (c * y).cos(), (d * x - a * y).cos() + (b * x).sin()])


def waves(seed: int, stride: int, dtype: torch.dtype = torch.float32) -> LatticeFlow:
    """The same on a lattice that it hardly loses anything on."""
    lattice = Lattice(*SIZE, stride)
    x, y = lattice.places(dtype=torch.float64, device=torch.device("cpu"))
    return LatticeFlow(wave(x[0, 0] + 0 * y[0, 0], y[0, 0] + 0 * x[0, 0], seed)[None].to(dtype), lattice)


def composite(*seeds: int) -> Tensor:
    """(1, 2, H, W), px, of waves, the last one first: without lattices or a sampler."""
    y, x = torch.meshgrid(*(torch.arange(size).double() for size in SIZE), indexing="ij")
    at_x, at_y = x, y
    for seed in seeds:
        # What is read outside of the frame is that of its border.
        u, v = wave(at_x.clamp(0, SIZE[1] - 1), at_y.clamp(0, SIZE[0] - 1), seed)
        at_x, at_y = at_x + u, at_y + v
    return torch.stack([at_x - x, at_y - y])[None]


def test_a_flow_is_read_by_lines_between_its_pixels(oracle):
    flow, then = smooth(1, 12), 8 * dense(smooth(2, 16))
    grid, (height, width) = sampler_grid(then), SIZE
    found = (followed(flow, grid) - grid).movedim(-1, 1) * grid.new_tensor((width / 2, height / 2))[:, None, None]
    oracle("flow read where another one looks", found, sample_image(flow.dense(), then, **LINEAR), 1e-9)


def test_flows_in_a_row_are_the_composite(oracle):
    first, middle, last = smooth(1, 20), smooth(2, 12), smooth(3, 16)
    flow = FollowedFlow(last, (middle, first.dense()))
    whole = compose_flows(first.dense(), compose_flows(middle.dense(), last.dense()))
    oracle("composite of three flows", flow.dense(), whole, 1e-9)
    oracle("composite of three flows, positions", flow.sampler_grid(torch.float64), sampler_grid(whole), 1e-9, unit="")
    for row in (0, 1):
        alone = flow.rows(torch.tensor([row]))
        assert torch.equal(alone.dense(), flow.dense()[row : row + 1])


def test_kernels_read_what_is_read_without_them(monkeypatch, oracle):
    pytest.importorskip("torchrefract._jit", reason="needs numba")

    def single(flow: LatticeFlow) -> LatticeFlow:
        return flow.with_nodes(flow.nodes.float())

    flow = FollowedFlow(single(smooth(3, 16)), (single(smooth(0, 12)), single(smooth(1, 12)).dense()))
    found = flow.sampler_grid(torch.float32)
    monkeypatch.setattr("torchrefract._compiled.kernels", lambda _: None)
    plain = flow.sampler_grid(torch.float32)
    oracle("flows in a row, without numba", found, plain, 1e-6, unit="")
    double = FollowedFlow(smooth(3, 16), (smooth(0, 12), smooth(1, 12).dense()))
    oracle("flows in a row, float64", found.double(), double.sampler_grid(torch.float64), 1e-6, unit="")


@pytest.mark.parametrize(("every", "bar"), [(1, 6e-3), (2, 6e-4), (3, 6e-4), (4, 1e-3), (5, 2e-3)])
def test_the_composite_is_known_every_few_px(every, bar, oracle):
    pytest.importorskip("torchrefract._jit", reason="needs numba")
    flow = FollowedFlow(replace(waves(1, 4), every=every), (waves(2, 3), waves(3, 2)))
    found, exact = flow.dense(), composite(1, 2, 3)
    # Flows on lattices are read by cubics, and by lines between pixels only where each pixel is followed.
    oracle(f"composite of waves, every {every} px", found, exact, bar)
    # At the sides it has kinks, which cubics alone would miss.
    px = max(every, 2)
    rows, columns = (px * (n // px - 3) for n in SIZE)
    alone = LatticeFlow(exact[:, :, ::px, ::px], Lattice(rows, columns, px)).dense()
    assert (alone - exact[:, :, px : px + rows, px : px + columns]).abs().amax() > 20 * (found - exact).abs().amax()


@pytest.mark.parametrize("every", [2, 3, 8])
@pytest.mark.parametrize("size", [(1, 17000), (17000, 1), (129, 128), (5, 4000)])
def test_frames_of_any_shape_are_followed(every, size, oracle):
    pytest.importorskip("torchrefract._jit", reason="needs numba")
    generator = torch.Generator().manual_seed(every)

    def flow(stride: int) -> LatticeFlow:
        lattice = Lattice(size[0], size[1], stride)
        rows, columns = map(len, lattice.axes())
        nodes = torch.rand(2, 2, rows, columns, generator=generator)
        return LatticeFlow(F.avg_pool2d(nodes, 3, 1, 1), lattice)

    flows = replace(flow(40), every=every), flow(50), flow(30)
    own = FollowedFlow(flows[0], flows[1:])
    last, *earlier = (each.with_nodes(each.nodes.double()) for each in flows)
    double = FollowedFlow(last, tuple(earlier))
    oracle("flows in a row, frames of any shape", own.dense(), double.dense(), 0.02)


def test_batch_and_threads_change_no_bit(on_threads):
    pytest.importorskip("torchrefract._jit", reason="needs numba")

    def single(flow: LatticeFlow) -> LatticeFlow:
        return replace(flow.with_nodes(flow.nodes.float()), every=3)

    flow = FollowedFlow(single(smooth(3, 16, batch=4)), (single(smooth(1, 12, batch=4)), single(smooth(2, 9, batch=4))))
    whole = flow.sampler_grid(torch.float32)
    for threads in (1, 2, 3, 8):
        on_threads(threads)
        for rows in ([0, 1, 2, 3], [2], [3, 1]):
            assert torch.equal(flow.rows(torch.tensor(rows)).sampler_grid(torch.float32), whole[rows])


@pytest.mark.parametrize("every", [1, 2, 5])
def test_images_have_the_gradients_of_grid_sample(every):
    pytest.importorskip("torchrefract._jit", reason="needs numba")
    flow = FollowedFlow(replace(waves(1, 6), every=every), (waves(2, 5), waves(3, 3)))
    image = torch.rand(1, 3, *SIZE, requires_grad=True)
    upstream = torch.rand(1, 3, *SIZE)
    found = sample_image(image, flow, padding="zeros", interpolation="bilinear")
    expected = F.grid_sample(image, flow.sampler_grid(torch.float32), align_corners=False)
    assert torch.equal(found, expected)
    both = (torch.autograd.grad(value, image, upstream)[0] for value in (found, expected))
    torch.testing.assert_close(*both, rtol=1e-5, atol=1e-6)


def test_what_is_asked_for_is_made_once(monkeypatch):
    pytest.importorskip("torchrefract._jit", reason="needs numba")
    flow, asked = FollowedFlow(replace(waves(1, 6), every=2), (waves(2, 5),)), list[str]()
    kernels = compiled.kernels
    monkeypatch.setattr(compiled, "kernels", lambda name: asked.append(name) or kernels(name))
    image = torch.rand(1, 3, *SIZE, requires_grad=True)
    sample_image(image, flow, padding="zeros", interpolation="bilinear").sum().backward()
    assert asked.count("warping.kernels.composed") == 1


def test_what_lies_anywhere_in_memory_is_not_read():
    flow = smooth(1, 12).dense().float().mT
    with pytest.raises(ValueError, match="values must have the planes of a row in one piece, got strides"):
        of_readings([flow], [0], far=[4.0], size=SIZE)
    # What is made of a flow lies as it has to.
    last = smooth(2, 12, height=SIZE[1], width=SIZE[0])
    last = last.with_nodes(last.nodes.float())
    apart, together = (FollowedFlow(last, (own,)).sampler_grid(torch.float32) for own in (flow, flow.contiguous()))
    assert torch.equal(apart, together)
