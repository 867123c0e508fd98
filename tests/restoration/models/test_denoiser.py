from functools import partial

import huggingface_hub.constants
import pytest
import torch
from diffusers import UNet2DModel
from torch import Tensor
from torch.testing import assert_close

from torchrefract.restoration.models.denoiser import Denoiser, conditions

TINY = {"widths": (8, 16), "attention": (False, True), "layers": 1, "groups": 4}
tiny = partial(Denoiser, **TINY)


def published(widths: tuple[int, ...] = (8, 16), **changes) -> UNet2DModel:
    """A network for pictures as a hub has it, of the kind of google/ddpm-cat-256."""
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


def count(denoiser: Denoiser) -> int:
    return sum(parameter.numel() for parameter in denoiser.parameters())


def test_the_default_is_the_light_one_and_the_other_configuration_that_of_the_published_network():
    with torch.device("meta"):
        light = Denoiser(3)
        cat = Denoiser(3, widths=(128, 128, 256, 256, 512, 512), attention=(False,) * 4 + (True, False))
    assert 35.0e6 < count(light) < 36.5e6
    # The published one has 113 673 219, with three channels in; five more of them meet 128 kernels of 3 x 3.
    assert count(cat) == 113_673_219 + 5 * 128 * 9


def test_the_conditions_are_the_image_and_where_its_pixels_lie():
    image = torch.rand(2, 3, 4, 5, generator=torch.Generator().manual_seed(0))
    found = conditions(image)
    assert_close(found[:, :3], 2 * image - 1)
    assert_close(found[1, 3], torch.tensor([-0.8, -0.4, 0.0, 0.4, 0.8]).expand(4, 5))
    assert_close(found[1, 4], torch.tensor([-0.75, -0.25, 0.25, 0.75])[:, None].expand(4, 5))


@pytest.mark.parametrize("size", [(1, 1), (7, 5), (9, 16)])
def test_a_frame_of_any_size_is_that_of_whole_strides_with_its_border_repeated(size):
    torch.manual_seed(0)
    denoiser = tiny(2)
    noisy, time, condition = inputs(2, size)
    found = denoiser(noisy, time, condition)
    rows, columns = (torch.arange(side + side % 2).clamp(max=side - 1) for side in size)
    whole = (value[:, :, rows][:, :, :, columns] for value in (noisy, condition))
    expected = denoiser.network(torch.cat(list(whole), dim=1), time).sample[:, :, : size[0], : size[1]]
    assert found.shape == noisy.shape
    assert_close(found, expected)


def test_the_noise_found_depends_on_all_that_is_given():
    torch.manual_seed(0)
    denoiser = tiny(3)
    noisy, time, condition = inputs(3)
    found = denoiser(noisy, time, condition)
    for changed in ((noisy + 1, time, condition), (noisy, time + 200, condition), (noisy, time, condition.flip(3))):
        assert float((denoiser(*changed) - found).detach().abs().amax()) > 1e-3


@pytest.mark.parametrize("channels", [3, 2, 4])
def test_pretrained_weights_find_at_first_what_they_found_on_pictures(folder, channels):
    denoiser = tiny(channels, pretrained=folder)
    noisy, time, condition = inputs(channels)
    common = min(3, channels)
    # Of fewer channels the ones that are missing are zeros to the published network.
    picture = torch.zeros(2, 3, 8, 12)
    picture[:, :common] = noisy[:, :common]
    expected = UNet2DModel.from_pretrained(folder, low_cpu_mem_usage=False)(picture, time).sample
    found = denoiser(noisy, time, condition)
    assert_close(found[:, :common], expected[:, :common])
    assert not found[:, common:].any()


def test_a_pretrained_encoder_is_frozen_and_a_random_one_is_not(folder):
    learned = {name for name, value in tiny(2, pretrained=folder).network.named_parameters() if value.requires_grad}
    everything = {name for name, value in tiny(2).network.named_parameters() if value.requires_grad}
    assert {name for name in everything - learned if not name.startswith("down_blocks.")} == set()
    assert not [name for name in learned if name.startswith("down_blocks.")]
    assert "conv_in.weight" in learned


def test_weights_of_another_network_are_named(tmp_path):
    published(widths=(8, 12)).save_pretrained(tmp_path)
    with pytest.raises(ValueError, match=r"pretrained must be a network with block_out_channels = \[8, 16\], got .*12"):
        tiny(2, pretrained=str(tmp_path))


def test_weights_of_another_embedding_of_time_are_named(tmp_path):
    published(freq_shift=0).save_pretrained(tmp_path)
    with pytest.raises(ValueError, match=r"pretrained must be a network with freq_shift = 1, got .*, where it is 0"):
        tiny(2, pretrained=str(tmp_path))


@pytest.mark.parametrize("broken", ["nothing", "config", "weights"])
def test_a_folder_that_holds_no_network_names_the_option_that_avoids_it(folder, tmp_path, broken):
    if broken == "nothing":
        folder = str(tmp_path / "none")
    if broken == "config":
        (tmp_path / "hub" / "config.json").write_text("{", encoding="utf-8")
    if broken == "weights":
        (tmp_path / "hub" / "diffusion_pytorch_model.safetensors").write_bytes(b"\0" * 50)
    with pytest.raises(ValueError, match=r"pretrained must be null, a folder .* got .*pretrained=null or .*=FOLDER"):
        tiny(2, pretrained=folder)


def test_a_name_on_a_hub_that_cannot_be_reached_names_the_option_that_avoids_it(monkeypatch):
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
def test_a_size_that_is_none_is_named(words, message):
    with pytest.raises(ValueError, match=message):
        Denoiser(2, **TINY | words)
