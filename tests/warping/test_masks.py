import math

import pytest
import torch
import torch.nn.functional as F
from torch.utils._python_dispatch import TorchDispatchMode

from torchrefract.warping.grid import inside, pixel_axes, sampler_grid
from torchrefract.warping.invert import invert_flow
from torchrefract.warping.warp import mixes_only

SIZES = [(1, 1), (3, 40), (37, 53), (96, 128)]


def smooth(seed: int, size: tuple[int, int], px: float) -> torch.Tensor:
    """(2, 2, H, W), px: flows of about so many px."""
    coarse = torch.randn(2, 2, 4, 5, generator=torch.Generator().manual_seed(seed))
    return px * F.interpolate(coarse, size=size, mode="bilinear")


def looked_up(good: torch.Tensor, flow: torch.Tensor) -> torch.Tensor:
    """What `mixes_only` says, of every pixel."""
    return F.grid_sample(good.to(flow.dtype), sampler_grid(flow), align_corners=False) > 0.999


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("px", [0.0, 0.3, 2.0, 9.0, 400.0])
def test_inside_is_what_its_formula_says_of_every_pixel(size, px):
    height, width = size
    flow = smooth(0, size, px)
    x, y = pixel_axes(height, width, dtype=torch.float64, device=flow.device)
    u, v = flow.double().split(1, dim=1)
    expected = (x + u >= -1e-3) & (x + u <= width - 1 + 1e-3) & (y + v >= -1e-3) & (y + v <= height - 1 + 1e-3)
    assert torch.equal(inside(flow), expected)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 1e30])
@pytest.mark.parametrize("place", [(0, 0), (48, 64)])
def test_what_leads_nowhere_is_not_inside_wherever_it_lies(value, place):
    flow = torch.zeros(2, 2, 96, 128)
    flow[1, 1, place[0], place[1]] = value
    expected = torch.ones(2, 1, 96, 128, dtype=torch.bool)
    expected[1, 0, place[0], place[1]] = False
    assert torch.equal(inside(flow), expected)


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("px", [0.0, 0.3, 2.0, 9.0])
@pytest.mark.parametrize("lost", [0.0, 0.3, 2.0, 9.0])
def test_a_mask_mixes_only_good_pixels_where_a_look_up_of_every_pixel_says_so(size, px, lost):
    flow, good = smooth(1, size, px), inside(smooth(2, size, lost))
    assert torch.equal(mixes_only(good, flow), looked_up(good, flow))


@pytest.mark.parametrize("hole", [(48, 64), (20, 30), (2, 64), (48, 3)])
def test_a_hole_in_a_mask_is_found_wherever_it_lies(hole):
    good, flow = torch.ones(2, 1, 96, 128, dtype=torch.bool), smooth(3, (96, 128), 1.5)
    good[1, 0, hole[0], hole[1]] = False
    found = mixes_only(good, flow)
    assert torch.equal(found, looked_up(good, flow))
    assert not found[1].all()


def test_each_of_a_batch_is_told_by_itself():
    flow, good = smooth(4, (96, 128), 2.0), inside(smooth(5, (96, 128), 3.0))
    flow[1] *= 20
    together = mixes_only(good, flow)
    for i in range(2):
        assert torch.equal(together[i : i + 1], mixes_only(good[i : i + 1], flow[i : i + 1]))


def test_a_map_over_samples_and_a_compiled_graph_say_the_same():
    flow, good = smooth(6, (96, 128), 2.0), inside(smooth(7, (96, 128), 3.0))
    expected = mixes_only(good, flow)
    mapped = torch.vmap(lambda mask, own: mixes_only(mask[None], own[None])[0])(good, flow)
    assert torch.equal(mapped, expected)
    compiled = torch.compile(mixes_only, backend="aot_eager", fullgraph=True)
    assert torch.equal(compiled(good, flow), expected)
    assert torch.equal(torch.compile(inside, backend="aot_eager", fullgraph=True)(flow), inside(flow))


class _Named(TorchDispatchMode):
    """The names of the operations that run."""

    def __init__(self):
        super().__init__()
        self.names: list[str] = []

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        self.names.append(func.overloadpacket.__name__)
        return func(*args, **(kwargs or {}))


def test_on_a_device_nothing_is_computed_that_could_not_be_read():
    flow = torch.empty(2, 2, 96, 128, device="meta")
    with _Named() as ran:
        good = inside(flow)
        mixes_only(good, flow)
        invert_flow(flow)
    assert "grid_sampler_2d" in ran.names
    assert not {"amin", "amax", "aminmax", "_local_scalar_dense"} & set(ran.names)
