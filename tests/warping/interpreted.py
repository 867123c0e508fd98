"""The kernels for GPUs on the CPU, by Triton's interpreter, beside F.grid_sample and numpy: what they find, as JSON.

For a process of its own, whose environment says TRITON_INTERPRET=1.
"""

import importlib
import json

import torch
import torch.nn.functional as F
from torch import Tensor

from torchrefract.warping.lattice import Lattice, LatticeFlow, StreamFlow

# What is interpreted is no kernel that compilers could see into.
torch.library.wrap_triton = lambda kernel: kernel
on_gpu = importlib.import_module("torchrefract.warping.on_gpu")
importlib.import_module("torchrefract.warping.gpu_look_up")

SIDES = 9, 40
KINDS = {"cubics": (LatticeFlow, 2, Lattice(*SIDES, 8)), "stream": (StreamFlow, 1, Lattice(*SIDES, 8, 3, 2))}
LAYOUTS = {"rows": torch.contiguous_format, "last": torch.channels_last}
# A kind of flow; samples that have one; how the image lies in memory; padding; whether one sample is left alone.
CASES = [
    ("cubics", 2, "rows", "zeros", True),
    ("cubics", 1, "last", "border", False),
    ("cubics", 2, "last", "reflection", False),
    ("stream", 1, "rows", "zeros", False),
    ("stream", 2, "last", "reflection", True),
]


def main() -> None:
    """Print the errors of all cases of the look-up."""
    print(json.dumps({"look_up": {"-".join(map(str, case)): errors(*case) for case in CASES}}))


def errors(kind: str, rows: int, layout: str, padding: str, masked_flow: bool) -> dict[str, float]:
    """How far image and gradients are from those of F.grid_sample in float64, and how far float32 is by itself."""
    torch.manual_seed(0)
    form, channels, lattice = KINDS[kind]
    sides = [len(axis) for axis in lattice.axes()]
    nodes = (30 * torch.rand(rows, channels, *sides) - 15).requires_grad_()
    size = (2, 5 if padding == "border" else 3, *SIDES)  # a few planes are unrolled, more are not
    source = torch.rand(size).to(memory_format=LAYOUTS[layout]).requires_grad_()
    active = torch.tensor([True, False]) if masked_flow else None
    towards = torch.rand(source.shape)
    spread = nodes if rows == 2 else nodes.expand(2, -1, -1, -1)
    found = on_gpu.looked_up(source, form(spread, lattice), padding=padding, active=active)
    assert found.is_contiguous(memory_format=LAYOUTS[layout])
    assert active is None or torch.equal(found[~active], source[~active])
    exact, alike = (
        by_grid_sample(source.to(dtype), form(nodes.to(dtype), lattice), padding, active)
        for dtype in (torch.double, torch.float)
    )
    results = {"image": (found, exact, alike)}
    gradients = [
        torch.autograd.grad(image, (source, nodes), towards.to(image.dtype)) for image in (found, exact, alike)
    ]
    results |= dict(zip(("source", "nodes"), zip(*gradients, strict=True), strict=True))
    return {
        f"{name}{which}": ((value - true).abs().max() / true.abs().max()).item()
        for name, (own, true, plain) in results.items()
        for which, value in (("", own), (" by PyTorch", plain))
    }


def by_grid_sample(source: Tensor, flow: LatticeFlow, padding: str, active: Tensor | None) -> Tensor:
    """The same by PyTorch's operations."""
    grid = flow.lines(source.dtype).grid().expand(len(source), -1, -1, -1)
    found = F.grid_sample(source, grid, padding_mode=padding, align_corners=False)
    return found if active is None else torch.where(active.view(-1, 1, 1, 1), found, source)


if __name__ == "__main__":
    main()
