"""The flow that undoes a flow, with a certificate."""

from typing import NamedTuple

import torch
from torch import Tensor

from torchrefract._compiled import SMALLEST, obstacle
from torchrefract._validation import check_count, check_flow, check_positive, eager_bool, eager_values
from torchrefract.warping.fused_newton import solved
from torchrefract.warping.grid import field_dtype, inside, pixel_axes, sampler_axes, squared_length
from torchrefract.warping.jacobian import Jacobian
from torchrefract.warping.resample import sample_image, sampled, sampler_dtype

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
        its gradient at first at p, for up to 3 steps (of smaller frames, and in float64, while many pixels need them),
        and at p + inverse then; where no value can be read (accelerators, compilers) there from the second step on

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
    pixels. To 1e-3 px on 99.9 % of them Newton takes 7 to 10 bare grid_samples on the defaults of the four warps and 14
    to 19 on strong ones, the fixed point 10 to 23, and 23 to 48; on a strong lens (k1 = -0.4) the fixed point is still
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
    whole = eager_bool(lambda: torch.stack(flow.detach().aminmax()).abs().amax() <= _FARTHEST, of=flow)
    known = None if whole else (flow.abs() <= _FARTHEST).all(dim=1, keepdim=True)
    flow = flow if known is None else torch.where(known, flow, 0)
    with torch.no_grad():
        # In large frames the positions are of another type.
        solution, residual, upright = _solved(flow.to(sampler_dtype(flow, flow.dtype)).contiguous(), steps)
        solution, residual = solution.to(flow.dtype), residual.to(flow.dtype)
        valid = (residual <= tolerance_px) & inside(solution)
        valid = valid if upright is None else valid & upright
        if known is not None:
            # Nothing is known where a hole in the flow would have been read.
            valid = valid & known & (_read(known.to(flow.dtype), solution) > 0.999)
    if not (flow.requires_grad and torch.is_grad_enabled()):
        return solution, valid, residual
    moved = _read(flow, solution)
    newton = _newton(_jacobian(*_cell_slopes(flow.detach(), solution)))
    inverse = newton.step(*solution.split(1, dim=1), *(moved - moved.detach()).split(1, dim=1))
    return torch.cat(inverse, dim=1), valid, residual


class _Newton(NamedTuple):
    """The inverse of a Jacobian, [[xx, -xy], [-yx, yy]], each (B, 1, n, m)."""

    xx: Tensor
    xy: Tensor
    yx: Tensor
    yy: Tensor

    def step(self, u: Tensor, v: Tensor, error_u: Tensor, error_v: Tensor) -> tuple[Tensor, Tensor]:
        """The inverse (u, v) after a step that undoes its error, no longer than any flow, so that it is a number."""
        u = torch.addcmul(torch.addcmul(u, self.xx, error_u, value=-1), self.xy, error_v)
        v = torch.addcmul(torch.addcmul(v, self.yy, error_v, value=-1), self.yx, error_u)
        return u.clamp(-_FARTHEST, _FARTHEST), v.clamp(-_FARTHEST, _FARTHEST)


class _Pixels(NamedTuple):
    """Pixels of each sample, in rows, and what is known of them; each (B, 1, n, m), or what broadcasts to it."""

    x: Tensor  # where they are, in the sampler's coordinates
    y: Tensor
    u: Tensor  # px, their inverse
    v: Tensor
    error_u: Tensor  # px, what is to vanish: inverse + flow, read at p + inverse
    error_v: Tensor
    determinant: Tensor | None = None  # read there too; None for a sheet that is upright everywhere

    @property
    def known(self) -> list[Tensor]:
        """What steps change."""
        ends = [self.u, self.v, self.error_u, self.error_v]
        return ends if self.determinant is None else [*ends, self.determinant]

    @property
    def squared_error(self) -> Tensor:
        """(B, 1, n, m), px^2."""
        return squared_length(self.error_u, self.error_v)

    def left(self) -> Tensor:
        """(B, 1, n, m), bool: those that take another step."""
        return self.squared_error > _NEAR[self.error_u.dtype] ** 2

    def stepped(self, newton: _Newton) -> tuple[Tensor, Tensor]:
        """Their inverse after a step."""
        return newton.step(self.u, self.v, self.error_u, self.error_v)

    def picked(self, index: Tensor) -> "_Pixels":
        """Some of those of one sample, by their numbers, (N,), a multiple of the length of a row."""
        planes = (self.x, self.y, *self.known)
        return _Pixels(*(plane.flatten()[index].view(1, 1, -1, _ROW) for plane in planes))


class _Fields(NamedTuple):
    """What Newton's method reads."""

    flow: Tensor  # (B, 3, H, W): the flow, px, and the determinant of I + its slopes; without that if upright, (B, 2)
    along: Tensor  # (B, 2, H, W), the slopes of u and v along x
    across: Tensor  # (B, 2, H, W), those along y

    def at(self, x: Tensor, y: Tensor, u: Tensor, v: Tensor) -> _Pixels:
        """Pixels with their inverse."""
        moved_u, moved_v, *determinant = _sampled(self.flow, self._grid(x, y, u, v)).split(1, dim=1)
        return _Pixels(x, y, u, v, moved_u.add_(u), moved_v.add_(v), *determinant)

    def newton(self, pixels: _Pixels) -> _Newton:
        """With the slopes at p + inverse."""
        grid = self._grid(*pixels[:4])
        return _newton(_jacobian(_sampled(self.along, grid), _sampled(self.across, grid)))

    def _grid(self, x: Tensor, y: Tensor, u: Tensor, v: Tensor) -> Tensor:
        """(B, n, m, 2), in the sampler's coordinates."""
        height, width = self.flow.shape[2:]
        there = torch.add(x, u, alpha=2 / width), torch.add(y, v, alpha=2 / height)
        return torch.cat(there, dim=1).movedim(1, -1)


def _solved(flow: Tensor, steps: int) -> tuple[Tensor, Tensor, Tensor | None]:
    """The inverse (B, 2, H, W) after some steps and its error (B, 1, H, W), px, and where the sheet is upright.

    That is (B, 1, H, W), bool, or None for everywhere.
    """
    if eager_values(lambda: flow[0, 0, 0, 0]) is None:
        return _ended(_masked(flow, steps))
    if flow.shape[2] * flow.shape[3] >= SMALLEST and obstacle(flow) is None:
        return solved(flow, steps, at_once=_AT_ONCE, near=_NEAR[flow.dtype], farthest=_FARTHEST, upright=_UPRIGHT)
    # What becomes of a sample depends on no other.
    ends = [_ended(_alone(one, steps)) for one in flow.split(1)]
    if len(ends) == 1:
        return ends[0]
    inverse, error, upright = zip(*ends, strict=True)
    everywhere = torch.ones_like(error[0], dtype=torch.bool)
    flags = [everywhere if flag is None else flag for flag in upright]
    return torch.cat(inverse), torch.cat(error), None if upright.count(None) == len(upright) else torch.cat(flags)


def _ended(pixels: _Pixels) -> tuple[Tensor, Tensor, Tensor | None]:
    upright = None if pixels.determinant is None else pixels.determinant > 0
    return torch.cat([pixels.u, pixels.v], dim=1), pixels.squared_error.sqrt(), upright


def _masked(flow: Tensor, steps: int) -> _Pixels:
    """All pixels after all steps, those that need none masked: where no value can be read."""
    pixels, fields, _ = _begun(flow)
    for _ in range(steps):
        left = pixels.left()
        u, v = pixels.stepped(fields.newton(pixels))
        pixels = fields.at(*pixels[:2], torch.where(left, u, pixels.u), torch.where(left, v, pixels.v))
    return pixels


def _alone(flow: Tensor, steps: int) -> _Pixels:
    """The pixels of one sample after the steps that they need."""
    pixels, fields, newton = _begun(flow)
    left = pixels.left()
    count, at_once = int(left.count_nonzero()), min(steps, _AT_ONCE)
    while at_once > 0 and count > _MANY * left.numel():
        pixels = fields.at(*pixels[:2], *pixels.stepped(newton))
        left = pixels.left()
        count, at_once, steps = int(left.count_nonzero()), at_once - 1, steps - 1
    if steps == 0 or count == 0:
        return pixels
    index, ends = _filled(left), [plane.contiguous() for plane in pixels.known]
    x, y = (plane.expand_as(left) for plane in pixels[:2])
    some = _Pixels(x, y, *ends).picked(index)
    while steps > 0 and len(index):
        some, steps = fields.at(some.x, some.y, *some.stepped(fields.newton(some))), steps - 1
        for end, plane in zip(ends, some.known, strict=True):
            end.view(-1).index_copy_(0, index, plane.flatten())
        places = _filled(some.left())
        index, some = index[places], some.picked(places)
    return _Pixels(*pixels[:2], *ends)


def _begun(flow: Tensor) -> tuple[_Pixels, _Fields, _Newton]:
    """The pixels after the first step, which has nothing to read, and what the next ones take."""
    fields = _Fields(flow, _slopes(flow, 3), _slopes(flow, 2))
    sheet = _jacobian(fields.along, fields.across)
    determinant = sheet.determinant
    # Where it is at every pixel, what is read between them is above zero, too.
    if not eager_bool(lambda: determinant.amin() >= _UPRIGHT, of=determinant):
        fields = fields._replace(flow=torch.cat([flow, determinant], dim=1))
        upright = determinant >= _UPRIGHT
        flat = Jacobian(*(torch.where(upright, own, still) for own, still in zip(sheet, (1, 0, 0, 1), strict=True)))
        sheet, determinant = flat, torch.where(upright, determinant, 1)
    newton, size = _over(sheet, determinant), {"height": flow.shape[2], "width": flow.shape[3]}
    x, y = sampler_axes(*pixel_axes(**size, dtype=flow.dtype, device=flow.device), **size)
    none = flow.new_zeros(())
    return fields.at(x, y, *newton.step(none, none, *flow.split(1, dim=1))), fields, newton


def _filled(flags: Tensor) -> Tensor:
    """(N,): the numbers of those that are true, the last one again until they fill their rows."""
    index = flags.flatten().nonzero()[:, 0]
    return torch.cat([index, index[-1:].expand(-len(index) % _ROW)])


def _slopes(flow: Tensor, dim: int) -> Tensor:
    """(B, 2, H, W): the slopes of u and v along a dimension, by central differences, one-sided at the border."""
    count = flow.shape[dim]
    if count == 1:
        return torch.zeros_like(flow)
    if eager_values(lambda: flow[0, 0, 0, 0]) is None:
        return torch.gradient(flow, dim=dim)[0]
    # The same, without the copies on its way.
    slopes, inner = torch.empty_like(flow), count - 2
    torch.sub(flow.narrow(dim, 2, inner), flow.narrow(dim, 0, inner), out=slopes.narrow(dim, 1, inner)).mul_(0.5)
    for border, low in ((0, 0), (count - 1, inner)):
        torch.sub(flow.narrow(dim, low + 1, 1), flow.narrow(dim, low, 1), out=slopes.narrow(dim, border, 1))
    return slopes


def _cell_slopes(flow: Tensor, at: Tensor) -> tuple[Tensor, Tensor]:
    """Twice (B, 2, H, W): the slopes, along x and y, of the bilinear reading itself at p + at(p), each of a cell."""
    axes = pixel_axes(flow.shape[2], flow.shape[3], dtype=flow.dtype, device=flow.device)
    slopes = []
    for channel, axis in enumerate(axes):
        shift = (axis + at[:, channel : channel + 1]).floor() - axis
        low = torch.cat([shift, at[:, 1:]] if channel == 0 else [at[:, :1], shift], dim=1)
        high = low + torch.eye(2, dtype=flow.dtype, device=flow.device)[channel].view(1, 2, 1, 1)
        slopes.append(_read(flow, high) - _read(flow, low))
    return slopes[0], slopes[1]


def _sampled(field: Tensor, grid: Tensor) -> Tensor:
    return sampled(field, grid, padding="border", interpolation="bilinear")


def _read(field: Tensor, at: Tensor) -> Tensor:
    """A field (B, C, H, W) at p + at(p)."""
    return sample_image(field, at, padding="border", interpolation="bilinear")


def _jacobian(along: Tensor, across: Tensor) -> Jacobian:
    """I + the slopes (B, 2, n, m) of u and v along x, and along y."""
    (u_x, v_x), (u_y, v_y) = along.split(1, dim=1), across.split(1, dim=1)
    return Jacobian(1 + u_x, u_y, v_x, 1 + v_y)


def _newton(jacobian: Jacobian) -> _Newton:
    """Also for that of a fold, near which a step has no good length; the residual tells the rest."""
    determinant = jacobian.determinant
    return _over(jacobian, determinant.abs().clamp(min=0.1).copysign(determinant))


def _over(jacobian: Jacobian, determinant: Tensor) -> _Newton:
    """With a determinant that is known."""
    scale = 1 / determinant
    return _Newton(jacobian.yy * scale, jacobian.xy * scale, jacobian.yx * scale, jacobian.xx * scale)
