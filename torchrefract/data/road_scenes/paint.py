"""The colors of a road scene: ground, sky, and bodies in the light. Linear colors, (3, ...)."""

from typing import NamedTuple

import torch
from torch import Tensor

from torchrefract.data.road_scenes.geometry import Point, View, eye, noise, own_point, pick, pick_point
from torchrefract.data.road_scenes.layout import Light, Road
from torchrefract.data.road_scenes.visibility import CHUNK, NO_BODY, Group

_CEILING = 900.0  # m, of the clouds
_CLOUD_SCALE = 170.0  # how much larger than the ground's their texture is
_HAZE = 9000.0  # m: a contrast of one half there; real fog is an effect's business


class Grain(NamedTuple):
    """Noise in [-1, 1] of four cell sizes, each faded out where a pixel holds more than about a cell of it."""

    fine: Tensor
    small: Tensor
    middle: Tensor
    coarse: Tensor


def color(red: float, green: float, blue: float, like: Tensor) -> Tensor:
    return torch.tensor([red, green, blue], device=like.device).view(3, 1, 1, 1)


def blend(under: Tensor, over: Tensor, share: Tensor) -> Tensor:
    return under + (over - under) * share


def covered(distance: Tensor, footprint: Tensor) -> Tensor:
    """The share of a footprint inside an edge `distance` away (positive inside)."""
    return (distance / footprint + 0.5).clamp(0, 1)


def band(distance: Tensor, width: float, footprint: Tensor) -> Tensor:
    """The share of a footprint at `distance` from the middle of a band that the band covers."""
    half = footprint / 2
    return ((distance + half).clamp(max=width / 2) - (distance - half).clamp(min=-width / 2)).clamp(min=0) / footprint


def dashes(position: Tensor, period: float, length: float, footprint: Tensor) -> Tensor:
    """The share of a footprint that dashes of a period cover: the exact box filter."""

    def painted(end: Tensor) -> Tensor:
        whole = (end / period).floor()
        return whole * length + (end - whole * period).clamp(max=length)

    return (painted(position + footprint / 2) - painted(position - footprint / 2)) / footprint


class Plane(NamedTuple):
    """Where rays meet a level plane: x, z and what a pixel covers across and along; m, each (B, H, W)."""

    x: Tensor
    z: Tensor
    across: Tensor
    along: Tensor


def backdrop(road: Road, light: Light, view: View, ray: Point) -> tuple[Tensor, Tensor]:
    """(3, B, H, W), twice: ground and sky before any body, in the sun and in the shade; `ray`: (B, H, W) each.

    Its texture, lines and edges are filtered by the pixel's footprint: one ray a pixel is enough.
    """
    below = ray[1] < 0
    batch, height, width = below.shape
    # Only rows that show some ground are worth its cost, and likewise for the sky.
    first, last = height - int(below.any(2).any(0).sum()), int((~below).any(2).any(0).sum())
    above, under = _rows(ray, 0, last), _rows(ray, first, height)
    lit = below.new_empty((3, batch, height, width), dtype=torch.float32)
    clouds = _plane(view, above, _CEILING - view.height, max(height, width))
    lit[:, :, :last] = tone(_sky(light, above, _grain(road, clouds, _CLOUD_SCALE)))
    dim = lit.clone()
    plane = _plane(view, under, view.height, max(height, width))
    albedo = _ground(road, view, plane, _grain(road, plane, 1.0))
    for image, sunlit in ((lit, 1.0), (dim, 0.15)):
        color = albedo * (light.ambient * 0.95 + light.beam * (light.sun[1] * sunlit))
        color = tone(blend(color, light.horizon * 0.9, plane.z / (plane.z + _HAZE)))
        image[:, :, first:] = torch.where(under[1] < 0, color, image[:, :, first:])
    return lit, dim


def tone(light: Tensor) -> Tensor:
    # The square root stands for the display's gamma: it is exactly rounded everywhere, a power is not.
    return light.clamp(0, 1).sqrt()


def _rows(ray: Point, first: int, last: int) -> Point:
    return ray[0][:, first:last], ray[1][:, first:last], ray[2][:, first:last]


def _plane(view: View, ray: Point, drop: Tensor, size: int) -> Plane:
    """The plane `drop` below the camera, or above it where that is where the ray goes, up to 30 km away."""
    depth = (drop / ray[1].abs()).clamp(max=3e4)
    across = depth / (view.focal * size)
    return Plane(view.x + depth * ray[0], depth * ray[2], across, across * depth / drop)


def _grain(road: Road, plane: Plane, scale: float) -> Grain:
    footprint = torch.maximum(plane.across, 0.5 * plane.along) / scale
    x, z = plane.x / scale, plane.z / scale
    octaves = []
    for cell in (0.035, 0.2, 1.3, 8.0):
        filled = footprint / cell
        octaves.append(noise(x / cell + road.shift_x, z / cell + road.shift_z) / (1 + filled * filled))
    return Grain(*octaves)


def _ground(road: Road, view: View, plane: Plane, grain: Grain) -> Tensor:
    """The albedo of the ground: verge, shoulder or pavement, road, paint."""
    x, z, across, along = plane
    side = x - road.center(z)
    # A pixel's rows run ahead: they cross a line beside the camera at a slant.
    across = across + along * ((x - view.x) / z.clamp(min=1) - road.heading(z)).abs()
    out, country = side.abs(), 1 - road.town
    ground = blend(_verge(road, grain), *_shoulder(road, out, across, grain))
    kerb = band(out - road.half - 0.1, 0.22, across) * road.town
    ground = blend(ground, color(0.5, 0.49, 0.46, x), kerb)
    ragged = (0.06 + 0.3 * (1 - road.paved)) * country * (grain.middle + 0.4 * grain.small)
    ground = blend(ground, _surface(road, side, grain), covered(road.half + ragged - out, across))
    white, yellow = _paint_share(road, side, z, (across, along))
    worn = (0.85 + 0.2 * grain.fine + 0.2 * grain.small + 0.15 * grain.coarse).clamp(0, 1) * road.paved
    ground = blend(ground, color(0.7, 0.7, 0.68, x), white * worn)
    return blend(ground, color(0.62, 0.42, 0.06, x), yellow * worn)


def _verge(road: Road, grain: Grain) -> Tensor:
    fine, small, middle, coarse = grain
    soil = blend(color(0.4, 0.3, 0.18, fine), color(0.42, 0.17, 0.08, fine), road.red_soil)
    grass = blend(color(0.42, 0.33, 0.13, fine), color(0.13, 0.2, 0.05, fine), road.wet_grass)
    tuft = (0.62 + coarse + 0.6 * middle + 0.5 * small + 0.3 * fine).clamp(0, 1)
    shade = 0.3 * fine + 0.2 * small
    return blend(soil * (1 + shade), grass * (1 + 1.3 * shade + 0.25 * middle), tuft)


def _shoulder(road: Road, out: Tensor, across: Tensor, grain: Grain) -> tuple[Tensor, Tensor]:
    """The color beside the road and its share: a strip of gravel, in a town a pavement of slabs."""
    gravel = blend(color(0.36, 0.3, 0.22, out), color(0.4, 0.2, 0.11, out), road.red_soil * 0.8)
    rough = 0.35 * grain.fine + 0.2 * grain.small + 0.1 * grain.middle
    slabs = color(0.36, 0.35, 0.33, out)
    strip = blend(gravel * (1 + rough), slabs * (1 + 0.5 * rough), road.town)
    ragged = 0.3 * (grain.middle + 0.5 * grain.small) * (1 - road.town)
    return strip, covered(road.half + road.paved * 1.1 + 0.9 * road.town + ragged - out, across)


def _surface(road: Road, side: Tensor, grain: Grain) -> Tensor:
    """Asphalt with darker wheel tracks, or gravel with paler ones."""
    fine, small, middle, coarse = grain
    wheel = ((side.abs() - road.lane / 2).abs() - 0.8).abs()
    track = (1 - wheel / 0.5).clamp(min=0)
    tar = 1 + 0.3 * fine + 0.1 * small + 0.05 * middle + 0.1 * coarse - 0.14 * track
    gravel = blend(color(0.42, 0.33, 0.22, side), color(0.44, 0.22, 0.12, side), road.red_soil)
    stones = 0.9 + 0.4 * fine + 0.3 * small + 0.16 * middle + 0.12 * coarse + 0.18 * track
    return blend(gravel * stones, color(1.0, 0.985, 0.97, side) * (road.tar * tar), road.paved)


def _paint_share(road: Road, side: Tensor, z: Tensor, footprint: tuple) -> tuple[Tensor, Tensor]:
    """How much of a pixel white and yellow road paint cover."""
    across, along = footprint
    dashed = torch.maximum(dashes(z + road.shift_x, 9.0, 4.0, along), road.barred)
    white = band(side, 0.14, across) * dashed
    edge = band(side.abs() - road.lane + 0.05, 0.13, across) * road.fringed
    bars = (
        dashes(side + 50, 1.2, 0.6, across)
        * band(z - road.zebra - 1.5, 3.0, along)
        * covered(road.half - side.abs(), across)
    )
    return torch.maximum(white, bars * (road.zebra > 0)), edge


def _sky(light: Light, ray: Point, grain: Grain) -> Tensor:
    """A gradient, a glow around the sun and clouds that thin out towards the horizon."""
    x, y, z = ray
    length = (x * x + y * y + z * z).sqrt()
    rise = (y / length).clamp(min=0)
    low = 1 / (1 + 6 * rise)
    sky = blend(light.zenith, light.horizon, low * low * (1 + rise))
    toward = ((x * light.sun[0] + y * light.sun[1] + z * light.sun[2]) / length).clamp(min=0)
    sky = sky + light.beam * (0.02 / (1.02 - toward) * (1 - light.cover.clamp(0.2, 0.95)))
    density = light.cover + 1.1 * grain.coarse + 0.6 * grain.middle + 0.25 * grain.small
    share = (density * 1.4).clamp(0, 1) * 0.85 * (rise * 14).clamp(max=1)
    shade = 0.95 - 0.3 * (density - 0.5).clamp(0, 1)
    return blend(sky, (light.beam * 0.45 + light.ambient * 0.85) * shade, share)


def paint_bodies(image: Tensor, groups: list[Group], light: Light, view: View, ray: Point, depth: Tensor, slot: Tensor):
    """Paint each body where it is the nearest surface; `image` (3, S, B, H, W) is changed in place."""
    slot = slot.flatten()
    seen, first = (slot < NO_BODY).nonzero().squeeze(1), 0
    slot = pick(slot, seen)
    for group in groups:
        size = group.shape.x.shape[1]
        for mine in ((slot >= first) & (slot < first + size)).nonzero().squeeze(1).split(CHUNK):
            place = pick(seen, mine)
            sample = place // depth[0, 0].numel() % depth.shape[1]
            owner = sample * size + pick(slot, mine) - first
            color = _body_color(group, (owner, sample), light, view, pick_point(ray, place), pick(depth, place))
            image.view(3, -1).scatter_(1, place.expand(3, -1), color)
        first += size


def _body_color(group: Group, index: tuple, light: Light, view: View, look: Point, depth: Tensor) -> Tensor:
    owner, sample = index
    body = group.shape.at(owner)
    point = own_point(body, eye(view, sample), look, depth)
    side = group.sides(body, point)
    albedo = group.paint(body, group.albedo.flatten(1).index_select(1, owner), point, side)
    sun = pick_point(light.sun, sample)
    sun_x, sun_z = body.turned(sun[0], sun[2])
    facing = (side.normal[0] * sun_x + side.normal[1] * sun[1] + side.normal[2] * sun_z).clamp(min=0)
    beam, ambient, horizon = (c.flatten(1).index_select(1, sample) for c in (light.beam, light.ambient, light.horizon))
    lit = albedo * (ambient * (0.75 + 0.25 * side.normal[1]) + beam * facing)
    return tone(blend(lit, horizon * 0.9, depth / (depth + _HAZE)))
