"""What kernels find is the same on every processor, whatever its registers are."""

import os
import platform
import subprocess
import sys
from typing import Any

import pytest
import torch
from torch import Tensor

LANES = pytest.importorskip("torchrefract._lanes", reason="needs numba").LANES

# The names that numba and LLVM give, what is told of their registers, and how many lanes there are then.
PROCESSORS = {"haswell": ("+avx,+avx2,+fma", 8), "generic": ("", 0), "x86-64-v3": ("+avx2", 0)}

LOOK_UPS = """
noise = torch.rand(2, 2, 140, 181, generator=torch.Generator().manual_seed(1)) * 2 - 1
image = torch.rand(2, 3, 140, 181, generator=torch.Generator().manual_seed(2))
across = image.movedim(1, -1).contiguous().movedim(-1, 1)
for flow in (noise, noise * 30, torch.nn.functional.avg_pool2d(noise, 9, 1, 4) * 60):
    for source in (image, across, (image * 256).to(torch.uint8), (across * 256).to(torch.uint8)):
        for padding in ("zeros", "border", "reflection"):
            a, b = (warp(source, flow, padding=padding, resampler=name)[0] for name in ("numba", "grid_sample"))
            assert torch.equal(a, b), (source.dtype, padding)
"""
FLOWS = """
def smooth(stride):
    lattice = Lattice(140, 181, stride)
    size = [len(axis) for axis in lattice.axes()]
    return SmoothFlow(torch.randn(2, 2, *size, generator=torch.Generator().manual_seed(stride)), lattice)
rough = smooth(2).with_nodes(9 * smooth(2).nodes)
flow = FollowedFlow(replace(smooth(30), every=3), (smooth(20), rough, smooth(7).dense()))
found.append(flow.sampler_grid(torch.float32))
"""
FOG = """
fog = HeterogeneousFog(mode="ray", decorrelation_range=(5.0, 9.0))
found += [fog.degrade(torch.zeros(2, 2, 1, 131, width), seed=3).extinction for width in (70, 256)]
depth = 300 * torch.rand(2, 1, 131, 70, generator=torch.Generator().manual_seed(1))
found.append(fog.degrade(torch.zeros(2, 1, 131, 70), depth=depth, seed=3).extinction)
for width in (7, 256, 300):
    for linear in (False, True):
        leaf = torch.linspace(0, 1, 244 * width).view(2, 2, 1, 61, width).requires_grad_()
        degraded = HeterogeneousFog(linear_light=linear, tolerance=0.3).degrade(leaf, seed=3)
        found += [degraded.extinction, degraded.image.detach(), *torch.autograd.grad(degraded.image.sum(), leaf)]
"""
OF = {"haswell": (FLOWS, FOG), "generic": (FLOWS, FOG), "x86-64-v3": (FLOWS,)}
PROGRAM = """
from dataclasses import replace
import torch
from torchrefract import HeterogeneousFog, warp
from torchrefract.warping.followed import FollowedFlow
from torchrefract.warping.lattice import Lattice, SmoothFlow
found = []
"""


@pytest.fixture(scope="module")
def here() -> dict[str, list[Tensor]]:
    """What this processor finds."""
    found = dict[str, list[Tensor]]()
    for part in (FLOWS, FOG):
        names = dict[str, Any]()
        exec(PROGRAM + part, names)
        found[part] = names["found"]
    return found


@pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="the names are those of x86 processors")
# What the lanes of this processor itself find is asked by all other tests.
@pytest.mark.parametrize("name", [name for name, (_, lanes) in PROCESSORS.items() if lanes == 0 or lanes != LANES])
def test_every_processor_finds_the_same(name, here, tmp_path):
    features, lanes = PROCESSORS[name]
    told = {"NUMBA_CPU_NAME": name, "NUMBA_CPU_FEATURES": features, "NUMBA_CACHE_DIR": str(tmp_path)}
    check = f"from torchrefract._lanes import LANES\nassert LANES == {lanes}, LANES"
    program = "\n".join((PROGRAM, check, LOOK_UPS, *OF[name], f"torch.save(found, {str(tmp_path / 'found.pt')!r})"))
    words = [sys.executable, "-c", program]
    done = subprocess.run(words, env=os.environ | told, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    expected = [value for part in OF[name] for value in here[part]]
    assert all(torch.equal(*both) for both in zip(torch.load(tmp_path / "found.pt"), expected, strict=True))
