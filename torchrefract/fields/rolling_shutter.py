"""A rolling shutter: rows that a moving camera exposes one after the other.

The camera looks along z, x to the right and y down. At the time t from the middle of the frame it stands at v t on the
axis z of the pose at t = 0, and is turned by the angles a(t) - a(0). The clean frame is the one of that pose.
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from torchrefract._tensor import highest_nearby
from torchrefract._validation import eager_values
from torchrefract.cameras.camera import Pinhole
from torchrefract.warping.grid import Points, pixel_axes
from torchrefract.warping.implicit import sample_at

_SMALLEST_SCALE = 0.05  # of the distance to a point while the rows are read; below, the camera passes the point
_OUTSIDE = 2.0  # frames off, where points without a source are sampled
_LARGEST_SHARE = 0.9  # of a step of the time at which a point is exposed, as far as it is extrapolated
_LARGEST_MISS_PX = 0.01
_TINY = 1e-15  # 1/m; a change of 0 is divided by it
_LARGEST_SLOPE = 0.5  # of the fixed point of depth, as far as it is extrapolated; edges of depth are steeper


class ShutterMotion(NamedTuple):
    """The motion of N cameras while they expose a frame."""

    speed: Tensor  # (N,), m/s, forward
    readout: Tensor  # (N,), s, from the first row to the last one; below 0 from the last one to the first one
    moment: Tensor  # (N,), s, from the middle of the exposure of each row
    amplitude: Tensor  # (N, 3), rad, of pitch, yaw and roll
    frequency: Tensor  # (N, K), Hz
    phase: Tensor  # (N, 3, K), rad, in the middle of the frame


def row_time(motion: ShutterMotion, y: Tensor, *, height: int) -> Tensor:
    """Return t(y) = ((y + 1/2) / H - 1/2) readout + moment, s; y broadcasts to (N, 1, h, w), px."""
    readout, moment = (value.view(-1, 1, 1, 1) for value in (motion.readout, motion.moment))
    return (y - (height - 1) / 2) * (readout / height) + moment


def turn(motion: ShutterMotion, time: Tensor) -> list[Tensor]:
    """Return the angles by which the camera has turned since the middle of the frame, pitch, yaw and roll, rad.

        a_i(t) - a_i(0) = amplitude_i / sqrt(K) sum_k (sin(2 pi f_k t + phase_ik) - sin(phase_ik))

    The K sines together have the variance of one sine of the amplitude.

    Args:
        motion: of N cameras.
        time: (N, 1, h, w), s.

    Returns:
        Three tensors (N, 1, h, w).
    """
    share = motion.amplitude / math.sqrt(motion.frequency.shape[1])
    angles = [torch.zeros_like(time)] * 3
    for k, frequency in enumerate(motion.frequency.unbind(1)):
        angle = 2 * math.pi * frequency.view(-1, 1, 1, 1) * time
        sine, cosine = angle.sin(), angle.cos() - 1
        for axis in range(3):
            phase = motion.phase[:, axis, k].view(-1, 1, 1, 1)
            scale = share[:, axis].view(-1, 1, 1, 1)
            angles[axis] = angles[axis] + scale * phase.cos() * sine + scale * phase.sin() * cosine
    return angles


def rotation(angles: list[Tensor]) -> list[list[Tensor]]:
    """Return the rows of R = R_y(yaw) R_x(pitch) R_z(roll), which turns rays at time t to the pose at t = 0."""
    (sx, sy, sz), (cx, cy, cz) = ([function(angle) for angle in angles] for function in (torch.sin, torch.cos))
    return [
        [cy * cz + sy * sx * sz, sy * sx * cz - cy * sz, sy * cx],
        [cx * sz, cx * cz, -sx],
        [cy * sx * sz - sy * cz, sy * sz + cy * sx * cz, cy * cx],
    ]


def nearest_exposed(motion: ShutterMotion, inverse_depth: Tensor, pinhole: Pinhole) -> Tensor:
    """Return about which 1/Z each pixel shows if the camera does not turn, (N, 1, H, W), and 0 where none is known.

    Each pixel of the clean frame is moved to the pixel that shows it, and the nearest one counts, also for the pixels
    around. It finds thin objects that move farther than they are wide. Without gradient.

    Args:
        motion, pinhole: as for `rolling_shutter_flow`.
        inverse_depth: (N, 1, H, W), 1/m, of the clean frame.
    """
    height, width = inverse_depth.shape[2:]
    with torch.no_grad():
        inverse_depth, (cx, cy) = inverse_depth.detach(), pinhole[1]
        motion = ShutterMotion(*(value.detach() for value in motion))
        x, y = pixel_axes(height, width, dtype=inverse_depth.dtype, device=inverse_depth.device)

        def scale_at(row: Tensor) -> Tensor:
            way = motion.speed.view(-1, 1, 1, 1) * row_time(motion, row, height=height)
            return (1 - way * inverse_depth).clamp(min=_SMALLEST_SCALE)

        scale = scale_at((y - cy) / scale_at(y) + cy)
        # A border of one pixel around the frame collects what leaves it. NaN too has an integer, which can be clamped.
        row, column = (
            ((position - center) / scale + (center + 1.5)).int().clamp(0, size + 1)
            for position, center, size in ((y, cy, height), (x, cx, width))
        )
        index = (row * (width + 2) + column).long().flatten(1)
        nearest = inverse_depth.new_zeros(len(index), (height + 2) * (width + 2))
        nearest = nearest.scatter_reduce(1, index, inverse_depth.expand(len(index), -1, -1, -1).flatten(1), "amax")
        return highest_nearby(nearest.view(-1, 1, height + 2, width + 2)[:, :, 1:-1, 1:-1])


def rolling_shutter_flow(
    motion: ShutterMotion, inverse_depth: Tensor, points: Points, pinhole: Pinhole
) -> tuple[Tensor, Tensor]:
    """Compute the backward flow of a rolling shutter.

        p + flow(p) = c + f (r_x, r_y) / r_z (1 - v t / Z),  r = R(t) ((x - cx) / fx, (y - cy) / fy, 1),  t = t(y)

    Z is the depth where the point ends, at p + flow(p). It is found by two fixed-point steps, extrapolated by the slope
    between them: exact for planes. They start at the nearest depth that a map moves to the point, or at infinity.

    Args:
        motion: of N cameras.
        inverse_depth: (N, 1, H, W or 1), 1/m, of the clean frame.
        points: where the flow is computed, px.
        pinhole: of the camera.

    Returns:
        flow: (N, 2, h, w), px.
        exists: (N, 1, h, w), bool: False for points that the camera passes or that it turns away from.

    Source: Zhuang, Cheong, Lee, "Rolling-shutter-aware differential SfM and image rectification", ICCV 2017, for motion
    and depth; Karpenko et al., "Digital video stabilization and rolling shutter correction using gyroscopes", Stanford
    CTSR 2011-03, for the camera that turns.
    """
    height, width = points.lattice.height, points.lattice.width
    (fx, fy), (cx, cy) = pinhole
    time = row_time(motion, points.y, height=height)
    x, y = (points.x - cx) / fx, (points.y - cy) / fy
    # A row at a time: of undisplaced points only the products with x are computed at each of them.
    rx, ry, rz = (
        f * a * x + f * (b * y + c) for f, (a, b, c) in zip((fx, fy, 1.0), rotation(turn(motion, time)), strict=True)
    )
    along, is_ahead = motion.speed.view(-1, 1, 1, 1) * time, rz > _SMALLEST_SCALE
    rz = rz.clamp(min=_SMALLEST_SCALE)
    # The point without forward motion, seen from the principal point, px.
    turned_x, turned_y = rx / rz, ry / rz

    def at(scale: Tensor | float) -> Points:
        return points._replace(x=cx + turned_x * scale, y=cy + turned_y * scale, is_displaced=True)

    def step(inverse: Tensor) -> Tensor:
        return sample_at(inverse_depth, at((1 - along * inverse).clamp(min=_SMALLEST_SCALE)))

    start = torch.zeros_like(along)
    if inverse_depth.shape[3] > 1:
        start = sample_at(nearest_exposed(motion, inverse_depth, pinhole), at(1.0))
    first = step(start)
    second = step(first)
    before, after = first - start, second - first
    extrapolated = second + after * after / (before - after + _TINY)
    # Across an edge of depth the nearest counts.
    is_flat = after.abs() < _LARGEST_SLOPE * before.abs()
    scale = 1 - along * torch.where(is_flat, extrapolated, torch.maximum(first, second))
    exists = is_ahead & (scale > _SMALLEST_SCALE)
    end = at(scale)
    flow = torch.cat(torch.broadcast_tensors(end.x - points.x, end.y - points.y), dim=1)
    if eager_values(exists.all, of=exists) is not True:
        flow = torch.where(exists, flow, _OUTSIDE * max(height, width))
    return flow, exists


def rolling_shutter_restore_flow(
    motion: ShutterMotion, inverse_depth: Tensor, points: Points, pinhole: Pinhole
) -> tuple[Tensor, Tensor]:
    """Compute the flow from the pixels of a clean frame to where a rolling shutter shows them.

    The point at depth Z on the ray of a pixel lies at R(t)^T (X - v t e_z) at time t. The time at which its row is
    exposed is found by fixed-point steps, extrapolated as by Aitken.

    Args:
        motion, pinhole: as for `rolling_shutter_flow`.
        inverse_depth: (N, 1, H, W or 1), 1/m, of the clean frame.
        points: its pixels.

    Returns:
        flow: (N, 2, H, W), px.
        exists: (N, 1, H, W), bool: the point is in front of the camera when its row is exposed, and the last step moved
            it by at most 0.01 px.
    """
    height = points.lattice.height
    (fx, fy), (cx, cy) = pinhole
    x, y = (points.x - cx) / fx, (points.y - cy) / fy
    speed = motion.speed.view(-1, 1, 1, 1)

    def exposed(row: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return u, v, the row, within a frame from the frame, and where the point is in front of the camera."""
        time = row_time(motion, row, height=height)
        (a, b, c), (d, e, f), (g, h, i) = rotation(turn(motion, time))
        z = 1 - speed * time * inverse_depth
        rx, ry, rz = a * x + d * y + g * z, b * x + e * y + h * z, c * x + f * y + i * z
        ahead, rz = rz > _SMALLEST_SCALE, rz.clamp(min=_SMALLEST_SCALE)
        u, v = cx + fx * (rx / rz) - points.x, cy + fy * (ry / rz) - points.y
        return u, v, (points.y + v).clamp(-height, 2 * height), ahead & (z > 0)

    rows = [points.y]
    for _ in range(2):
        rows.append(exposed(rows[-1])[2])
    # The rows of the steps are nearly a geometric series.
    step = rows[1] - rows[0]
    share = ((rows[2] - rows[1]) / torch.where(step.abs() < 1e-6, 1.0, step)).clamp(-_LARGEST_SHARE, _LARGEST_SHARE)
    row = exposed(rows[2] + (rows[2] - rows[1]) * share / (1 - share))[2]
    u, v, end, is_ahead = exposed(row)
    exists = is_ahead & ((end - row).abs() <= _LARGEST_MISS_PX)
    return torch.where(exists, torch.cat(torch.broadcast_tensors(u, v), dim=1), 0.0), exists
