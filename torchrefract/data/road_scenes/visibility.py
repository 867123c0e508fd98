"""Which body each ray of a road scene meets first, and which ground lies in the shade.

A body is tried only on the pixels inside its projected bounds, its fragments, and a depth buffer keeps the nearest.
"""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from torchrefract.data.road_scenes.geometry import (
    Point,
    Shape,
    Sides,
    View,
    box_sides,
    eye,
    meet_box,
    own_point,
    pick,
    pick_point,
)

CHUNK = 1 << 19  # fragments at a time: bounds the memory of a 1080p frame
NO_BODY = 255
_NEAR = 0.2  # m
_ID_BITS = 8


def everything(shape: Shape, point: Point, chord: Tensor) -> Tensor:
    return chord > 0


class Group(NamedTuple):
    """Bodies of one kind. Points are in the body's own axes, in meters, y from its foot.

    present: (B, N), bool. albedo: (3, B, N). paint(shape, albedo, point, sides): its albedo at a point.
    solid(shape, point, chord): whether there is something where a ray enters. meet(shape, origin, ray): where that is,
    and the chord inside. sides(shape, point): the normal there. casts: whether it throws a shadow on the ground.
    """

    shape: Shape
    albedo: Tensor
    present: Tensor
    paint: Callable[[Shape, Tensor, Point, Sides], Tensor]
    solid: Callable[[Shape, Point, Tensor], Tensor] = everything
    meet: Callable[[Shape, Point, Point], tuple[Tensor, Tensor]] = meet_box
    sides: Callable[[Shape, Point], Sides] = box_sides
    casts: bool = True


def visibility(groups: list[Group], view: View, ray: Point, ground: Tensor) -> tuple[Tensor, Tensor]:
    """The nearest surface of each ray.

    Returns:
        depth: (S, B, H, W), m, inf for the sky; slot: likewise, int64, the body among those of all groups in
        order, NO_BODY for none.
    """
    # A positive float32 orders as its bits do: depth above, slot below makes one number with one smallest value.
    nearest = _bits(ground) << _ID_BITS | NO_BODY
    first = 0
    for group in groups:
        shape, size = group.shape, group.shape.x.shape[1]
        for owner, sample, pixel in _fragments(
            _bounds(view, _corners(shape), ground.shape, group.present), ground.shape
        ):
            body, origin, look = shape.at(owner), eye(view, sample), _pick_rays(ray, pixel)
            depth, chord = group.meet(body, origin, look)
            there = (chord > 0) & (depth > _NEAR) & group.solid(body, own_point(body, origin, look, depth), chord)
            packed = _bits(depth) << _ID_BITS | (owner - sample * size + first)
            place = _each_sample(pixel, ground)
            hit = there.flatten().nonzero().squeeze(1)
            nearest.view(-1).scatter_reduce_(0, pick(place, hit), pick(packed, hit), "amin")
        first += size
    return (nearest >> _ID_BITS).int().view(torch.float32), nearest & NO_BODY


def shadows(groups: list[Group], view: View, ray: Point, ground: Tensor, sun: Point) -> Tensor:
    """(S, B, H, W), bool: the ground points whose ray towards the sun meets a body."""
    dark = torch.zeros_like(ground, dtype=torch.bool)
    for group in groups:
        if not group.casts:
            continue
        shape = group.shape
        bounds = _bounds(view, _shadow_corners(shape, sun), ground.shape, group.present)
        for owner, sample, pixel in _fragments(bounds, ground.shape):
            body, look, beam = shape.at(owner), _pick_rays(ray, pixel), pick_point(sun, sample)
            depth = ground.flatten(1).index_select(1, pixel)
            foot = (pick(view.x, sample) + depth * look[0], torch.zeros_like(depth), depth * look[2])
            enter, chord = group.meet(body, foot, beam)
            there = (chord > 0) & (enter > -0.3) & group.solid(body, own_point(body, foot, beam, enter), chord)
            hit = (there & depth.isfinite()).flatten().nonzero().squeeze(1)
            dark.view(-1)[pick(_each_sample(pixel, ground), hit)] = True
    return dark


def _corners(shape: Shape) -> Point:
    device = shape.x.device
    signs = torch.tensor([[i & 1, i >> 1 & 1, i >> 2 & 1] for i in range(8)], device=device) * 2.0 - 1
    x, y, z = (
        half[..., None] * sign for half, sign in zip((shape.hx, shape.hy, shape.hz), signs.unbind(1), strict=True)
    )
    along, across = shape.along[..., None], shape.across[..., None]
    return (
        shape.x[..., None] + along * x + across * z,
        shape.y[..., None] + y,
        shape.z[..., None] - across * x + along * z,
    )


def _shadow_corners(shape: Shape, sun: Point) -> Point:
    x, y, z = _corners(shape)
    return x - y * sun[0] / sun[1], torch.zeros_like(y), z - y * sun[2] / sun[1]


def _bounds(view: View, corners: Point, size: torch.Size, present: Tensor) -> tuple[Tensor, ...]:
    """Left, top, width and height in pixels of what holds the projected corners; each (B * N,), int64."""
    x, y, z = corners[0] - view.x, corners[1] - view.height, corners[2]
    t = view.turn
    right, down, ahead = (t[i] * x + t[i + 3] * y + t[i + 6] * z for i in (0, 1, 2))
    height, width = size[2:]
    scale = view.focal * max(height, width)
    depth = ahead.clamp(min=_NEAR)
    behind = (ahead < _NEAR).any(-1)  # its projection has no bounds
    spans = []
    for position, limit in ((right * scale / depth + width / 2, width), (down * scale / depth + height / 2, height)):
        low = (position.amin(-1) - 1).floor().clamp(0, limit).masked_fill(behind, 0)
        high = (position.amax(-1) + 1).ceil().clamp(0, limit).masked_fill(behind, limit)
        spans.append((low.long().flatten(), ((high - low) * (present & (ahead > _NEAR).any(-1))).long().flatten()))
    (left, across), (top, tall) = spans
    return left, top, across, tall


def _fragments(bounds: tuple[Tensor, ...], size: torch.Size) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """The pixels within the bounds of each body, as flat indices (body, sample, pixel), some at a time."""
    left, top, width, height = bounds
    body = torch.arange(len(left), device=left.device).repeat_interleave(height)
    row = torch.arange(len(body), device=left.device) - pick(height.cumsum(0) - height, body) + pick(top, body)
    sample = body // (len(left) // size[1])
    tall, first = pick(width, body), (sample * size[2] + row) * size[3] + pick(left, body)
    start = tall.cumsum(0) - tall
    # Row by row, so that no index is divided, which is slow.
    for part, line in enumerate(torch.arange(len(body), device=left.device).repeat_interleave(tall).split(CHUNK)):
        place = torch.arange(len(line), device=left.device) + part * CHUNK
        yield pick(body, line), pick(sample, line), pick(first - start, line) + place


def _pick_rays(ray: Point, pixel: Tensor) -> Point:
    """(S, F) each: all samples of some pixels."""
    x, y, z = (axis.flatten(1).index_select(1, pixel) for axis in ray)
    return x, y, z


def _each_sample(pixel: Tensor, image: Tensor) -> Tensor:
    # Where a pixel's samples lie in a flat (S, B, H, W).
    return pixel + torch.arange(len(image), device=pixel.device)[:, None] * image[0].numel()


def _bits(depth: Tensor) -> Tensor:
    return depth.contiguous().view(torch.int32).long()
