import pytest

from torchrefract.restoration.models.resunet import ResUNet


def test_the_baseline_of_the_paper_has_24_million_parameters():
    # ResNet34 without its classifier has 21.28 M, the decoder of segmentation-models-pytorch 3.15 M.
    assert sum(parameter.numel() for parameter in ResUNet(2).parameters()) == pytest.approx(24.4e6, rel=0.005)
