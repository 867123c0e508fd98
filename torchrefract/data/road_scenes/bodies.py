"""What each kind of roadside body is: which part of its surface is there (`solid`) and how it is painted.

All lengths in meters in the body's own axes: x across, y up from its foot, z along. Colors are linear albedos, (3, F).
"""

import torch
from torch import Tensor

from torchrefract.data.road_scenes.geometry import Point, Shape, Sides, noise

GLASS = (0.035, 0.05, 0.065)
_TIRE = 0.33


def fraction(value: Tensor) -> Tensor:
    return value - value.floor()


def dye(color: Tensor, mask: Tensor, paint: tuple[float, float, float]) -> Tensor:
    """`color` with `paint` where the mask is."""
    return torch.stack([torch.where(mask, new, old) for new, old in zip(paint, color, strict=True)])


def plain(shape: Shape, albedo: Tensor, point: Point, side: Sides) -> Tensor:
    return albedo


def ridge_solid(shape: Shape, point: Point, chord: Tensor) -> Tensor:
    """Below a skyline of three octaves, cut flat at the top where the body has a low level: a table mountain."""
    x = point[0] / shape.hy
    skyline = 0.5 * noise(x * 0.15 + shape.seed * 256, shape.seed * 77)
    skyline = skyline + 0.25 * noise(x * 0.5, shape.seed * 191) + 0.07 * noise(x * 2.3, shape.seed * 233)
    return point[1] < 2 * shape.hy * (0.5 + skyline).clamp(min=0.1).minimum(shape.level * 0.75)


def bush_solid(shape: Shape, point: Point, chord: Tensor) -> Tensor:
    skyline = 0.6 + 0.3 * noise(point[0] * 0.07, shape.seed * 191) + 0.15 * noise(point[0] * 0.4, shape.seed * 233)
    # Thins out towards its ends.
    return point[1] < 2 * shape.hy * skyline * ((shape.hx - point[0].abs()) / 40).clamp(max=1)


def ridge_paint(shape: Shape, albedo: Tensor, point: Point, side: Sides) -> Tensor:
    scale = 3 / shape.hy
    texture = noise(point[0] * scale * 0.6 + shape.seed * 256, point[1] * scale)
    return albedo * (1 + 0.3 * texture + 0.15 * noise(point[0] * scale * 2, point[1] * scale * 2))


def crown_solid(shape: Shape, point: Point, chord: Tensor) -> Tensor:
    """Leaves: the rim of the ellipsoid breaks up where the ray passes through little of it."""
    leaf = _foliage(shape, point, 1.9, 6.1)
    return chord > 0.4 + 0.4 * leaf


def crown_paint(shape: Shape, albedo: Tensor, point: Point, side: Sides) -> Tensor:
    leaf = _foliage(shape, point, 2.7, 9.0)
    return albedo * (1.1 + 0.6 * leaf) * (0.65 + 0.35 * point[1] / shape.hy)


def _foliage(shape: Shape, point: Point, coarse: float, fine: float) -> Tensor:
    # Only across and up: noise that also depends on the depth draws rings where a crown curves away.
    across, up = point[0] + shape.seed * 256, point[1] * (0.6 + 0.4 * shape.hx / shape.hy)
    return noise(across * coarse, up * coarse) + 0.7 * noise(across * fine, up * fine)


def building_paint(shape: Shape, albedo: Tensor, point: Point, side: Sides) -> Tensor:
    """Walls with framed windows every 2.8 m and storey, a door, a plinth; a roof of corrugated iron or tiles."""
    x, y, z = point
    along = torch.where(side.flank, z, x) / (2.4 + shape.seed) + 100.5
    cell, storey = fraction(along), fraction(y / 2.9) * 2.9
    wall = ~side.roof & (y < 2 * shape.hy - 0.4)
    middle = (cell - 0.5).abs()
    frame = wall & (middle < 0.29) & (storey > 0.85) & (storey < 2.15)
    pane = wall & (middle < 0.25) & (middle > 0.02) & (storey > 0.95) & (storey < 2.05)
    door = wall & (fraction(along.floor() * 0.381 + shape.seed) < 0.3) & (middle < 0.2) & (y < 2.1)
    weather = noise(x + z + shape.seed * 256, y) * 0.08
    color = albedo * (1 + weather) * torch.where(y < 0.35, 0.6, 1.0)
    color = dye(dye(color, frame & ~door, (0.62, 0.6, 0.56)), pane & ~door, GLASS)
    color = dye(color, door, (0.16, 0.08, 0.04))
    return torch.where(side.roof, roof_color(shape, point), color)


def roof_color(shape: Shape, point: Point) -> Tensor:
    kinds = torch.tensor([[0.32, 0.08, 0.05], [0.33, 0.34, 0.35], [0.09, 0.17, 0.11], [0.3, 0.15, 0.08]]).T
    kind = (fraction(shape.seed * 7.3) * 4).long().clamp(max=3)
    ribs = (fraction(point[0] * 2.5) - 0.5).abs()
    rust = noise(point[0] * 0.7 + shape.seed * 256, point[2] * 0.7)
    return kinds.to(kind.device)[:, kind] * (0.85 + 0.4 * ribs + 0.15 * rust)


def wall_paint(shape: Shape, albedo: Tensor, point: Point, side: Sides) -> Tensor:
    """A boundary wall of precast panels between piers, with a coping."""
    pier = fraction((point[2] + 50) / 1.8) < 0.1
    course = fraction(point[1] / 0.42) < 0.1
    shade = torch.where(pier, 1.15, torch.where(course, 0.72, 1.0))
    return albedo * shade * (1 + 0.15 * noise(point[2] * 0.8 + shape.seed * 256, point[1] * 1.5))


def rail_solid(shape: Shape, point: Point, chord: Tensor) -> Tensor:
    post = fraction((point[2] + 100) / 2.5) < 0.06
    return (point[1] > 0.42) | post


def rail_paint(shape: Shape, albedo: Tensor, point: Point, side: Sides) -> Tensor:
    # The W of a crash barrier: two bright bulges around a dark groove.
    groove = ((point[1] - 0.58).abs() < 0.035) | (point[1] < 0.42)
    return albedo * torch.where(groove, 0.5, 1.0)


def fence_solid(shape: Shape, point: Point, chord: Tensor) -> Tensor:
    """Posts and three wires."""
    wire = (fraction(point[1] / 0.42) - 0.5).abs() < 0.03
    return wire | (fraction((point[2] + 90) / 3) < 0.045)


def pole_solid(shape: Shape, point: Point, chord: Tensor) -> Tensor:
    """A mast with one cross-arm: on both sides for wires (level 1), on one side for a lamp (level 2)."""
    top = 2 * shape.hy - point[1]
    arm = torch.where(shape.level > 1.5, (top < 0.16) & (point[0] > 0), (top > 0.5) & (top < 0.68))
    return (point[0].abs() < 0.13) | arm


def pole_paint(shape: Shape, albedo: Tensor, point: Point, side: Sides) -> Tensor:
    return albedo * (1 + 0.25 * noise(point[0] * 9 + shape.seed * 256, point[1] * 1.1))


def sign_solid(shape: Shape, point: Point, chord: Tensor) -> Tensor:
    x, y = point[0], point[1] - (2 * shape.hy - shape.hx)
    plate = torch.where(shape.seed < 0.4, x * x + y * y, torch.maximum(x * x, y * y)) < shape.hx * shape.hx
    triangle = (x.abs() * 1.75 + y < shape.hx) & (y > -0.75 * shape.hx)
    plate = torch.where(shape.seed > 0.7, triangle, plate)
    return plate | (x.abs() < 0.04)


def sign_paint(shape: Shape, albedo: Tensor, point: Point, side: Sides) -> Tensor:
    """A red-rimmed white disc or triangle or a green board on a gray post, blank from behind."""
    x, y = point[0] / shape.hx, (point[1] - 2 * shape.hy) / shape.hx + 1
    board = (shape.seed >= 0.4) & (shape.seed <= 0.7)
    inner = torch.where(shape.seed < 0.4, x * x + y * y < 0.5, (x.abs() * 1.75 + y < 0.5) & (y > -0.5))
    inner = torch.where(board, torch.maximum(x.abs(), y.abs()) < 0.88, inner)
    text = inner & (y.abs() < 0.32) & (x.abs() < 0.6) & (fraction(x * 2.4 + 0.5) < 0.62)
    color = dye(dye(albedo, inner, (0.8, 0.8, 0.78)), text, (0.03, 0.03, 0.03))
    green = dye(dye(albedo, inner, (0.01, 0.16, 0.06)), text, (0.8, 0.8, 0.8))
    rim = dye(color, ~inner, (0.55, 0.02, 0.02))
    color = torch.where(board, dye(green, ~inner, (0.8, 0.8, 0.8)), rim)
    post = (y < -1.02) | (point[2] > 0)
    return dye(color, post, (0.3, 0.3, 0.3))


def hull_solid(shape: Shape, point: Point, chord: Tensor) -> Tensor:
    """The lower body of a vehicle: clear of the ground but for its wheels."""
    x, y, z = point
    axle = z.abs() - 0.62 * shape.hz
    tire = (axle * axle + (y - _TIRE) * (y - _TIRE) < _TIRE * _TIRE) | ((z.abs() > shape.hz - 0.02) & (y < 0.5))
    return (y > 0.24) | (tire & (x.abs() > shape.hx - 0.24))


def hull_paint(shape: Shape, albedo: Tensor, point: Point, side: Sides) -> Tensor:
    x, y, z = point
    across = x.abs() / shape.hx
    axle = z.abs() - 0.62 * shape.hz
    wheel = axle * axle + (y - _TIRE) * (y - _TIRE)
    color = albedo * torch.where(side.flank & ((z + 0.05).abs() < 0.02), 0.4, 1.0)
    color = dye(color, (y < 0.45) | (side.flank & (wheel < 0.17)), (0.02, 0.02, 0.022))
    color = dye(color, side.flank & (wheel < 0.045), (0.3, 0.3, 0.31))
    return torch.where(side.end, _end_color(shape, color, point, across), color)


def _end_color(shape: Shape, color: Tensor, point: Point, across: Tensor) -> Tensor:
    """Lamps, grille, bumper and number plate of a front (z > 0) or a rear."""
    y, front = point[1] / (2 * shape.hy), point[2] > 0
    lamp = (across > 0.66) & (across < 0.95) & (y > 0.58) & (y < 0.85)
    color = dye(color, front & (across < 0.6) & (y > 0.52) & (y < 0.78), (0.03, 0.03, 0.03))
    color = dye(color, lamp & front, (1.6, 1.55, 1.35))
    color = dye(color, lamp & ~front, (0.75, 0.02, 0.015))
    bumper = (y > 0.3) & (y < 0.46)
    color = torch.where(bumper, color * 0.35 + 0.02, color)
    return dye(color, (across < 0.3) & (y > 0.42) & (y < 0.54), (0.7, 0.62, 0.25))


def cabin_paint(shape: Shape, albedo: Tensor, point: Point, side: Sides) -> Tensor:
    """Windows between pillars; a box without a pitch is the load of a truck, with ribs, and its windshield in front."""
    x, y, z = point
    high = y / (2 * shape.hy)
    edge = 0.5 * (1 - high) * shape.hz
    pillar = ((z + 0.1).abs() < 0.05) | (z.abs() > shape.hz * 0.97 - edge)
    flank = side.flank & ~pillar & (high > 0.1) & (high < 0.86)
    # The sloping panes belong to the roof's planes.
    pane = ~side.flank & (high > 0.08) & (high < 0.88) & (x.abs() < 0.9 * shape.hx)
    load = shape.pitch == 0
    windshield = side.end & (z > 0) & (high > 0.04) & (high < 0.36) & (x.abs() < 0.88 * shape.hx)
    glass = torch.where(load, windshield, flank | pane)
    sheen = 1 + 2.5 * high.clamp(0, 1)
    color = torch.where(glass, torch.tensor(GLASS, device=x.device)[:, None] * sheen, albedo)
    ribs = fraction((z + x) * 1.6 + 100) < 0.12
    return torch.where(load & ribs, color * 0.8, color)
