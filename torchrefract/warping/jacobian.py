"""How a flow stretches the image, and where it folds it."""

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from torchrefract._validation import check_flow
from torchrefract.types import Folding


class Jacobian(NamedTuple):
    """Derivatives of a map of the plane: xy is that of the new x with respect to y."""

    xx: Tensor
    xy: Tensor
    yx: Tensor
    yy: Tensor

    @property
    def determinant(self) -> Tensor:
        """Of the 2x2 matrix."""
        return torch.addcmul(self.xx * self.yy, self.xy, self.yx, value=-1)

    def solve(self, a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
        """J^-1 (a, b), with the determinant held above zero."""
        scale = 1 / self.determinant.clamp(min=1e-6)
        x = torch.addcmul(self.yy * a, self.xy, b, value=-1)
        y = torch.addcmul(self.xx * b, self.yx, a, value=-1)
        return x * scale, y * scale

    def after(self, first: "Jacobian") -> "Jacobian":
        """The product J first: the derivatives of one map after another."""
        return Jacobian(
            self.xx * first.xx + self.xy * first.yx,
            self.xx * first.xy + self.xy * first.yy,
            self.yx * first.xx + self.yy * first.yx,
            self.yx * first.xy + self.yy * first.yy,
        )


def jacobian_determinant(flow: Tensor) -> Tensor:
    """The smallest area ratio of the map p -> p + flow(p) around each pixel; the map folds where it is <= 0.

        det = min over the four corners of (1 + D_x u)(1 + D_y v) - D_y u D_x v,

    D_x and D_y being the forward or the backward difference. A cell of the bilinear map keeps its orientation exactly
    when the determinant is positive at its four corners, so no fold between two pixels is missed.

    Args:
        flow: (B, 2, H, W), px.

    Returns:
        (B, 1, H, W), the ratio of the areas looked up and drawn.

    Source: Choi and Lee, "Injectivity conditions of 2D and 3D uniform cubic B-spline functions", Graphical Models 62
    (2000), for the use of corner determinants.
    """
    check_flow("flow", flow)
    determinants = []
    for forward_x in (False, True):
        u_x, v_x = _difference(flow, -1, forward_x).unbind(1)
        for forward_y in (False, True):
            u_y, v_y = _difference(flow, -2, forward_y).unbind(1)
            determinants.append((1 + u_x) * (1 + v_y) - u_y * v_x)
    return torch.stack(determinants, dim=1).amin(dim=1, keepdim=True)


def folded(flow: Tensor, valid: Tensor | None = None) -> Tensor:
    """(B, 1, H, W), bool: the pixels that lie on a fold; arguments as for `folding`."""
    return _known_determinant(flow, valid) <= 0


def folding(flow: Tensor, valid: Tensor | None = None) -> Folding:
    """The share of folded pixels and the smallest determinant of each sample.

    Args:
        flow: (B, 2, H, W), px.
        valid: (B, 1, H, W), bool, where the flow means something; a pixel counts if it and its neighbors are valid.
            None for everywhere.

    Returns:
        fraction: (B,), of all pixels.
        min_determinant: (B,), that of `jacobian_determinant`; inf where no pixel counts.
    """
    determinant = _known_determinant(flow, valid).flatten(1)
    return Folding((determinant <= 0).to(determinant.dtype).mean(dim=1), determinant.amin(dim=1))


def _known_determinant(flow: Tensor, valid: Tensor | None) -> Tensor:
    determinant = jacobian_determinant(flow)
    if valid is None:
        return determinant
    lost = F.max_pool2d((~valid).to(flow.dtype), kernel_size=3, stride=1, padding=1) > 0
    return torch.where(lost, torch.inf, determinant)


def _difference(flow: Tensor, dim: int, forward: bool) -> Tensor:
    if flow.shape[dim] == 1:
        return torch.zeros_like(flow)
    ends = (0, 1) if forward else (1, 0)
    return F.pad(flow.diff(dim=dim), (*ends, 0, 0) if dim == -1 else (0, 0, *ends), mode="replicate")
