"""Smooth bending of the frame by a thin-plate spline."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torchrefract import random
from torchrefract._validation import check_count, check_range, check_values, eager_values
from torchrefract.effects.batch import params_to
from torchrefract.effects.batch_flow import everywhere
from torchrefract.effects.warp_effect import WarpEffect
from torchrefract.fields.thin_plate import check_points, fit_spline, spline_flow
from torchrefract.fields.thin_plate_error import ThinPlateErrorModel
from torchrefract.planning.plan import TOLERANCE_PX, WarpPlan
from torchrefract.types import Range
from torchrefract.warping.grid import Points

_CLOSE = 1e-3  # px, between points that were saved in a smaller type and drawn ones


class ThinPlateParams(NamedTuple):
    """The splines of a batch."""

    applied: Tensor  # (B,), bool: the sample is degraded
    points: Tensor  # (B, P, 2), px, control points, x and y
    displacement: Tensor  # (B, P, 2), px, of each point
    smoothing: Tensor  # (B,), 0 or above

    to = params_to

    @property
    def is_identity(self) -> Tensor:
        """Return (B,), bool: no point is displaced."""
        return (self.displacement == 0).flatten(1).all(dim=1)


class ThinPlateSpline(WarpEffect):
    """A frame bent by a thin-plate spline: the smoothest flow with given displacements at control points.

        flow(p) = a1 + a2 x + a3 y + sum w_i U(|p - p_i|),  U(r) = r^2 ln r,  sum w = sum w x = sum w y = 0

    Drawn splines have a lattice of control points over the frame, from corner to corner, each displaced by a normal
    number times the amplitude in x and in y. Other points go through `apply` with a `ThinPlateParams`.

    Args:
        amplitude_range: px, standard deviation of the displacements, 0 or above.
        lattice: (rows, columns) of control points, each at least 2.
        smoothing_range: 0 interpolates the displacements exactly; larger values bend less, in units of the points' rms
            radius.
        padding, interpolation, backend, tolerance_px, p: as for every warp. Splines through other points than drawn
            ones are exact; on accelerators and in compiled graphs, where points cannot be read, only if their number
            differs, or without a tolerance.

    Raises:
        ValueError: an argument outside its range; points that are fewer than three, equal, or collinear.

    Source: Bookstein, "Principal warps", IEEE TPAMI 11 (1989).
    """

    params_type = ThinPlateParams
    has_closed_form = True

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
        if not isinstance(lattice, Sequence) or len(lattice) != 2:
            raise ValueError(f"lattice must be (rows, columns), got {lattice!r}")
        rows, columns = lattice
        self.lattice = (check_count("lattice", rows, low=2), check_count("lattice", columns, low=2))
        self.smoothing_range = check_range("smoothing_range", smoothing_range, low=0.0, high=1e12)

    def sample_params(self, stream: random.Stream, image: Tensor) -> ThinPlateParams:
        """Draw one spline for each sample, amplitude and smoothing uniform in their ranges."""
        applied, values = self.draw_in_ranges(stream, (self.amplitude_range, self.smoothing_range), image)
        amplitude, smoothing = values.unbind(1)
        count = math.prod(self.lattice)
        normal = random.normal(random.fold(stream), 2 * count).to(values.dtype).view(-1, count, 2)
        points = self._points(image.shape[2], image.shape[3], values).repeat(image.shape[0], 1, 1)
        return ThinPlateParams(applied, points, amplitude[:, None, None] * normal, smoothing)

    def validate(self, params: ThinPlateParams, image: Tensor) -> None:
        """Raise ValueError for invalid parameters."""
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

    def flow(self, params: ThinPlateParams, points: Points, plan: WarpPlan) -> tuple[Tensor, Tensor]:
        """Evaluate the splines at the points; the flow exists everywhere."""
        spline = fit_spline(params.points, params.displacement, params.smoothing)
        flow = spline_flow(spline, points.x, points.y, dtype=params.points.dtype)
        return flow, everywhere(flow.device)

    def error_model(self) -> ThinPlateErrorModel:
        """Return the error bounds of the ranges, for the control points of drawn splines."""
        return ThinPlateErrorModel(self.amplitude_range[1], self.lattice, self.smoothing_range)

    def for_params(self, params: ThinPlateParams, height: int, width: int) -> WarpEffect:
        """Return this effect, or an exact one for control points that are not those of drawn splines."""
        if params.points.shape[1] != math.prod(self.lattice):
            return self.exact()

        def are_drawn() -> Tensor:
            return ((params.points - self._points(height, width, params.points)).abs() <= _CLOSE).all()

        if self.tolerance_px is not None and eager_values(are_drawn, of=params.points) is False:
            return self.exact()
        return super().for_params(params, height, width)

    def _points(self, height: int, width: int, like: Tensor) -> Tensor:
        """Return (1, P, 2), px: the control points of drawn splines."""
        rows, columns = self.lattice
        # A frame of one pixel has no extent, but a spline needs one.
        y = torch.linspace(0, max(height - 1, 1), rows, dtype=like.dtype, device=like.device)
        x = torch.linspace(0, max(width - 1, 1), columns, dtype=like.dtype, device=like.device)
        return torch.stack([x.expand(rows, -1), y[:, None].expand(-1, columns)], dim=-1).view(1, -1, 2)
