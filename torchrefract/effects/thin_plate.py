"""A warp that bends the frame like a thin plate."""

import math
from typing import NamedTuple, cast

import torch
from torch import Tensor

from torchrefract import random
from torchrefract._validation import check_count, check_range, check_values
from torchrefract.effects.base import params_to
from torchrefract.effects.lattice_warp import LatticeWarp
from torchrefract.effects.plan import FEW_ULPS, TOLERANCE_PX, Plan, PlanRequest, in_ranges
from torchrefract.effects.plate_plan import plate_plan
from torchrefract.fields.drawn_plates import drawn_plates
from torchrefract.fields.spline import check_points, fit_spline, spline_at, spline_flow
from torchrefract.types import Range
from torchrefract.warping.lattice import Lattice, LatticeFlow

_CLOSE = 1e-3  # px


class ThinPlateParams(NamedTuple):
    """The plates of a batch."""

    applied: Tensor  # (B,), bool: the sample is degraded
    points: Tensor  # (B, N, 2), px, control points, x and y
    displacement: Tensor  # (B, N, 2), px, of each point
    smoothing: Tensor  # (B,), 0 or above

    to = params_to


class ThinPlateSpline(LatticeWarp):
    """A frame bent by a thin-plate spline: the smoothest flow that moves given points as told.

        flow(p) = a1 + a2 x + a3 y + sum w_i U(|p - p_i|),  U(r) = r^2 ln r,  sum w = sum w x = sum w y = 0

    Drawn plates have a lattice of control points over the frame, corner to corner, each displaced by a normal number
    times the amplitude in x and in y. Own points go through `apply` with a `ThinPlateParams`.

    Args:
        amplitude_range: px, standard deviation of the displacements, 0 or above.
        lattice: (rows, columns) of control points, each at least 2.
        smoothing_range: 0 goes through the points exactly; larger bends less, in units of the points' rms radius.
        padding, interpolation, backend, tolerance_px, p: as for every warp; plates with own points are exact,
            on accelerators and in compiled graphs those with as many as drawn ones only without a tolerance.

    Raises:
        ValueError: an argument outside its range; points that are fewer than three, the same, or on one line.

    Source: Bookstein, "Principal warps", IEEE TPAMI 11 (1989).
    """

    def __init__(
        self,
        *,
        amplitude_range: Range = (2.0, 8.0),
        lattice: tuple[int, int] = (4, 4),
        smoothing_range: Range = (0.0, 0.0),
        padding: str = "reflection",
        interpolation: str = "bilinear",
        backend: str = "auto",
        tolerance_px: float | None = TOLERANCE_PX,
        p: float = 1.0,
    ):
        super().__init__(padding=padding, interpolation=interpolation, backend=backend, tolerance_px=tolerance_px, p=p)
        self.amplitude_range = check_range("amplitude_range", amplitude_range, low=0.0, high=1e4)
        rows, columns = lattice
        self.lattice = (check_count("lattice", rows, low=2), check_count("lattice", columns, low=2))
        self.smoothing_range = check_range("smoothing_range", smoothing_range, low=0.0, high=1e12)

    params_type = ThinPlateParams
    ulps = FEW_ULPS

    def at_rest(self) -> bool:
        """Whether no plate has an amplitude."""
        return self.amplitude_range[1] == 0

    def draw(self, source: random.Stream, image: Tensor) -> ThinPlateParams:
        """One plate a sample, amplitude and smoothing uniform in their ranges."""
        applied, values = self._uniform(source, (self.amplitude_range, self.smoothing_range), image)
        amplitude, smoothing = values.unbind(1)
        rows, columns = self.lattice
        normal = random.normal(random.fold(source), 2 * rows * columns).to(values.dtype).view(-1, rows * columns, 2)
        points = self._points(image.shape[2], image.shape[3], values).repeat(image.shape[0], 1, 1)
        return ThinPlateParams(applied, points, amplitude[:, None, None] * normal, smoothing)

    def check(self, params: ThinPlateParams, image: Tensor) -> None:
        """Raise for plates that are none."""
        points, displacement, smoothing = params[1:]
        if points.ndim != 3 or points.shape[2] != 2:
            raise ValueError(f"params.points must have shape (B, N, 2), got {tuple(points.shape)}")
        if displacement.shape != points.shape:
            raise ValueError(
                f"params.displacement must have the shape of points, {tuple(points.shape)}, "
                f"got {tuple(displacement.shape)}"
            )
        if smoothing.ndim != 1:
            raise ValueError(f"params.smoothing must have shape (B,), got {tuple(smoothing.shape)}")
        check_points(points)
        check_values("params.displacement", "be finite", displacement, torch.isfinite)
        check_values("params.smoothing", "be at least 0 and finite", smoothing, lambda v: v.isfinite() & (v >= 0))

    def flow(self, params: ThinPlateParams, *, height: int, width: int) -> tuple[Tensor, Tensor]:
        """The flow of `spline_flow`, and where it exists: everywhere."""
        spline = fit_spline(params.points, params.displacement, params.smoothing)
        flow = spline_flow(spline, height=height, width=width, dtype=params.points.dtype)
        return flow, torch.ones_like(flow[:, :1], dtype=torch.bool)

    def plan_within(self, ask: PlanRequest) -> Plan:
        """The plan of `plate_plan`."""
        return plate_plan(self.amplitude_range[1], self.lattice, self.smoothing_range, ask)

    def for_params(self, params: ThinPlateParams, height: int, width: int) -> "LatticeWarp":
        """As for every warp; that there are more or fewer points than drawn ones is known where none can be read."""
        drawn = params.points.shape[1] == math.prod(self.lattice)
        return super().for_params(params, height, width) if drawn else self.exact()

    def params_in_range(self, params: ThinPlateParams, height: int, width: int) -> Tensor:
        """Whether the points are drawn ones of such a frame, displaced and smoothed as those can be."""
        # Positions in whatever type they were kept in: so little changes nothing that a plan relies on.
        near = (params.points - self._points(height, width, params.points)).abs() <= _CLOSE
        most = random.LARGEST_NORMAL * self.amplitude_range[1]
        displaced = in_ranges(params.displacement.reshape(-1, 1), [(-most, most)])
        return near.all() & displaced & in_ranges(params.smoothing[:, None], [self.smoothing_range])

    def on_lattice(self, params: ThinPlateParams, plan: Plan) -> LatticeFlow:
        """The flow of `drawn_plates`, or of `spline_at`."""
        lattice, dtype = cast(Lattice, plan.lattice), params.points.dtype
        # Those that such a plan is for are drawn ones.
        numbers = params.points, params.displacement, params.smoothing
        x, y = lattice.places(dtype=torch.float64, device=params.points.device)
        # Of plates that are smoothed each by itself nothing is there to be kept.
        alike = self.smoothing_range[0] == self.smoothing_range[1]
        if (flow := drawn_plates(*numbers, x, y) if alike else None) is None:
            flow = spline_at(fit_spline(*numbers, checked=True), x, y, dtype=dtype)
        return LatticeFlow(flow, lattice)

    def moves(self, params: ThinPlateParams) -> Tensor:
        """The samples with a displaced point."""
        return (params.displacement != 0).flatten(1).any(dim=1)

    def _points(self, height: int, width: int, like: Tensor) -> Tensor:
        """(1, N, 2), px: the control points of drawn plates."""
        rows, columns = self.lattice
        # A frame of one pixel has no extent, and a plate needs one.
        y = torch.linspace(0, max(height - 1, 1), rows, dtype=like.dtype, device=like.device)
        x = torch.linspace(0, max(width - 1, 1), columns, dtype=like.dtype, device=like.device)
        return torch.stack([x.expand(rows, -1), y[:, None].expand(-1, columns)], dim=-1).view(1, -1, 2)
