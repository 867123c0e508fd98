"""The flow that undoes a flow, with a certificate."""

from typing import NamedTuple

import torch
from torch import Tensor

from torchrefract._checks import check_count, check_flow, check_positive, is_true, read
from torchrefract._constants import constant
from torchrefract.warping.grid import field_dtype, inside, length, pixel_axes, sampler_positions, squared_length
from torchrefract.warping.resample import look_up, sampled, sampler_dtype

# Px: a residual that calls for no further step.
_NEAR = {torch.float32: 1e-3, torch.float64: 1e-9}
# Px: flow from here on leads nowhere, and its square is a number still.
_FARTHEST = 1e12
# Of determinants: what is nearer to a fold is begun without slopes.
_UPRIGHT = 0.5
# Steps of all pixels of a sample by the slopes they began with, while more than this share of them is left. Slopes read
# anew, and pixels picked one by one, cost more for each, and pay where few are left.
_AT_ONCE, _MANY = 3, 1 / 8
_ROW = 1024  # pixels that are picked out lie in rows of so many


def invert_flow(flow: Tensor, *, steps: int = 8, tolerance_px: float = 0.05) -> tuple[Tensor, Tensor, Tensor]:
    """The flow that undoes a warp: warp(warp(image, flow), inverse) = image on `valid`.

        inverse(p) + flow(p + inverse(p)) = 0, solved by Newton's method from no flow, each pixel by itself:
        inverse <- inverse - (I + grad flow)^-1 (inverse + flow),  flow read at p + inverse,
        its gradient at first at p, for up to 3 steps while many pixels need them, and at p + inverse then; where no
        value can be read (accelerators, compilers) at p + inverse from the second step on

    The flow is read bilinearly, its gradient by central differences. The gradient with respect to `flow` comes from
    one attached Newton step at the solution (implicit function theorem), not from unrolling.

    Args:
        flow: (B, 2, H, W), px.
        steps: Newton steps at most beside the first, at least 1; a pixel takes no more once its residual is within
            1e-3 px (1e-9 px in float64).
        tolerance_px: the residual up to which a pixel counts as solved, px.

    Returns:
        inverse: (B, 2, H, W), px.
        valid: (B, 1, H, W), bool: solved, on a sheet that is not folded over, looked up inside the frame.
        residual_px: (B, 1, H, W), px, |inverse(p) + flow(p + inverse(p))|.

    Raises:
        ValueError: a flow of another shape, no step, a tolerance that is not positive.

    Newton and the fixed point inverse <- -flow(p + inverse) end in the same inverse, equally smooth, valid on the same
    pixels. To 1e-3 px on 99.9 % of them Newton takes 6 to 9 bare grid_samples on the defaults of the four warps and 13
    to 17 on strong ones, the fixed point 7 to 20, and 20 to 44; on a strong lens (k1 = -0.4) the fixed point is still
    17 px off after 30 steps. Measured by benchmarks/inverses.py on frames of 1280 x 720.

    Source: Chen, Lu, Chen, Ruchala, Olivera, "A simple fixed-point approach to invert a deformation field", Medical
    Physics 35 (2008), for the equation and the fixed point.
    """
    check_flow("flow", flow)
    check_count("steps", steps)
    check_positive("tolerance_px", tolerance_px)
    flow = flow.to(field_dtype(flow.dtype))
    if flow.numel() == 0:
        return flow.clone(), flow[:, :1] == 0, flow[:, :1].clone()
    whole = is_true(lambda: flow.abs().amax() <= _FARTHEST)
    known = None if whole else (flow.abs() <= _FARTHEST).all(dim=1, keepdim=True)
    flow = flow if known is None else torch.where(known, flow, 0)
    with torch.no_grad():
        # In large frames the positions are of another type.
        found = _solved(flow.to(sampler_dtype(flow, flow.dtype)), steps)
        solution = inverse = found.inverse.to(flow.dtype)
        residual = length(found.error).to(flow.dtype)
        valid = (residual <= tolerance_px) & (found.determinant > 0) & inside(solution)
        if known is not None:
            # Nothing is known where a hole in the flow would have been read.
            valid = valid & known & (_read(known.to(flow.dtype), solution) > 0.999)
    if flow.requires_grad and torch.is_grad_enabled():
        moved = _read(flow, solution)
        slopes = _cell_gradient(flow.detach(), solution)
        inverse = solution - _step(slopes, _determinant(slopes), moved - moved.detach())
    return inverse, valid, residual


class _Pixels(NamedTuple):
    """Pixels of each sample, in rows, and what is known of them."""

    home: Tensor  # (1, 2, n, m), where they are, in the sampler's coordinates
    inverse: Tensor  # (B, 2, n, m), px
    error: Tensor  # (B, 2, n, m), px, what is to vanish: inverse + flow, read at p + inverse
    determinant: Tensor  # (B, 1, n, m), read there too

    def left(self) -> Tensor:
        """(B, 1, n, m), bool: those that take another step."""
        return squared_length(self.error) > _NEAR[self.error.dtype] ** 2

    def picked(self, index: Tensor) -> "_Pixels":
        """Some of those of one sample, by their numbers, (N,), a multiple of the length of a row."""
        return _Pixels(*(value.flatten(2).index_select(2, index).unflatten(2, (-1, _ROW)) for value in self))


class _Fields(NamedTuple):
    """What Newton's method reads."""

    flow: Tensor  # (B, 3, H, W): the flow, px, and the determinant of I + its slopes
    slopes: Tensor  # (B, 4, H, W), as of `_gradient`

    def at(self, home: Tensor, inverse: Tensor) -> _Pixels:
        """Pixels with their inverse."""
        there = self._read(self.flow, home, inverse)
        return _Pixels(home, inverse, inverse + there[:, :2], there[:, 2:])

    def stepped(self, pixels: _Pixels) -> _Pixels:
        """After a step with the slopes at p + inverse."""
        slopes = self._read(self.slopes, pixels.home, pixels.inverse)
        return self.at(pixels.home, pixels.inverse - _step(slopes, _determinant(slopes), pixels.error))

    def _read(self, field: Tensor, home: Tensor, inverse: Tensor) -> Tensor:
        height, width = field.shape[2:]
        scale = constant((2 / width, 2 / height), dtype=home.dtype, device=home.device).view(2, 1, 1)
        grid = torch.addcmul(home, inverse, scale).movedim(1, -1)
        return sampled(field, grid, padding="border", interpolation="bilinear")


def _solved(flow: Tensor, steps: int) -> _Pixels:
    """All pixels after some steps. What becomes of one depends on no other, and on no other sample."""
    slopes = _gradient(flow)
    determinant = _determinant(slopes)
    fields = _Fields(torch.cat([flow, determinant], dim=1), slopes)
    # The first step, from no flow at all, has nothing to read.
    begun = _begun(slopes, determinant)
    pixels = fields.at(_home(flow), -_step(*begun, flow))
    if read(lambda: pixels.error[0, 0, 0, 0]) is None:
        for _ in range(steps):
            inverse = torch.where(pixels.left(), fields.stepped(pixels).inverse, pixels.inverse)
            pixels = fields.at(pixels.home, inverse)
        return pixels
    ends = [
        _finished(_Fields(*own[:2]), _Pixels(pixels.home, *own[2:5]), own[5:], steps)
        for own in zip(*(value.split(1) for value in (*fields, *pixels[1:], *begun)), strict=True)
    ]
    if len(ends) == 1:
        return ends[0]
    return _Pixels(pixels.home, *map(torch.cat, zip(*(end[1:] for end in ends), strict=True)))


def _home(flow: Tensor) -> Tensor:
    """(1, 2, H, W): where the pixels of a flow are, in the sampler's coordinates."""
    height, width = flow.shape[2:]
    x, y = pixel_axes(height, width, dtype=flow.dtype, device=flow.device)
    still = flow.new_zeros(()).expand(1, 2, height, width)
    return sampler_positions(still, x, y, height=height, width=width)


def _begun(slopes: Tensor, determinant: Tensor) -> tuple[Tensor, Tensor]:
    """Slopes and determinant for the first steps."""
    upright = determinant >= _UPRIGHT
    if is_true(upright.all):
        return slopes, determinant
    return torch.where(upright, slopes, 0), torch.where(upright, determinant, 1)


def _finished(fields: _Fields, pixels: _Pixels, begun: tuple[Tensor, Tensor], steps: int) -> _Pixels:
    """The pixels of one sample after the steps that they need."""
    left = pixels.left()
    count, at_once = int(left.sum()), min(steps, _AT_ONCE)
    while at_once > 0 and count > _MANY * left.numel():
        pixels = fields.at(pixels.home, pixels.inverse - _step(*begun, pixels.error))
        left = pixels.left()
        count, at_once, steps = int(left.sum()), at_once - 1, steps - 1
    if steps == 0 or count == 0:
        return pixels
    index = _filled(left)
    some, ends = pixels.picked(index), [value.contiguous().flatten(2) for value in pixels[1:]]
    while steps > 0 and len(index):
        some, steps = fields.stepped(some), steps - 1
        for end, value in zip(ends, some[1:], strict=True):
            end.index_copy_(2, index, value.flatten(2))
        places = _filled(some.left())
        index, some = index[places], some.picked(places)
    return _Pixels(pixels.home, *(end.unflatten(2, left.shape[2:]) for end in ends))


def _filled(flags: Tensor) -> Tensor:
    """(N,): the numbers of those that are true, the last one again until they fill their rows."""
    index = flags.flatten().nonzero()[:, 0]
    return torch.cat([index, index[-1:].expand(-len(index) % _ROW)])


def _gradient(flow: Tensor) -> Tensor:
    """(B, 4, H, W): u_x, v_x, u_y, v_y by central differences, one-sided at the border."""
    sides = [torch.gradient(flow, dim=dim)[0] if flow.shape[dim] > 1 else torch.zeros_like(flow) for dim in (-1, -2)]
    return torch.cat(sides, dim=1)


def _cell_gradient(flow: Tensor, at: Tensor) -> Tensor:
    """(B, 4, H, W): u_x, v_x, u_y, v_y of the bilinear reading itself at p + at(p), each the slope of a cell."""
    axes = pixel_axes(flow.shape[2], flow.shape[3], dtype=flow.dtype, device=flow.device)
    slopes = []
    for channel, axis in enumerate(axes):
        shift = (axis + at[:, channel : channel + 1]).floor() - axis
        low = torch.cat([shift, at[:, 1:]] if channel == 0 else [at[:, :1], shift], dim=1)
        high = low + torch.eye(2, dtype=flow.dtype, device=flow.device)[channel].view(1, 2, 1, 1)
        ends = (_read(flow, end) for end in (high, low))
        slopes.append(torch.sub(*ends))
    return torch.cat(slopes, dim=1)


def _read(field: Tensor, at: Tensor) -> Tensor:
    """A field (B, C, H, W) at p + at(p)."""
    return look_up(field, at, padding="border", interpolation="bilinear")


def _determinant(slopes: Tensor) -> Tensor:
    """(B, 1, H, W): of I + the slopes (B, 4, H, W), as of `_gradient`."""
    u_x, v_x, u_y, v_y = slopes.split(1, dim=1)
    return (1 + u_x) * (1 + v_y) - u_y * v_x


def _step(slopes: Tensor, determinant: Tensor, error: Tensor) -> Tensor:
    """(B, 2, H, W): (I + slopes)^-1 error, no longer than any flow, so that all that comes of it is a number."""
    # Near a fold the step has no good length; a bounded determinant keeps it finite, the residual tells the rest.
    determinant = determinant.abs().clamp(min=0.1).copysign(determinant)
    u_x, v_x, u_y, v_y = slopes.split(1, dim=1)
    x, y = error.split(1, dim=1)
    right = torch.addcmul(torch.addcmul(x, v_y, x), u_y, y, value=-1)
    down = torch.addcmul(torch.addcmul(y, u_x, y), v_x, x, value=-1)
    return (torch.cat([right, down], dim=1) / determinant).clamp(-_FARTHEST, _FARTHEST)
