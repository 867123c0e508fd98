"""What an effect will do for a frame of some size, under a tolerance."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, cast

import torch
from torch import Tensor

from torchrefract._tensor import as_device_tensor
from torchrefract._validation import check_count, check_number
from torchrefract.types import Range
from torchrefract.warping.lattice import Lattice

# Of warps, px: nobody sees so little.
TOLERANCE_PX = 0.02
_SMALLEST, _LARGEST = 1e-6, 64.0  # px, or levels
# Units of the last place, of the longer side, that flows and positions along them are off by.
MOST_ULPS = 16  # of lenses, which Newton's method magnifies the rounding of
FEW_ULPS = 4  # of what is added to positions as it is
_LAST_PLACE = {False: 2.0**-24, True: 2.0**-53}
# Px between nodes, from fine to coarse.
STRIDES = (*range(2, 8), *(share << octave for octave in range(1, 7) for share in (4, 5, 6, 7)), 512)


@dataclass(frozen=True)
class PlanRequest:
    """What a plan is asked for.

    height, width: px, of the frame.
    tolerance_px: as for `Plan`.
    double: of fields in float64, not float32.
    ulps: units of the last place, of the longer side, that the flow is off by besides.
    """

    height: int
    width: int
    tolerance_px: float | None
    double: bool
    ulps: int = MOST_ULPS

    def plan(self, stride: int, error_px: float, why: str, **more: Any) -> "Plan":
        """A plan with what was asked for."""
        return Plan(self.height, self.width, self.tolerance_px, stride, error_px, why, **more)

    @property
    def rounding(self) -> float:
        """Of the flow in such a frame, px."""
        return self.ulps * _LAST_PLACE[self.double] * max(self.height, self.width)

    @property
    def reachable(self) -> bool:
        """Whether rounding leaves enough of the tolerance."""
        return self.tolerance_px is None or self.tolerance_px >= 2 * self.rounding

    @property
    def of_default(self) -> "PlanRequest":
        """The same; without a tolerance where the default one is below rounding, which nobody has asked for."""
        default = self.tolerance_px == TOLERANCE_PX and not self.reachable
        return replace(self, tolerance_px=None) if default else self

    def room(self) -> float:
        """What the tolerance leaves beside rounding, px.

        Raises:
            ValueError: a tolerance that leaves too little.
        """
        if not self.reachable:
            kind = "float64" if self.double else "float32"
            raise ValueError(
                f"tolerance_px must be at least {2 * self.rounding:.2g} px for {kind} positions in a frame of "
                f"{self.height} x {self.width} px (None is exact), got {self.tolerance_px:g}"
            )
        return cast(float, self.tolerance_px) - self.rounding


@dataclass(frozen=True)
class Smoothness:
    """How smooth flows are.

    bend: px per px^2, their largest second derivative along any line, as they bend over a px and more.
    third: px per px^3, likewise; inf where the second has kinks.
    lines: px, how far lines between pixels are off.
    cubics: px, how far cubics through four nodes along each of two axes are off, whatever the axes and wherever the
        nodes lie, for so many px between these.
    """

    bend: float
    third: float
    lines: float
    cubics: Callable[[float], float]


@dataclass(frozen=True)
class Plan:
    """How an effect computes its flow for frames of one size.

    height, width: px, of the frame.
    tolerance_px: how far the flow may be from the exact one anywhere; None is exact.
    stride: px between the nodes at which the flow is computed; 1 is every pixel; 0 is no flow at all.
    error_px: how far the flow is from the exact one at most.
    steps: of Newton's method, where there is one.
    kept: the terms that are computed.
    dropped: those that are not, each with how far it could have moved a pixel, px.
    resamples: how often the image is looked up.
    random: whether the error is that of a chance, independent of those of other effects.
    slope: how much the flow differs from pixel to pixel, px, at most; inf where that is not known.
    parts: whether what is drawn may have a coarser plan of its own, where it can be read which; then `error_px` is the
        tolerance, which all of them keep.
    smooth: None where that is not known.
    every: px, between nodes that a composition which this is part of may be known at, on the CPU; 1 is every pixel.
    before, after: nodes that the lattice has before the frame and behind its last cell.
    lattice: where the flow is computed; None for every pixel, or for none.
    why: what decided.
    """

    height: int
    width: int
    tolerance_px: float | None
    stride: int
    error_px: float
    why: str
    steps: int | None = None
    kept: tuple[str, ...] = ()
    dropped: tuple[tuple[str, float], ...] = ()
    resamples: int = 1
    random: bool = False
    slope: float = math.inf
    parts: bool = False
    smooth: Smoothness | None = None
    every: int = 1
    before: int = 1
    after: int = 1
    lattice: Lattice | None = field(init=False)

    def __post_init__(self) -> None:
        place = (self.height, self.width, self.stride, self.before, self.after)
        object.__setattr__(self, "lattice", Lattice(*place) if self.stride > 1 else None)

    @property
    def acts(self) -> bool:
        """Whether anything is computed."""
        return self.stride > 0

    def summary(self) -> str:
        """Where the flow is computed, and why there."""
        flow = {0: "not computed", 1: "at every pixel"}.get(self.stride, f"every {self.stride} px")
        own = "; on the CPU coarser where what is drawn allows it" if self.parts else ""
        return f"{flow} ({self.why}{own})"

    def __str__(self) -> str:
        lines = [
            f"frame          {self.height} x {self.width} px",
            f"tolerance      {'none: exact' if self.tolerance_px is None else f'{self.tolerance_px:g} px'}",
            f"flow           {self.summary()}",
            f"error at most  {self.error_px:.2g} px",
            f"resamples      {self.resamples}",
        ]
        if self.steps is not None:
            lines.append(f"Newton steps   {self.steps}")
        if self.kept:
            lines.append(f"terms kept     {', '.join(self.kept)}")
        lines += [f"term dropped   {name}, which moves up to {moved:.2g} px" for name, moved in self.dropped]
        return "\n".join(lines)


def check_tolerance(value: float | None, *, name: str = "tolerance_px") -> float | None:
    """A tolerance in px, or in levels of light, or None."""
    return None if value is None else check_number(name, value, low=_SMALLEST, high=_LARGEST)


def check_sides(height: int, width: int) -> None:
    """Raise for frames without a pixel."""
    check_count("height", height)
    check_count("width", width)


def coarsest(attempt: Callable[[int], Plan | None]) -> Plan | None:
    """The plan with the largest stride for which there is one; what is too coarse stays so at larger strides."""
    found, low, high = None, 0, len(STRIDES)
    while low < high:
        middle = (low + high) // 2
        plan = attempt(STRIDES[middle])
        found, low, high = (plan, middle + 1, high) if plan else (found, low, middle)
    return found


def in_ranges(values: Tensor, ranges: Sequence[Range]) -> Tensor:
    """(), bool: all values (B, n) lie in the n ranges, but for rounding."""
    return lies_in_one(values, [ranges])


def lies_in_one(values: Tensor, boxes: Sequence[Sequence[Range]]) -> Tensor:
    """(), bool: each row of values (B, n) lies in one of the boxes of n ranges, but for rounding."""
    low, high = as_device_tensor(boxes, dtype=values.dtype, device=values.device).unbind(2)
    room = 1e-5 * torch.maximum(low.abs(), high.abs())
    inside = (values[:, None] >= low - room) & (values[:, None] <= high + room)
    return inside.all(dim=2).any(dim=1).all()
