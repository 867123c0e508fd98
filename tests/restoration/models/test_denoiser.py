from functools import partial

import huggingface_hub.constants
import pytest
import torch
from diffusers import UNet2DModel
from torch import Tensor
from torch.testing import assert_close

from torchrefract.restoration.models.coordconv import pixel_coordinates
from torchrefract.restoration.models.denoiser import Denoiser, conditions

TINY = {"widths": (8, 16), "attention": (False, True), "layers": 1, "groups": 4}
tiny = partial(Denoiser, **TINY)


def published(widths: tuple[int, ...] = (8, 16), **changes) -> UNet2DModel:
    """Return a network for pictures of the kind of google/ddpm-cat-256."""
    options = {
        "sample_size": 16,
        "in_channels": 3,
        "out_channels": 3,
        "block_out_channels": widths,
        "down_block_types": ("DownBlock2D", "AttnDownBlock2D"),
        "up_block_types": ("AttnUpBlock2D", "UpBlock2D"),
        "layers_per_block": 1,
        "norm_num_groups": 4,
        "attention_head_dim": None,
        "downsample_padding": 0,
        "flip_sin_to_cos": False,
        "freq_shift": 1,
        "norm_eps": 1e-6,
    }
    return UNet2DModel(**options | changes)


@pytest.fixture
def folder(tmp_path) -> str:
    torch.manual_seed(5)
    published().save_pretrained(tmp_path / "hub")
    return str(tmp_path / "hub")


def inputs(channels: int, size: tuple[int, int] = (8, 12)) -> tuple[Tensor, Tensor, Tensor]:
    generator = torch.Generator().manual_seed(0)
    image = torch.rand(2, 3, *size, generator=generator)
    return torch.randn(2, channels, *size, generator=generator), torch.tensor([3, 700]), conditions(image)


@pytest.mark.quick
def test_the_conditions_are_the_image_and_the_pixel_coordinates():
    image = torch.rand(2, 3, 4, 5, generator=torch.Generator().manual_seed(0))
    assert_close(conditions(image)[:, :3], 2 * image - 1)
    assert_close(conditions(image)[:, 3:], pixel_coordinates(image))


@pytest.mark.parametrize("size", [(1, 1), (7, 5), (9, 16)])
def test_a_frame_of_any_size_is_padded_to_the_stride_by_its_border_pixels(size):
    torch.manual_seed(0)
    denoiser = tiny(2)
    noisy, time, condition = inputs(2, size)
    output = denoiser(noisy, time, condition)
    rows, columns = (torch.arange(side + side % 2).clamp(max=side - 1) for side in size)
    padded = (value[:, :, rows][:, :, :, columns] for value in (noisy, condition))
    expected = denoiser.network(torch.cat(list(padded), dim=1), time).sample[:, :, : size[0], : size[1]]
    assert output.shape == noisy.shape
    assert_close(output, expected)


@pytest.mark.parametrize("channels", [3, 2, 4])
def test_a_pretrained_network_first_predicts_what_it_predicts_for_pictures(folder, channels):
    denoiser = tiny(channels, pretrained=folder)
    noisy, time, condition = inputs(channels)
    common = min(3, channels)
    # For the published network, missing channels are zeros.
    picture = torch.zeros(2, 3, 8, 12)
    picture[:, :common] = noisy[:, :common]
    expected = UNet2DModel.from_pretrained(folder, low_cpu_mem_usage=False)(picture, time).sample
    output = denoiser(noisy, time, condition)
    assert_close(output[:, :common], expected[:, :common])
    assert not output[:, common:].any()


def test_a_pretrained_encoder_is_frozen_and_a_random_one_is_not(folder):
    trained, everything = (
        {name for name, value in denoiser.network.named_parameters() if value.requires_grad}
        for denoiser in (tiny(2, pretrained=folder), tiny(2))
    )
    assert everything - trained == {name for name in everything if name.startswith("down_blocks.")}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"widths": (8, 12)}, r"block_out_channels = \[8, 16\], got .*, where it is \[8, 12\]"),
        ({"freq_shift": 0}, r"freq_shift = 1, got .*, where it is 0"),
    ],
)
def test_weights_of_another_network_are_rejected(tmp_path, changes, message):
    published(**changes).save_pretrained(tmp_path)
    with pytest.raises(ValueError, match=f"pretrained must be a network with {message}"):
        tiny(2, pretrained=str(tmp_path))


@pytest.mark.parametrize("broken", ["nothing", "config", "weights"])
def test_a_folder_without_a_network_names_the_option_that_avoids_it(folder, tmp_path, broken):
    if broken == "nothing":
        folder = str(tmp_path / "none")
    if broken == "config":
        (tmp_path / "hub" / "config.json").write_text("{", encoding="utf-8")
    if broken == "weights":
        (tmp_path / "hub" / "diffusion_pytorch_model.safetensors").write_bytes(b"\0" * 50)
    with pytest.raises(ValueError, match=r"pretrained must be null, a folder .* got .*pretrained=null or .*=FOLDER"):
        tiny(2, pretrained=folder)


def test_an_unreachable_hub_names_the_option_that_avoids_it(monkeypatch):
    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_OFFLINE", True)
    with pytest.raises(ValueError, match=r"got nobody/nothing: add model.network.pretrained=null"):
        tiny(2, pretrained="nobody/nothing")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ({"attention": (True,)}, r"attention must have an entry for each of widths = \[8, 16\], got \[True\]"),
        ({"widths": (), "attention": ()}, r"attention must have an entry for each of widths = \[\], got \[\]"),
        ({"groups": 32}, r"widths must be multiples of groups = 32, got \[8, 16\]"),
        ({"groups": 0}, "groups must be at least 1, got 0"),
        ({"layers": 0}, "layers must be at least 1, got 0"),
    ],
)
def test_an_invalid_size_is_named(words, message):
    with pytest.raises(ValueError, match=message):
        Denoiser(2, **TINY | words)
