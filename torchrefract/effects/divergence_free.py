"""A warp that swirls: its displacement has no divergence."""

from typing import Any, NamedTuple, cast

import torch
from torch import Tensor

from torchrefract import random
from torchrefract._validation import check_choice, check_count
from torchrefract.effects.base import params_to
from torchrefract.effects.field_plan import FieldPlan, field_plan
from torchrefract.effects.lattice_warp import LatticeWarp
from torchrefract.effects.motion import check_decorrelation, check_wind, drawn_motion, motion_ranges
from torchrefract.effects.plan import FEW_ULPS, TOLERANCE_PX, Plan, PlanRequest, in_ranges
from torchrefract.effects.random_field import check_field_params, check_field_range, field_of_modes, random_field
from torchrefract.effects.rows import column, expand_batch
from torchrefract.fields.covariance import COVARIANCES
from torchrefract.fields.field_bounds import FieldRanges
from torchrefract.fields.modes import Modes
from torchrefract.fields.stream import curl, curl_rms
from torchrefract.types import Range
from torchrefract.warping.compose import compose_flows
from torchrefract.warping.lattice import Lattice, LatticeFlow, StreamFlow


class DivergenceFreeParams(NamedTuple):
    """The swirls of a batch."""

    applied: Tensor  # (B,), bool: the sample is degraded
    amplitude: Tensor  # (B,), px, of the displacement as `normalize` has it
    length: Tensor  # (B,), px, correlation length of the stream function
    wind: Tensor  # (B, 2), px per frame, that psi drifts to the right and down
    decorrelation: Tensor  # (B,), frames, above 0; inf for a field that only drifts
    frame: Tensor  # (B, T), number of each frame in its clip
    key: Tensor  # (B, 4), int64, of the white noise

    to = params_to


class DivergenceFree(LatticeWarp):
    """A frame stirred by a displacement without divergence, the curl of a Gaussian random stream function.

        flow = amplitude (D_y psi, -D_x psi) / rms,
        Cov(psi_t(p), psi_s(q)) = C(|p - q - wind (t - s)| / length) exp(-((t - s) / decorrelation)^2), t, s frames

    D is the central difference, so the divergence taken with central differences is zero to round-off. The map itself
    keeps areas to first order only: det(I + grad flow) differs from 1 by the square of the slope. With `steps` the
    displacement is followed in so many equal parts, which keeps the map one-to-one and nearer to equal areas.

    Args:
        amplitude_range: px, 0 or above.
        length_range: px, correlation length of psi, above 0.
        wind_x_range, wind_y_range: px per frame, of the drift over a clip, to the right and down.
        decorrelation_range: frames, above 0, inf for swirls that only drift; one over it is drawn uniformly.
        covariance: of psi: "gaussian", "matern52", "matern32" or "exponential"; psi of the last has no slope, so that
            the flow is nearly white.
        normalize: "theory" divides by the standard deviation that each component has over all fields, "max" by the
            longest displacement in the frame, "none" by nothing: amplitude is then in px per unit of slope.
        steps: parts that the displacement is followed in.
        padding, interpolation, backend, tolerance_px, p: as for every warp; Gaussian fields followed in one step,
            normalized by theory, have a coarser lattice: psi's, so that the divergence stays zero.

    Raises:
        ValueError: an argument outside its range.

    Warns:
        UserWarning: a length that the largest torus has no room for (on the CPU).

    Source: the torchrefract paper; Bridson, Houriham, Nordenstam, "Curl-noise for procedural fluid flow", ACM
    Transactions on Graphics 26 (2007).
    """

    def __init__(
        self,
        *,
        amplitude_range: Range = (2.0, 6.0),
        length_range: Range = (40.0, 100.0),
        wind_x_range: Range = (-1.0, 1.0),
        wind_y_range: Range = (-1.0, 1.0),
        decorrelation_range: Range = (15.0, 45.0),
        covariance: str = "gaussian",
        normalize: str = "theory",
        steps: int = 1,
        padding: str = "reflection",
        interpolation: str = "bilinear",
        backend: str = "auto",
        tolerance_px: float | None = TOLERANCE_PX,
        p: float = 1.0,
    ):
        super().__init__(padding=padding, interpolation=interpolation, backend=backend, tolerance_px=tolerance_px, p=p)
        self.amplitude_range = check_field_range("amplitude", amplitude_range)
        self.length_range = check_field_range("length", length_range)
        self.wind_x_range = check_wind("wind_x_range", wind_x_range)
        self.wind_y_range = check_wind("wind_y_range", wind_y_range)
        self.decorrelation_range = check_decorrelation(decorrelation_range)
        self.covariance = check_choice("covariance", covariance, COVARIANCES)
        self.normalize = check_choice("normalize", normalize, ("theory", "max", "none"))
        self.steps = check_count("steps", steps)

    params_type = DivergenceFreeParams
    ulps = FEW_ULPS

    def at_rest(self) -> bool:
        """Whether no flow has an amplitude."""
        return self.amplitude_range[1] == 0

    def draw(self, source: random.Stream, image: Tensor) -> DivergenceFreeParams:
        """One stream function a sample, every number uniform in its range."""
        motion = motion_ranges(self.wind_x_range, self.wind_y_range, decorrelation=self.decorrelation_range)
        applied, values = self._uniform(source, (self.amplitude_range, self.length_range, *motion), image)
        swirls, motion = values[:, :2].unbind(1), drawn_motion(values[:, 2:])
        return DivergenceFreeParams(applied, *swirls, **motion, key=random.noise_key(source))

    def check(self, params: DivergenceFreeParams, image: Tensor) -> None:
        """Raise for swirls that are none."""
        check_field_params(params)

    def flow(self, params: DivergenceFreeParams, *, height: int, width: int) -> tuple[Tensor, Tensor]:
        """The flow, frame by frame, and where it exists: everywhere."""
        displacement = self.displacement(params, height=height, width=width)
        flow = part = displacement / self.steps
        for _ in range(self.steps - 1):
            flow = compose_flows(flow, part)
        return flow, torch.ones_like(flow[:, :1], dtype=torch.bool)

    def displacement(self, params: DivergenceFreeParams, *, height: int, width: int) -> Tensor:
        """(B T, 2, H, W), px: what is followed in `steps` parts; the curl itself."""
        longest = self.length_range[1]
        psi = random_field(params, kind=self.covariance, longest=longest, height=height + 2, width=width + 2)[:, :1]
        displacement = curl(psi)
        if self.normalize == "theory":
            displacement = displacement / column(expand_batch(curl_rms(params.length, self.covariance), psi.shape[0]))
        elif self.normalize == "max":
            longest = displacement.square().sum(dim=1, keepdim=True).amax(dim=(2, 3), keepdim=True)
            displacement = displacement / longest.clamp(min=1e-24).sqrt()
        return column(expand_batch(params.amplitude, displacement.shape[0])) * displacement

    def plan_within(self, ask: PlanRequest) -> Plan:
        """The plan of `field_plan` for Gaussian fields, normalized by theory, in one step; all others are exact."""
        if self.covariance != "gaussian" or self.normalize != "theory" or self.steps > 1:
            return super().plan_within(ask)
        ranges = FieldRanges(self.amplitude_range, self.length_range, (0.0, 0.0), stream=True)
        return field_plan(ranges, ask)

    def params_in_range(self, params: DivergenceFreeParams, height: int, width: int) -> Tensor:
        """Whether the swirls lie in the ranges."""
        values = torch.stack([params.amplitude, params.length], dim=1)
        return in_ranges(values, [self.amplitude_range, self.length_range])

    def on_lattice(self, params: DivergenceFreeParams, plan: Plan) -> LatticeFlow:
        """The curl of psi between nodes, of the frequencies that the plan keeps."""
        modes, lattice = cast(Modes, cast(FieldPlan, plan).modes), cast(Lattice, plan.lattice)
        # The psi of the exact flow has a row and a column of its own around the frame.
        rows, columns = ([place + 1 for place in axis] for axis in lattice.axes())
        drawn: Any = {"kind": self.covariance, "lengths": self.length_range, "nodes": None, "aperture": False}
        psi = field_of_modes(params, modes, (rows, columns), **drawn, fields=1)
        scale = params.amplitude / curl_rms(params.length, self.covariance)
        return StreamFlow(column(expand_batch(scale, psi.shape[0])) * psi, lattice)

    def moves(self, params: DivergenceFreeParams) -> Tensor:
        """The samples with an amplitude."""
        return params.amplitude != 0
