"""Print the errors of the Triton kernel against the PyTorch reference as JSON; run it with TRITON_INTERPRET=1."""

import importlib
import json

import torch

from torchrefract.ops.sampling import lagrange_weights, sample

# The interpreter runs Python, not a kernel that a compiler could see into.
torch.library.wrap_triton = lambda kernel: kernel
triton_gpu = importlib.import_module("torchrefract.ops.triton_gpu")

HEIGHT, WIDTH, STRIDE = 9, 40, 8
# Flows in the batch; margin of the lattice; channels; memory format; padding; True if one sample is inactive.
CASES = [
    (2, 1, 3, torch.contiguous_format, "zeros", True),
    (1, 2, 5, torch.channels_last, "border", False),
    (2, 1, 3, torch.channels_last, "reflection", True),
]


def error(flows: int, margin: int, channels: int, layout: torch.memory_format, padding: str, has_active: bool) -> float:
    """Return the largest difference from the reference in float64."""
    torch.manual_seed(0)
    image = torch.rand(2, channels, HEIGHT, WIDTH).to(memory_format=layout)
    rows, columns = (-(-size // STRIDE) + 1 + 2 * margin for size in (HEIGHT, WIDTH))
    nodes = 30 * torch.rand(flows, 2, rows, columns) - 15
    active = torch.tensor([True, False]) if has_active else None
    weights = lagrange_weights(STRIDE, dtype=torch.float32, device=image.device)
    options = {"margin": margin, "padding": padding, "active": active}
    sampled = triton_gpu.sample_lattice(image, nodes, weights, limit=1e4, **options)
    reference = sample(image.double(), nodes, stride=STRIDE, interpolation="bilinear", backend="torch", **options)
    assert sampled.is_contiguous(memory_format=layout)
    assert active is None or torch.equal(sampled[1], image[1])
    return (sampled - reference).abs().max().item()


if __name__ == "__main__":
    print(json.dumps([error(*case) for case in CASES]))
