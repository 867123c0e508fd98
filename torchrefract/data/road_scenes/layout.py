"""The camera, the road and the light of a road scene, drawn from (seed, key)."""

from typing import NamedTuple

import torch
from torch import Tensor

from torchrefract.data.road_scenes.geometry import Point, View
from torchrefract.draws import stream, uniform

_LANE = 0x5CE4E


class Road(NamedTuple):
    """The road and its verges; lengths in meters, each (B, 1, 1).

    curve: 1/m. lane: the width of one. half: of the paved width. paved, town, barred, fringed: 0 or 1, for asphalt, a
    town, a solid center line, yellow edge lines. zebra: where a crossing begins, negative for none. wet_grass and
    red_soil in [0, 1]. tar: the asphalt's albedo. shift_x, shift_z: offsets of the ground's texture.
    """

    curve: Tensor
    lane: Tensor
    half: Tensor
    paved: Tensor
    town: Tensor
    barred: Tensor
    fringed: Tensor
    zebra: Tensor
    wet_grass: Tensor
    red_soil: Tensor
    tar: Tensor
    shift_x: Tensor
    shift_z: Tensor

    def beside_slots(self) -> "Road":
        """The same road with fields (B, 1), which go with bodies of (B, N)."""
        return Road(*(field[..., 0] for field in self))

    def center(self, z: Tensor) -> Tensor:
        """x of the center line: curve z^2 / (2 + z / 300), a parabola that turns straight far away."""
        return self.curve * z * z / (2 + z / 300)

    def heading(self, z: Tensor) -> Tensor:
        """dx/dz of the center line."""
        below = 2 + z / 300
        return self.curve * z * (4 + z / 300) / (below * below)


class Light(NamedTuple):
    """sun: the direction to it, three of (B, 1, 1); the rest linear colors (3, B, 1, 1); cover: of cloud, (B, 1, 1)."""

    sun: Point
    beam: Tensor
    ambient: Tensor
    zenith: Tensor
    horizon: Tensor
    cover: Tensor


class Dice:
    """The uniform numbers of each sample, handed out in order."""

    def __init__(self, seed: int, keys: Tensor, count: int = 512):
        # A lane of its own: a corruption drawn with the same seed and key must not go with what the frame shows.
        self.numbers = uniform(stream(seed, keys).at(_LANE), count)
        self.used = 0

    def __call__(self, low: float, high: float, count: int = 1) -> Tensor:
        """(B, count), uniform between low and high."""
        self.used += count
        return low + (high - low) * self.numbers[:, self.used - count : self.used]

    def one(self, low: float, high: float) -> Tensor:
        """(B, 1, 1), uniform between low and high."""
        return self(low, high)[..., None]


def draw_road(dice: Dice) -> Road:
    bend, town = dice.one(-1, 1), (dice.one(0, 1) < 0.4).float()
    paved = torch.maximum((dice.one(0, 1) < 0.75).float(), town)
    lane = dice.one(3.0, 3.7)
    return Road(
        curve=bend * bend * bend / 160,
        lane=lane,
        half=lane + dice.one(0.2, 1.2) * paved,
        paved=paved,
        town=town,
        barred=(dice.one(0, 1) < 0.2).float(),
        fringed=(dice.one(0, 1) < 0.75).float(),
        zebra=torch.where(dice.one(0, 1) < 0.3 * town, 1.0, -1.0) * dice.one(9, 30),
        wet_grass=dice.one(0, 1),
        red_soil=dice.one(0, 1),
        tar=dice.one(0.07, 0.2),
        shift_x=dice.one(0, 256),
        shift_z=dice.one(0, 256),
    )


def draw_view(dice: Dice, road: Road) -> View:
    """A dashcam in the left lane; every field (B, 1, 1)."""
    tall = (dice.one(0, 1) < 0.15).float()
    x = -road.lane / 2 + dice.one(-0.5, 0.5)
    height = dice.one(1.2, 1.55) + 0.8 * tall
    (cy, sy), (cp, sp), (cr, sr) = (cosine_sine(dice.one(-size, size)) for size in (0.07, 0.06, 0.02))
    turn = (
        *(cy * cr - sy * sp * sr, -cy * sr - sy * sp * cr, sy * cp),
        *(-cp * sr, -cp * cr, -sp),
        *(-sy * cr - cy * sp * sr, sy * sr - cy * sp * cr, cy * cp),
    )
    return View(x, height, dice.one(0.55, 0.85), turn)


def cosine_sine(tangent: Tensor) -> tuple[Tensor, Tensor]:
    # Cosine and sine from the tangent: the square root is exactly rounded on every device, they are not.
    cosine = 1 / (1 + tangent * tangent).sqrt()
    return cosine, tangent * cosine


def draw_light(dice: Dice) -> Light:
    x, z, elevation = dice.one(-1, 1), dice.one(-1, 1), dice.one(0.22, 1.0)
    overcast = (dice.one(0, 1) < 0.22).float()
    elevation = torch.maximum(elevation, overcast * 2.5)
    length = (x * x + z * z).clamp(min=0.04).sqrt()
    x, z, y = x / length, z / length, elevation * 1.2
    scale = 1 / (x * x + y * y + z * z).sqrt()
    sun = (x * scale, y * scale, z * scale)
    warm = ((0.65 - elevation) / 0.4).clamp(0, 1)
    power, cover = dice.one(0.85, 1.25), dice.one(-0.5, 0.55) * (1 - overcast) + overcast

    def mix(clear: tuple, golden: tuple, gray: tuple) -> Tensor:
        clear_color, golden_color, gray_color = (_color(c, x.device) for c in (clear, golden, gray))
        color = clear_color + (golden_color - clear_color) * warm
        return (color + (gray_color - color) * overcast) * power

    return Light(
        sun=sun,
        beam=mix((1.15, 1.08, 0.95), (1.7, 0.98, 0.45), (0.3, 0.3, 0.3)),
        ambient=mix((0.3, 0.36, 0.46), (0.3, 0.3, 0.36), (0.58, 0.6, 0.63)),
        zenith=mix((0.09, 0.22, 0.56), (0.14, 0.24, 0.45), (0.45, 0.48, 0.53)),
        horizon=mix((0.52, 0.66, 0.82), (0.95, 0.68, 0.42), (0.72, 0.74, 0.77)),
        cover=cover,
    )


def _color(color: tuple, device: torch.device) -> Tensor:
    return torch.tensor(color, device=device).view(3, 1, 1, 1)
