import pytest
import torch
from torch.testing import assert_close

from torchrefract.restoration.models.segformer import SegFormer


def test_the_baseline_of_the_paper_has_13_7_million_parameters():
    # Table 7 of its authors: B1 has 13.7 M.
    assert sum(parameter.numel() for parameter in SegFormer(2).parameters()) == pytest.approx(13.7e6, rel=0.005)


@torch.no_grad()
def test_what_it_says_of_a_cell_is_what_its_last_layer_makes_of_it():
    # The library would enlarge by 4 between the corner pixels, which shifts the answer by up to 1.5 px.
    torch.manual_seed(0)
    network = SegFormer(2, encoder="mit_b0").eval()
    head = network.network.segmentation_head[0]
    torch.nn.init.normal_(head.weight)
    torch.nn.init.zeros_(head.bias)
    seen = []
    head.register_forward_hook(lambda _, inputs, outputs: seen.append((inputs[0], outputs)))
    found = network(torch.rand(1, 3, 64, 96))
    features, answer = seen[0]
    assert features.shape[2:] == (16, 24)
    assert torch.equal(found, answer)
    assert_close(found, torch.einsum("oc,bchw->bohw", head.weight[:, :, 0, 0], features), rtol=1e-4, atol=1e-4)
