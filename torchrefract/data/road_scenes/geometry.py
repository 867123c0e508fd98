"""Rays, convex bodies and noise for the road scenes, in elementwise exactly rounded operations only.

World axes: x right, y up, z ahead, meters; the ground is y = 0 and the camera stands at (view.x, view.height, 0).
No transcendental function and no sum over a dimension is used: a pixel's bits do not depend on the batch or threads.
"""

from collections.abc import Sequence
from functools import cache
from typing import NamedTuple

import torch
from torch import Tensor

from torchrefract.draws import stream, uniform

Point = tuple[Tensor, Tensor, Tensor]  # x, y, z

_TILE = 256


class View(NamedTuple):
    """A pinhole camera, each field (B, 1, 1). `focal`: in longer image sides; `turn`: nine entries, camera to world."""

    x: Tensor
    height: Tensor
    focal: Tensor
    turn: tuple[Tensor, ...]


class Shape(NamedTuple):
    """Bodies |x| <= hx, |y| <= hy, |z| <= hz of their own axes, with y / hy + pitch |z| / hz <= level; each (B, N).

    x, y, z: center. along, across: cosine and sine of the heading. seed: in [0, 1), for the body's own variation.
    """

    x: Tensor
    y: Tensor
    z: Tensor
    along: Tensor
    across: Tensor
    hx: Tensor
    hy: Tensor
    hz: Tensor
    pitch: Tensor
    level: Tensor
    seed: Tensor

    def at(self, index: Tensor) -> "Shape":
        return Shape(*(pick(field, index) for field in self))

    def turned(self, x: Tensor, z: Tensor) -> tuple[Tensor, Tensor]:
        """A world direction in the body's own axes."""
        return self.along * x - self.across * z, self.across * x + self.along * z

    def unit_ray(self, origin: Point, ray: Point) -> tuple[Point, Point]:
        """A ray where the body is the cube [-1, 1]^3."""
        ox, oz = self.turned(origin[0] - self.x, origin[2] - self.z)
        dx, dz = self.turned(ray[0], ray[2])
        return (ox / self.hx, (origin[1] - self.y) / self.hy, oz / self.hz), (
            dx / self.hx,
            ray[1] / self.hy,
            dz / self.hz,
        )


class Sides(NamedTuple):
    """The normal at a point of a body, in the body's own axes, and the faces of a box as masks."""

    normal: Point
    end: Tensor  # |z| = hz
    flank: Tensor  # |x| = hx
    roof: Tensor  # the pitched pair, or the top where there is none


def rays(view: View, height: int, width: int, offsets: Sequence[tuple[float, float]]) -> Point:
    """The directions of rays at offsets (right, down) from the pixels' centers, in px, each (S, B, H, W).

    Along the camera's axis they have length 1, so that a ray's parameter is the z-depth.
    """
    device = view.x.device
    aside = torch.tensor(offsets, device=device).view(-1, 2, 1, 1, 1)
    scale = view.focal * max(height, width)
    right = (torch.arange(width, device=device) + (0.5 - width / 2) + aside[:, 0]) / scale  # (S, B, 1, W)
    down = (torch.arange(height, device=device)[:, None] + (0.5 - height / 2) + aside[:, 1]) / scale  # (S, B, H, 1)
    t = view.turn
    x, y, z = ((t[i] * right + t[i + 2]) + t[i + 1] * down for i in (0, 3, 6))
    return x, y, z


def ground_depth(view: View, ray: Point) -> Tensor:
    """z-depth of the plane y = 0: height / -ray_y; inf from the horizon up."""
    return torch.where(ray[1] < 0, view.height / -ray[1], torch.inf)


def meet_box(shape: Shape, origin: Point, ray: Point) -> tuple[Tensor, Tensor]:
    """Where a ray enters a box with a pitched top, and the length inside (both in ray parameters; <= 0: missed)."""
    (ox, oy, oz), (dx, dy, dz) = shape.unit_ray(origin, ray)
    near, far = _slab(ox, dx)
    for low, high in (_slab(oy, dy), _slab(oz, dz)):
        near, far = torch.maximum(near, low), torch.minimum(far, high)
    for pitch in (shape.pitch, -shape.pitch):
        speed = dy + pitch * dz
        cut = (shape.level - oy - pitch * oz) / speed
        near = torch.where(speed < 0, torch.maximum(near, cut), near)
        far = torch.where(speed > 0, torch.minimum(far, cut), far)
    return near, far - near


def meet_ball(shape: Shape, origin: Point, ray: Point) -> tuple[Tensor, Tensor]:
    """Where a ray enters an ellipsoid, and half the chord inside in radii (0: missed)."""
    (ox, oy, oz), (dx, dy, dz) = shape.unit_ray(origin, ray)
    a = dx * dx + dy * dy + dz * dz
    b = (ox * dx + oy * dy + oz * dz) / a
    cx, cy, cz = ox - b * dx, oy - b * dy, oz - b * dz  # the nearest point to the center: no cancellation far away
    chord = (1 - (cx * cx + cy * cy + cz * cz)).clamp(min=0).sqrt()
    return -b - chord / a.sqrt(), chord


def box_sides(shape: Shape, point: Point) -> Sides:
    """The face that a surface point lies on: the one whose inequality is tightest."""
    x, y, z = point[0] / shape.hx, point[1] / shape.hy - 1, point[2] / shape.hz
    pitched = y + shape.pitch * z.abs() - shape.level + 1
    roof = torch.maximum(pitched, y)
    flank = (x.abs() > z.abs()) & (x.abs() > roof)
    end = ~flank & (z.abs() > roof)
    over = ~flank & ~end
    z_sign = torch.where(z < 0, -1.0, 1.0)
    slope = z_sign * shape.pitch * shape.hy / shape.hz * (pitched >= y)
    up = over / (1 + slope * slope).sqrt()
    return Sides((torch.where(x < 0, -1.0, 1.0) * flank, up, z_sign * end + slope * up), end, flank, over)


def ball_sides(shape: Shape, point: Point) -> Sides:
    x, y, z = point[0] / (shape.hx * shape.hx), (point[1] / shape.hy - 1) / shape.hy, point[2] / (shape.hz * shape.hz)
    scale = 1 / (x * x + y * y + z * z).clamp(min=1e-12).sqrt()
    none = x > torch.inf
    return Sides((x * scale, y * scale, z * scale), none, none, none)


def own_point(shape: Shape, origin: Point, ray: Point, depth: Tensor) -> Point:
    """The point at `depth` of a ray in the body's own axes, meters, y from its foot."""
    x, z = shape.turned(origin[0] + depth * ray[0] - shape.x, origin[2] + depth * ray[2] - shape.z)
    return x, origin[1] + depth * ray[1] - (shape.y - shape.hy), z


def noise(x: Tensor, y: Tensor) -> Tensor:
    """Value noise in [-1, 1] with unit cells, smooth, of period 256; its lattice is fixed, callers shift x and y."""
    column, row = x.floor(), y.floor()
    x, y = x - column, y - row
    x, y = x * x * (3 - 2 * x), y * y * (3 - 2 * y)
    index = (row.int() & (_TILE - 1)) * _TILE + (column.int() & (_TILE - 1))
    a, b, c, d = _tile(x.device).index_select(0, index.flatten()).view(*index.shape, 4).unbind(-1)
    top = a + x * b
    return top + y * (c + x * d)


@cache
def _tile(device: torch.device) -> Tensor:
    # (256 * 256, 4): the bilinear form a + b x + c y + d x y of each cell, so that a look-up reads one cache line.
    keys = torch.arange(_TILE, dtype=torch.int64, device=device)
    v00 = uniform(stream(0, keys), _TILE) * 2 - 1
    v01, v10 = v00.roll(-1, 1), v00.roll(-1, 0)
    v11 = v10.roll(-1, 1)
    return torch.stack([v00, v01 - v00, v10 - v00, v00 - v01 - v10 + v11], dim=-1).view(-1, 4)


def _slab(origin: Tensor, speed: Tensor) -> tuple[Tensor, Tensor]:
    low, high = (-1 - origin) / speed, (1 - origin) / speed
    return torch.minimum(low, high), torch.maximum(low, high)


def eye(view: View, sample: Tensor) -> Point:
    x = pick(view.x, sample)
    return x, pick(view.height, sample), torch.zeros_like(x)


def pick(field: Tensor, index: Tensor) -> Tensor:
    return field.reshape(-1).index_select(0, index)  # four times as fast as field[index]


def pick_point(point: Point, index: Tensor) -> Point:
    return pick(point[0], index), pick(point[1], index), pick(point[2], index)
