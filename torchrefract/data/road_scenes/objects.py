"""What stands beside and drives on the road of a scene, and where, drawn from (seed, key)."""

from collections.abc import Sequence

import torch
from torch import Tensor

from torchrefract.data.road_scenes import bodies
from torchrefract.data.road_scenes.geometry import Shape, ball_sides, meet_ball
from torchrefract.data.road_scenes.layout import Dice, Road, cosine_sine
from torchrefract.data.road_scenes.visibility import Group


def draw_groups(dice: Dice, road: Road) -> list[Group]:
    """All bodies, none of a kind overlapping by much; each kind has a fixed number of slots, some of them empty."""
    road = road.beside_slots()
    return [
        *_horizon(dice, road),
        _buildings(dice, road),
        *_barriers(dice, road),
        _poles(dice, road),
        *_trees(dice, road),
        _signs(dice, road),
        *_vehicles(dice, road),
    ]


def _pick(palette: Sequence[tuple[float, ...]], choice: Tensor) -> Tensor:
    """(K, B, N): rows of a table with K columns, as numbers in [0, 1) choose."""
    table = torch.tensor(palette, device=choice.device).T
    return table[:, (choice * len(palette)).long()]


def _row(values: list[float], like: Tensor) -> Tensor:
    return torch.tensor(values, device=like.device).expand(len(like), -1)


def _stand(
    road: Road,
    offset: Tensor,
    z: Tensor,
    half: tuple[Tensor | float, ...],
    *,
    seed: Tensor,
    foot: Tensor | float = 0.0,
    turn: Tensor | float = 0.0,
    pitch: Tensor | float = 0.0,
    level: Tensor | float = 1.0,
) -> Shape:
    """Bodies at an offset from the center line, on the ground or `foot` above it, turned from the road's heading."""
    hx, hy, hz, pitch, level = (torch.as_tensor(v, device=z.device).expand_as(z) for v in (*half, pitch, level))
    cosine, sine = cosine_sine(road.heading(z) + turn)
    return Shape(road.center(z) + offset, hy + foot, z, cosine, sine, hx, hy, hz, pitch, level, seed)


def _horizon(dice: Dice, road: Road) -> list[Group]:
    """Mountains, hills, and a line of bush on each side of the road."""
    z = torch.cat([dice(5000, 9000), dice(1600, 3000)], dim=1)
    high = torch.cat([z[:, :1] * dice(0.012, 0.07), z[:, 1:] * dice(0.006, 0.035)], dim=1)
    mesa = torch.where(dice(0, 1, 2) < 0.35, 0.75, 2.0)
    half, facing = (1.7 * z, high / 2, 1.0), -road.heading(z)
    far = _stand(road, -road.center(z), z, half, seed=dice(0, 1, 2), turn=facing, level=mesa)
    colors = _pick([(0.2, 0.17, 0.13), (0.16, 0.17, 0.1), (0.26, 0.18, 0.12)], dice(0, 1, 2))
    ridges = Group(far, colors, z > 0, bodies.ridge_paint, bodies.ridge_solid, casts=False)
    z = dice(110, 320).expand(-1, 2)
    side = (road.half + 305) * _row([-1.0, 1.0], z)
    line = _stand(road, side, z, (300.0, dice(1.5, 3.5, 2), 0.5), seed=dice(0, 1, 2), turn=-road.heading(z))
    green = _pick([(0.07, 0.1, 0.03), (0.1, 0.11, 0.04), (0.13, 0.11, 0.05)], dice(0, 1).expand(-1, 2))
    bush = Group(line, green, dice(0, 1, 2) < 0.8, bodies.ridge_paint, bodies.bush_solid, casts=False)
    return [ridges, bush]


def _buildings(dice: Dice, road: Road) -> Group:
    """Houses with pitched roofs or flat ones beside the road, and blocks of flats behind a town."""
    n = 8
    z = _row([17.0, 24.0, 40.0, 47.0, 68.0, 75.0, 150.0, 220.0], dice.numbers) + dice(-4, 4, n)
    side = _row([-1.0, 1.0] * 4, z)
    block = _row([0.0] * 6 + [1.0] * 2, z)
    hx, hz = dice(3.5, 5.5, n) * (1 + block), dice(3, 4.5, n) * (1 + block)
    flat = ((dice(0, 1, n) < 0.35) | (block > 0)).float()
    wall = 2.6 + 2.9 * (dice(0, 2.4, n).floor() * flat + block * dice(2, 6, n).floor())
    rise = dice(1.0, 2.2, n) * (1 - flat) + 0.5 * flat
    pitch = 2 * rise / (wall + rise) * (1 - flat)
    offset = side * (road.half + dice(6, 12, n) + hx + block * 25)
    crosswise = torch.where(dice(0, 1, n) < 0.35, 3.0, 0.0) * (1 - block)
    half = (hx, (wall + rise) / 2, hz)
    shape = _stand(road, offset, z, half, seed=dice(0, 1, n), turn=crosswise + dice(-0.1, 0.1, n), pitch=pitch)
    present = dice(0, 1, n) < 0.12 + 0.73 * road.town
    walls = [
        (0.6, 0.56, 0.48),
        (0.55, 0.42, 0.25),
        (0.42, 0.2, 0.12),
        (0.3, 0.42, 0.45),
        (0.66, 0.64, 0.6),
        (0.5, 0.3, 0.25),
    ]
    return Group(shape, _pick(walls, dice(0, 1, n)), present, bodies.building_paint)


def _barriers(dice: Dice, road: Road) -> list[Group]:
    """Boundary walls in a town, crash barriers and wire fences in the country; one of each on each side."""
    side, country = _row([-1.0, 1.0], dice.numbers), 1 - road.town
    long, near = dice(8, 18, 2), dice(5, 14, 2)
    wall = _stand(road, side * (road.half + 4.2), near + long, (0.1, dice(0.7, 1.0, 2), long), seed=dice(0, 1, 2))
    colors = _pick([(0.5, 0.47, 0.42), (0.6, 0.52, 0.4), (0.45, 0.45, 0.45)], dice(0, 1, 2))
    walls = Group(wall, colors, dice(0, 1, 2) < 0.6 * road.town, bodies.wall_paint)
    long = dice(8, 16, 2)
    rail = _stand(road, side * (road.half + 3.0), dice(5, 20, 2) + long, (0.05, 0.38, long), seed=dice(0, 1, 2))
    steel = _pick([(0.42, 0.43, 0.44)], dice(0, 1, 2))
    barred = dice(0, 1, 2) < 0.3 * country * road.paved
    rails = Group(rail, steel, barred, bodies.rail_paint, bodies.rail_solid)
    long = dice(12, 25, 2)
    wire = _stand(road, side * (road.half + 7), dice(4, 10, 2) + long, (0.04, 0.63, long), seed=dice(0, 1, 2))
    wood = _pick([(0.22, 0.17, 0.12), (0.3, 0.28, 0.25)], dice(0, 1, 2))
    fences = Group(wire, wood, dice(0, 1, 2) < 0.6 * country, bodies.plain, bodies.fence_solid)
    return [walls, rails, fences]


def _poles(dice: Dice, road: Road) -> Group:
    """A row of power poles or of street lamps on one side."""
    n = 5
    side, lamp = torch.where(dice(0, 1) < 0.5, -1.0, 1.0), (dice(0, 1) < 0.7 * road.town).float()
    z = dice(9, 24) + dice(24, 45) * _row([0.0, 1.0, 2.0, 3.0, 4.0], dice.numbers)
    offset = (side * (road.half + 2.9 + (1 - lamp) * dice(0.5, 4))).expand_as(z)
    half = (1.1 + 0.5 * lamp, dice(3.6, 4.8), 0.12)
    # An arm towards the road: the body is turned about on the right side, as far as a tangent can turn it.
    shape = _stand(road, offset, z, half, seed=dice(0, 1, n), level=1 + lamp)
    shape = shape._replace(along=-shape.along * side, across=-shape.across * side)
    wood, steel = _pick([(0.16, 0.11, 0.08)], dice(0, 1, n)), _pick([(0.4, 0.41, 0.42)], dice(0, 1, n))
    present = (dice(0, 1) < 0.75).expand_as(z)
    return Group(shape, wood + (steel - wood) * lamp, present, bodies.pole_paint, bodies.pole_solid)


def _trees(dice: Dice, road: Road) -> list[Group]:
    """Trees, round or umbrella thorns, with their trunks, and low bushes."""
    n = 13
    near = [10.0, 16, 26, 38, 52, 70, 95, 9, 13, 18, 25, 34, 46]
    z, low = _row(near, dice.numbers) * dice(0.8, 1.25, n), _row([0.0] * 7 + [1.0] * 6, dice.numbers)
    side = torch.where(dice(0, 1, n) < 0.55, -1.0, 1.0)
    umbrella = (dice(0, 1) < 0.5).float() * (1 - low)
    wide = dice(1.5, 2.8, n) * (1 - 0.65 * low) * (1 + 0.4 * umbrella)
    high = wide * (dice(0.75, 1.2, n) - umbrella * 0.45)
    foot = (dice(1.4, 2.6, n) + umbrella) * (1 - low) - 0.3 * high * low
    offset = side * (road.half + 1.2 + wide + dice(0, 1, n) * dice(2, 16, n))
    crown = _stand(road, offset, z, (wide, high, wide), seed=dice(0, 1, n), foot=foot)
    leaves = [(0.08, 0.14, 0.035), (0.12, 0.17, 0.05), (0.14, 0.15, 0.06), (0.06, 0.1, 0.035), (0.2, 0.18, 0.08)]
    present = dice(0, 1, n) < 0.75 - 0.3 * road.town
    paint, solid = bodies.crown_paint, bodies.crown_solid
    crowns = Group(crown, _pick(leaves, dice(0, 1, n)), present, paint, solid, meet=meet_ball, sides=ball_sides)
    z, offset, tall = z[:, :7], offset[:, :7], (foot + 0.6 * high)[:, :7]
    trunk = _stand(road, offset, z, (0.13, tall / 2, 0.13), seed=dice(0, 1, 7), turn=0.3)
    bark = _pick([(0.13, 0.09, 0.06), (0.2, 0.16, 0.12)], dice(0, 1, 7))
    return [crowns, Group(trunk, bark, present[:, :7], bodies.pole_paint)]


def _signs(dice: Dice, road: Road) -> Group:
    side = _row([-1.0, 1.0], dice.numbers)
    offset, z = side * (road.half + dice(2.8, 3.3, 2)), dice(8, 40, 2)
    shape = _stand(road, offset, z, (dice(0.32, 0.5, 2), dice(1.1, 1.4, 2), 0.03), seed=dice(0, 1, 2))
    red = _pick([(0.55, 0.02, 0.02)], dice(0, 1, 2))
    return Group(shape, red, dice(0, 1, 2) < 0.45, bodies.sign_paint, bodies.sign_solid, casts=False)


# width, length, height of the belt and of the roof, length of the cabin and its middle from the vehicle's, its pitch
_MODELS = [
    (1.75, 4.1, 0.95, 1.48, 2.7, -0.3, 1.1),  # hatchback, the commonest
    (1.75, 4.1, 0.95, 1.48, 2.7, -0.3, 1.1),  # hatchback
    (1.8, 4.6, 0.92, 1.45, 2.6, -0.2, 1.6),  # sedan
    (1.85, 5.0, 1.0, 1.72, 2.9, 0.25, 0.8),  # double-cab bakkie
    (1.85, 5.1, 1.05, 1.75, 2.0, 0.35, 0.8),  # bakkie
    (1.8, 4.8, 1.05, 2.05, 4.5, -0.1, 0.35),  # minibus taxi
    (1.9, 4.7, 1.1, 1.8, 3.4, -0.4, 0.5),  # four-wheel drive
    (2.4, 8.0, 1.15, 3.5, 7.9, 0.0, 0.0),  # truck
]
_CAR_COLORS = [
    *[(0.72, 0.72, 0.7)] * 4,
    *[(0.4, 0.41, 0.42)] * 2,
    *[(0.1, 0.1, 0.11), (0.03, 0.03, 0.035), (0.4, 0.03, 0.03), (0.05, 0.1, 0.28), (0.5, 0.38, 0.1), (0.12, 0.2, 0.13)],
]


def _vehicles(dice: Dice, road: Road) -> list[Group]:
    """Two ahead, two oncoming (traffic keeps left) and one parked, each a hull with a cabin."""
    n = 5
    wide, long, belt, roof, cabin, shift, rake = _pick(_MODELS, dice(0, 1, n))
    z = torch.cat([dice(9, 20), dice(30, 70), dice(9, 26), dice(36, 90), dice(10, 30)], dim=1) + long / 2
    parked, away = _row([0.0, 0, 0, 0, 1], z), _row([1.0, 1, -1, -1, 1], z)
    offset = -away * (road.lane / 2 + parked * (road.half - road.lane / 2 + 1.3)) + dice(-0.25, 0.25, n)
    present = dice(0, 1, n) < _row([0.4, 0.4, 0.45, 0.45, 0.3], z)
    seed, colors = dice(0, 1, n), _pick(_CAR_COLORS, dice(0, 1, n))
    hull = _stand(road, offset, z, (wide / 2, belt / 2, long / 2), seed=seed)
    half = (wide * 0.46, (roof - belt) / 2, cabin / 2)
    # The pitched planes leave a flat roof: at the roof's height they stand `roof - belt` times the rake from the ends.
    pitch = torch.where(rake > 0, cabin / (rake * (roof - belt)).clamp(min=0.1), 0.0)
    level = torch.where(rake > 0, pitch - 1, 1.0)
    top = _stand(road, offset, z, half, seed=seed, foot=belt, pitch=pitch, level=level)
    hull, top = (s._replace(along=s.along * away, across=s.across * away) for s in (hull, top))
    top = top._replace(x=top.x + shift * top.across, z=top.z + shift * top.along)
    return [
        Group(hull, colors, present, bodies.hull_paint, bodies.hull_solid),
        Group(top, colors, present, bodies.cabin_paint),
    ]
