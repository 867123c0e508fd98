"""What every effect that moves pixels is: a flow, the flow back, and one look-up."""

from abc import abstractmethod
from typing import Any, cast

import torch
from torch import Tensor

from torchrefract._checks import check_choice, is_true
from torchrefract.effects.base import Effect, column
from torchrefract.types import Degraded
from torchrefract.warping.grid import field_dtype, inside
from torchrefract.warping.resample import INTERPOLATIONS, PADDINGS, look_up


class WarpEffect(Effect):
    """An effect that moves pixels.

    Args:
        padding: what lies outside the frame: "zeros", "border" or "reflection".
        interpolation: "nearest", "bilinear" or "bicubic".
        p: chance that a sample is degraded at all.
    """

    def __init__(self, *, padding: str = "zeros", interpolation: str = "bilinear", p: float = 1.0):
        super().__init__(p=p)
        self.padding = check_choice("padding", padding, PADDINGS)
        self.interpolation = check_choice("interpolation", interpolation, INTERPOLATIONS)

    @abstractmethod
    def flow(self, params: Any, *, height: int, width: int) -> tuple[Tensor, Tensor]:
        """The flow (B, 2, H, W) in px, and where it exists, (B, 1, H, W), bool."""

    @abstractmethod
    def restore_flow(self, params: Any, *, height: int, width: int) -> tuple[Tensor, Tensor]:
        """The flow that undoes `flow`, and where it exists."""

    @abstractmethod
    def moves(self, params: Any) -> Tensor:
        """(B,), bool: the samples whose parameters move anything at all."""

    def compute(self, image: Tensor, params: Any, depth: Tensor | None) -> Degraded:
        """The batch looked up along the flow."""
        size = {"height": image.shape[2], "width": image.shape[3]}
        active = params.gate & self.moves(params) & (size["height"] * size["width"] > 1)
        if is_true(active.any) is False and not _learns(params):
            return _identity(image, params)
        flow, exists = self.flow(params, **size)
        flow = _only(flow, 0.0, active, params)
        warped = look_up(image, flow, padding=self.padding, interpolation=self.interpolation)

        def valid() -> Tensor:
            return (exists & inside(flow)) | ~column(active)

        def restore() -> tuple[Tensor, Tensor]:
            back, known = self.restore_flow(params, **size)
            back = _only(back, 0.0, active, params)
            seen = look_up(result.valid.to(back.dtype), back, padding="zeros", interpolation="bilinear")
            # All pixels that the look-up mixes must be good, but for weights below a thousandth.
            return back, (known & inside(back) & (seen > 0.999)) | ~column(active)

        result = Degraded(_only(warped, image, active, params), params, valid=valid, flow=flow, restore=restore)
        return result


class _Swap(torch.autograd.Function):
    """The first tensor forward, the gradient of the second backward."""

    generate_vmap_rule = True

    @staticmethod
    def forward(value: Tensor, path: Tensor) -> Tensor:
        return value.view_as(value)

    @staticmethod
    def setup_context(ctx: Any, inputs: Any, output: Any) -> None:
        return None

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[None, Tensor]:  # pyright: ignore[reportIncompatibleMethodOverride]
        return None, gradient


def _only(changed: Tensor, same: Tensor | float, active: Tensor, params: Any) -> Tensor:
    """`changed` for the active samples and `same`, bit for bit, for the others.

    A sample at strength zero keeps the gradient of its parameters: descent must be able to start there.
    """
    if is_true(active.all):
        return changed
    value = torch.where(column(active), changed, same)
    if not _learns(params):
        return value
    return cast(Tensor, _Swap.apply(value.detach(), torch.where(column(params.gate), changed, same)))


def _learns(params: Any) -> bool:
    return torch.is_grad_enabled() and any(value.requires_grad for value in params)


def _identity(image: Tensor, params: Any) -> Degraded:
    size = (image.shape[0], 1, *image.shape[2:])
    everywhere = torch.ones(size, dtype=torch.bool, device=image.device)
    still = torch.zeros(size, dtype=field_dtype(image.dtype), device=image.device).expand(-1, 2, -1, -1)
    return Degraded(image, params, valid=lambda: everywhere, flow=still, restore=lambda: (still, everywhere))
