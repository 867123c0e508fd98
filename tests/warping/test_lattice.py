import pytest
import torch

from torchrefract.warping.lattice import Lattice, LatticeFlow, StreamFlow, along_rows

SIZES = [(1, 2), (3, 4), (4, 4), (5, 6), (12, 6), (16, 12), (24, 8), (33, 31), (40, 11), (64, 31)]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("stride", [2, 3, 5, 7, 12, 20])
def test_a_sample_is_read_alike_in_any_batch(stride, dtype):
    source = torch.Generator().manual_seed(stride)
    for height, width in SIZES:
        for kind, channels, around in ((LatticeFlow, 2, (1, 1)), (StreamFlow, 1, (3, 2))):
            lattice = Lattice(height, width, stride, *around)
            nodes = torch.randn(3, channels, *map(len, lattice.axes()), generator=source, dtype=dtype)
            together = kind(nodes, lattice)
            for i in range(3):
                # Of its own memory: products of matrices may round by where they begin.
                alone = kind(nodes[i : i + 1].clone(), lattice)
                assert torch.equal(together.dense()[i : i + 1], alone.dense()), (height, width)
                assert torch.equal(together.sampler_grid(dtype)[i : i + 1], alone.sampler_grid(dtype)), (height, width)
                if kind is LatticeFlow:
                    own = along_rows(alone.nodes, lattice)
                    assert torch.equal(along_rows(nodes, lattice)[i : i + 1], own), (height, width)
