"""Operations on flows: compose, resize, and measure where they fold."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from torchrefract._tensor import as_device_tensor, exact_matmul
from torchrefract._validation import check_count, check_flow, check_tensor, eager_values
from torchrefract.types import Folding
from torchrefract.warping.grid import field_dtype, length, pixel_axes
from torchrefract.warping.warp import sample_image

_LARGEST_STRETCH = 4.0  # of an inverse flow that counts as unique
_GHOSTS = 2  # nodes beyond each border that a cubic may need


class Jacobian(NamedTuple):
    """Hold the derivatives of a map of the plane; xy is the derivative of the new x with respect to y."""

    xx: Tensor
    xy: Tensor
    yx: Tensor
    yy: Tensor

    @property
    def determinant(self) -> Tensor:
        """Return xx yy - xy yx."""
        return torch.addcmul(self.xx * self.yy, self.xy, self.yx, value=-1)

    def solve(self, a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
        """Return J^-1 (a, b), with the determinant clamped to at least 1e-6."""
        determinant = self.determinant.clamp(min=1e-6)
        x = torch.addcmul(self.yy * a, self.xy, b, value=-1)
        y = torch.addcmul(self.xx * b, self.yx, a, value=-1)
        return x / determinant, y / determinant

    def after(self, first: "Jacobian") -> "Jacobian":
        """Return the product J first: the derivatives of this map applied after the first one."""
        return Jacobian(
            self.xx * first.xx + self.xy * first.yx,
            self.xx * first.xy + self.xy * first.yy,
            self.yx * first.xx + self.yy * first.yx,
            self.yx * first.xy + self.yy * first.yy,
        )


def compose_flows(first: Tensor, then: Tensor) -> Tensor:
    """Compose the flows of two warps into one flow, so that a single warp does the work of both.

        flow(p) = then(p) + first(p + then(p)),  warp(image, flow) = warp(warp(image, first), then)

    `first` is sampled bilinearly, and outside of the frame at its border.

    Args:
        first: (B, 2, H, W), px, the flow of the warp that is applied first.
        then: (B, 2, H, W), px, the flow of the warp that is applied to its result.

    Returns:
        (B, 2, H, W), px, float32, or float64 if one of them is.

    Raises:
        ValueError: shapes that differ or are not (B, 2, H, W).
    """
    check_flow("first", first)
    check_flow("then", then)
    if first.shape != then.shape:
        raise ValueError(f"then must have the shape of first, {tuple(first.shape)}, got {tuple(then.shape)}")
    dtype = field_dtype(torch.promote_types(first.dtype, then.dtype))
    first, then = first.to(dtype), then.to(dtype)
    return then + sample_image(first, then, padding="border", interpolation="bilinear")


def resize_image(image: Tensor, size: Sequence[int]) -> Tensor:
    """Resize an image of a frame.

    Along an axis that becomes shorter, each pixel is the mean of the pixels that it covers, weighted by the share
    covered. Along an axis that becomes longer, Keys' cubics with a = -1/2 interpolate, clamped to the range of the
    image's values.

    Args:
        image: (B, C, H, W), floating.
        size: (H', W'), px.

    Returns:
        (B, C, H', W').

    Raises:
        ValueError: an image of integers or of another shape, or a size below 1.
    """
    if check_tensor("image", image).ndim != 4 or not image.is_floating_point():
        raise ValueError(f"image must be (B, C, H, W) of floats, got {tuple(image.shape)} of {image.dtype}")
    new = [check_count("size", side) for side in size]
    vertical, horizontal = (
        _mean_weights(old, side, like=image) if side <= old else _keys_weights(old, side, like=image)
        for old, side in zip(image.shape[2:], new, strict=True)
    )
    resized = exact_matmul(vertical, exact_matmul(image, horizontal.mT))
    return resized.clamp(image.amin(dim=(2, 3), keepdim=True), image.amax(dim=(2, 3), keepdim=True))


def resize_flow(flow: Tensor, size: Sequence[int]) -> Tensor:
    """Resize the flow of a frame.

        out(x', y') = (u W'/W, v H'/H)(x, y),  x = (x' + 1/2) W/W' - 1/2,  y likewise with H

    Keys' cubics with a = -1/2 interpolate between pixels, and lines extrapolate beyond the borders, so functions that
    are linear in x and y are exact.

    Args:
        flow: (B, 2, H, W), px, u and v.
        size: (H', W'), px.

    Returns:
        (B, 2, H', W'), px of the new size.

    Raises:
        ValueError: a flow of another shape, or a size below 1.

    Source: Keys, "Cubic convolution interpolation for digital image processing", IEEE TASSP 29 (1981).
    """
    check_flow("flow", flow)
    height, width = (check_count("size", side) for side in size)
    H, W = flow.shape[2:]
    vertical, horizontal = (_keys_weights(old, new, like=flow) for old, new in ((H, height), (W, width)))
    scale = as_device_tensor([width / W, height / H], dtype=flow.dtype, device=flow.device).view(1, 2, 1, 1)
    return exact_matmul(vertical, exact_matmul(flow, horizontal.mT)) * scale


def jacobian_determinant(flow: Tensor) -> Tensor:
    """Compute the smallest area ratio of the map p -> p + flow(p) around each pixel; the map folds where it is <= 0.

        det = min over the four corners of (1 + D_x u)(1 + D_y v) - D_y u D_x v,

    D_x and D_y being the forward or the backward difference. A cell of the bilinear map keeps its orientation exactly
    if the determinant is positive at its four corners, so no fold between two pixels is missed.

    Args:
        flow: (B, 2, H, W), px.

    Returns:
        (B, 1, H, W), area sampled for each px^2 of the result.

    Raises:
        ValueError: a flow of another shape.

    Source: Choi and Lee, "Injectivity conditions of 2D and 3D uniform cubic B-spline functions", Graphical Models 62
    (2000), for the use of corner determinants.
    """
    check_flow("flow", flow)
    return torch.stack([jacobian.determinant for jacobian in _corner_jacobians(flow)], dim=1).amin(dim=1)


def folded(flow: Tensor, valid: Tensor | None = None) -> Tensor:
    """Return True for pixels that lie on a fold, (B, 1, H, W); arguments as for `folding`."""
    return _valid_determinant(flow, valid) <= 0


def is_shown_once(flow: Tensor, inverse: Tensor, exists: Tensor, valid: Tensor | None = None) -> Tensor:
    """Return True for the pixels of the input image that are neither shown several times nor nearly so.

    The map p -> p + flow(p) with the Jacobian J shows a position several times if the inverse does not lead from there
    back to each pixel that is sent there. Positions next to a fold, where it sends pixels with ||J^-1|| above 4
    (Frobenius norm) or det J <= 0, are excluded too. Elsewhere an error e of the flow moves the inverse by 4 e at most.

    Args:
        flow: (B, 2, H, W), px.
        inverse: (B, 2, H, W), px, a flow that undoes it.
        exists: (B, 1, H, W), bool, where the inverse is defined.
        valid: (B, 1, H, W), bool, where the flow is defined; None for everywhere.

    Returns:
        (B, 1, H, W), bool.
    """
    with torch.no_grad():
        flow = flow.detach()
        # The inverse at p + flow(p), from those of the four pixels around it where it exists.
        masked = torch.cat([torch.where(exists, inverse.detach(), 0), exists.to(flow.dtype)], dim=1)
        back, share = sample_image(masked, flow, padding="zeros", interpolation="bilinear").split((2, 1), dim=1)
        is_excluded = (share > 1e-3) & (length(flow + back / share.clamp(min=1e-3)) > _LARGEST_STRETCH)
        for jacobian in _corner_jacobians(flow):
            norm = torch.hypot(torch.hypot(jacobian.xx, jacobian.xy), torch.hypot(jacobian.yx, jacobian.yy))
            # ||J^-1|| is ||J|| / det J in two dimensions. NaN counts as steep.
            is_excluded = is_excluded | ~(norm <= _LARGEST_STRETCH * jacobian.determinant)
        if valid is not None:
            is_excluded = is_excluded & ~_near_invalid(valid)
        if eager_values(is_excluded.any, of=flow) is False:
            return ~is_excluded
        return ~_cover(flow, is_excluded)


def _cover(flow: Tensor, chosen: Tensor) -> Tensor:
    """Return True for the positions in the boxes around where a map sends chosen pixels and their neighbors."""
    height, width = flow.shape[2:]
    x, y = pixel_axes(height, width, dtype=flow.dtype, device=flow.device)
    positions = flow + torch.cat(torch.broadcast_tensors(x, y), dim=1)
    size = as_device_tensor([width, height], dtype=flow.dtype, device=flow.device).view(1, 2, 1, 1)
    low, high = (
        end.nan_to_num(0.0).clamp(min=0).minimum(size).long()
        for end in (
            (-F.max_pool2d(-positions, 3, stride=1, padding=1)).floor(),
            F.max_pool2d(positions, 3, stride=1, padding=1).ceil() + 1,
        )
    )
    # The number of boxes at a position is the sum of their corners, with signs, above and to the left of it.
    corners = torch.zeros(len(flow), (height + 1) * (width + 1), dtype=torch.int32, device=flow.device)
    for rows, columns, sign in ((low, low, 1), (high, high, 1), (low, high, -1), (high, low, -1)):
        index = rows[:, 1] * (width + 1) + columns[:, 0]
        corners = corners.scatter_add(1, index.flatten(1), sign * chosen.flatten(1).int())
    counts = corners.view(-1, 1, height + 1, width + 1).cumsum(2).cumsum(3)
    return counts[..., :height, :width] > 0


def folding(flow: Tensor, valid: Tensor | None = None) -> Folding:
    """Measure the share of folded pixels and the smallest determinant of each sample.

    Args:
        flow: (B, 2, H, W), px.
        valid: (B, 1, H, W), bool, where the flow is defined; a pixel counts if it and its neighbors are valid. None
            for everywhere.

    Returns:
        fraction: (B,), of all pixels.
        min_determinant: (B,), of `jacobian_determinant`; inf if no pixel counts.

    Raises:
        ValueError: a flow of another shape; a mask that is not bool or not of that shape.
    """
    check_flow("flow", flow)
    shape = (len(flow), 1, *flow.shape[2:])
    if valid is not None and (check_tensor("valid", valid).dtype is not torch.bool or valid.shape != shape):
        raise ValueError(f"valid must be bool of shape {shape}, as the flow, got {valid.dtype} of {tuple(valid.shape)}")
    determinant = _valid_determinant(flow, valid).flatten(1)
    return Folding((determinant <= 0).to(determinant.dtype).mean(dim=1), determinant.amin(dim=1))


def _valid_determinant(flow: Tensor, valid: Tensor | None) -> Tensor:
    determinant = jacobian_determinant(flow)
    if valid is None:
        return determinant
    return torch.where(_near_invalid(valid), torch.inf, determinant)


def _near_invalid(valid: Tensor) -> Tensor:
    """Return True for pixels that are not valid and for their neighbors."""
    return F.max_pool2d((~valid).float(), kernel_size=3, stride=1, padding=1) > 0


def _corner_jacobians(flow: Tensor) -> Iterator[Jacobian]:
    """Yield the Jacobians of p -> p + flow(p), entries (B, 1, H, W), by forward and backward differences."""
    for forward_x in (False, True):
        u_x, v_x = _difference(flow, -1, forward_x).split(1, dim=1)
        for forward_y in (False, True):
            u_y, v_y = _difference(flow, -2, forward_y).split(1, dim=1)
            yield Jacobian(1 + u_x, u_y, v_x, 1 + v_y)


def _difference(flow: Tensor, dim: int, forward: bool) -> Tensor:
    if flow.shape[dim] == 1:
        return torch.zeros_like(flow)
    ends = (0, 1) if forward else (1, 0)
    return F.pad(flow.diff(dim=dim), (*ends, 0, 0) if dim == -1 else (0, 0, *ends), mode="replicate")


def _mean_weights(old: int, new: int, *, like: Tensor) -> Tensor:
    """Return the share of each of `new` pixels along an axis that each of `old` pixels covers, (new, old)."""
    edges = torch.arange(new + 1, dtype=torch.float64, device=like.device)[:, None] * (old / new)
    reach = (edges - torch.arange(old, dtype=torch.float64, device=like.device)).clamp(0, 1)
    return ((reach[1:] - reach[:-1]) * (new / old)).to(like.dtype)


def _keys_weights(old: int, new: int, *, like: Tensor) -> Tensor:
    """Return the weight of each of `old` pixels in each of `new` ones along an axis, (new, old)."""
    positions = (torch.arange(new, dtype=torch.float64, device=like.device) + 0.5) * (old / new) - 0.5
    nodes = torch.arange(-_GHOSTS, old + _GHOSTS, dtype=torch.float64, device=like.device)
    weights = keys_cubic(positions[:, None] - nodes)
    result = weights[:, _GHOSTS:-_GHOSTS].clone()
    for k in range(1, _GHOSTS + 1):
        # The ghost k px beyond the border pixel f_0 is f_0 + k (f_0 - f_1), so it lies on the line through both.
        slope = k if old > 1 else 0
        for ghost, edge, inner in ((_GHOSTS - k, 0, min(1, old - 1)), (-_GHOSTS - 1 + k, old - 1, max(0, old - 2))):
            result[:, edge] += (1 + slope) * weights[:, ghost]
            result[:, inner] -= slope * weights[:, ghost]
    return result.to(like.dtype)


def keys_cubic(t: Tensor) -> Tensor:
    """Evaluate Keys' cubic with a = -1/2 at distances t from a node, in strides."""
    t = t.abs()
    near, far = (1.5 * t - 2.5) * t * t + 1, ((-0.5 * t + 2.5) * t - 4) * t + 2
    return torch.where(t < 1, near, torch.where(t < 2, far, 0))
