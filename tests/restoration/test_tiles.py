import pytest
import torch
from torch.testing import assert_close

from torchrefract.restoration.tiles import in_tiles

SIZES = [(1, 1), (5, 64), (64, 64), (65, 63), (97, 131)]


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("tile", [(1, 1), (2, 3), (32, 32), (33, 48), (200, 200)])
def test_tiles_of_a_network_that_does_nothing_are_the_picture(size, tile):
    image = torch.rand(3, *size, generator=torch.Generator().manual_seed(0))
    assert_close(in_tiles(lambda tiles: tiles, image, tile=tile, batch=7), image, rtol=0, atol=1e-6)


@pytest.mark.parametrize("batch", [1, 3, 100])
def test_tiles_are_blended_by_their_bumps(batch):
    # Tiles that are told apart by what they come to, so that the sum can be written down pixel by pixel.
    image = torch.arange(24.0).view(1, 4, 6).double()
    found = in_tiles(
        lambda tiles: tiles.amax(dim=(2, 3), keepdim=True).expand_as(tiles), image, tile=(4, 4), batch=batch
    )
    w = torch.sin(torch.pi * (torch.arange(4).double() + 0.5) / 4) ** 2
    # Two tiles, from columns 0 and 2, with the largest values 21 and 23; both cover columns 2 and 3.
    expected = [21, 21, *((21 * w[2 + i] + 23 * w[i]) / (w[2 + i] + w[i]) for i in range(2)), 23, 23]
    assert_close(found, torch.tensor(expected).double().expand(1, 4, 6), rtol=0, atol=1e-12)


def test_a_step_between_two_tiles_shows_no_seam():
    # Every tile is made brighter or darker by its mean, so neighbors differ, and a hard edge would be a jump.
    image = torch.linspace(0, 1, 256).expand(1, 64, 256)
    found = in_tiles(lambda tiles: tiles.mean(dim=(2, 3), keepdim=True).expand_as(tiles), image, tile=(64, 64), batch=4)
    assert found.max() - found.min() > 0.15
    # Neighbors are 48 px apart, a step of 48/256 over an overlap of 16 px whose steepest slope is pi/2 of the mean one.
    assert (found[..., 1:] - found[..., :-1]).abs().max() < 48 / 256 / 16 * 2


def test_no_tile_is_larger_than_asked_and_all_are_of_one_size():
    seen = []

    def look(tiles: torch.Tensor) -> torch.Tensor:
        seen.append(tuple(tiles.shape))
        return tiles

    in_tiles(look, torch.zeros(3, 50, 90), tile=(32, 40), batch=4)
    # Along 50 px two tiles of 32, along 90 three of 40 at least 10 px over each other.
    assert [shape[0] for shape in seen] == [4, 2]
    assert {shape[1:] for shape in seen} == {(3, 32, 40)}
