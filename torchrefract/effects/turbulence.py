"""Turbulent air in front of the camera."""

from dataclasses import dataclass
from typing import Any, NamedTuple

from torch import Tensor

from torchrefract import random
from torchrefract._tensor import expand_batch
from torchrefract._validation import check_choice, check_positive, eager_values, warn
from torchrefract.cameras.camera import Camera
from torchrefract.effects.batch import ParamsAtDepth, params_to
from torchrefract.effects.batch_flow import everywhere
from torchrefract.effects.physical_turbulence import PhysicalTurbulence, focal_px
from torchrefract.effects.random_field import (
    check_decorrelation,
    check_field_params,
    check_field_range,
    check_wind,
    drawn_motion,
    field_params,
    motion_ranges,
    warn_if_clipped,
)
from torchrefract.effects.warp_effect import WarpEffect
from torchrefract.fields.depth import DepthSource, check_depth_provider
from torchrefract.fields.physical_turbulence import Air, tilt_variance
from torchrefract.fields.random_field import COVARIANCES, Frequencies, embedding_size, gradient_rms
from torchrefract.fields.turbulence import share_at_depth, turbulence_flow
from torchrefract.fields.turbulence_error import RandomFieldErrorModel
from torchrefract.planning.plan import (
    TOLERANCE_PX,
    ErrorModel,
    PlanRequest,
    WarpPlan,
    plan_warp,
)
from torchrefract.types import FlowBounds, Range, Simplification
from torchrefract.warping.grid import Points
from torchrefract.warping.implicit import sample_at
from torchrefract.warping.lattice import LatticeFlow, lattice_around, lattice_with_stride, pixel_lattice

# A field folds the image first where a gradient of five standard deviations reaches 1.
_FOLDING_GRADIENT = 0.2


class TurbulenceParams(NamedTuple):
    """The turbulence of a batch."""

    applied: Tensor  # (B,), bool: the sample is degraded
    amplitude: Tensor  # (B,), px, standard deviation of each component of the flow
    length: Tensor  # (B,), px, correlation length
    aperture: Tensor  # (B,), px, standard deviation of the Gaussian that smooths the field
    wind: Tensor  # (B, 2), px per frame, motion of the field to the right and down
    decorrelation: Tensor  # (B,), frames, above 0; inf for a field that only moves
    frame: Tensor  # (B, T), number of each frame in its clip
    key: Tensor  # (B, 4), int64, of the white noise

    to = params_to

    @property
    def is_identity(self) -> Tensor:
        """Return (B,), bool: the amplitude is zero."""
        return self.amplitude == 0


class Turbulence(WarpEffect):
    """A frame seen through turbulent air: a Gaussian random field of displacements (the paper's "Perlin distortion").

        flow = amplitude R_t,  t and s frames of a clip,  C smoothed by the aperture,  Var R = 1,
        Cov(R_t(p), R_s(q)) = C(|p - q - wind (t - s)| / length) exp(-((t - s) / decorrelation)^2)

    The two components are independent. A field with the exponential covariance is not differentiable: it folds the
    image from an amplitude of 0.14 sqrt(length) px on, unless an aperture smooths it, as the pupil of a real lens does.
    `restore_flow` comes from Newton's method; folded pixels are not valid in it.

    With a `depth` d, the flow is that of air all along the ray of each pixel, sqrt(min(d, D) / D) times as long, where
    D is the `reference_distance`: near things are still, and the horizon shimmers.

    Args:
        amplitude_range: px, standard deviation of each component, 0 or above.
        length_range: px, correlation length, above 0.
        aperture_range: px, 0 or above.
        wind_x_range, wind_y_range: px per frame, motion of the field over a clip, to the right and down.
        decorrelation_range: frames, above 0, inf for a field that only moves; its inverse is drawn uniformly.
        covariance: "exponential", "gaussian", "matern32" or "matern52".
        normalize: "theory" gives the amplitude to the fields of all draws together, "image" to each field: its mean
            over the frame is subtracted, and it is divided by its standard deviation there, which enlarges fields that
            are longer than the frame.
        depth: of frames without a depth map, a provider such as `GroundPlaneDepth`, or a function from images to their
            depth; None moves all pixels alike, whatever their depth.
        reference_distance: m, D, from which on the displacement has the whole amplitude.
        padding, interpolation, backend, tolerance_px, p: as for every warp. Under a tolerance the lowest frequencies
            are computed on a lattice; covariances other than the Gaussian one have few enough of them from an aperture
            of 1.8 px on, and are exact otherwise.

    Raises:
        ValueError: an argument outside its range.

    Warns:
        UserWarning: an amplitude from which on the field folds the image (on the CPU); a length that does not fit into
            the largest periodic domain.

    Source: the torchrefract paper; Dietrich and Newsam, SIAM J. Sci. Comput. 18 (1997), for the sampling; Taylor, "The
    spectrum of turbulence", Proc. Royal Society A 164 (1938), for air that the wind carries.
    """

    params_type = TurbulenceParams
    bounds_hold_at_any_depth = True

    def __init__(
        self,
        *,
        amplitude_range: Range = (0.5, 1.5),
        length_range: Range = (20.0, 60.0),
        aperture_range: Range = (2.0, 3.0),
        wind_x_range: Range = (-1.0, 1.0),
        wind_y_range: Range = (-1.0, 0.0),
        decorrelation_range: Range = (6.0, 15.0),
        covariance: str = "exponential",
        normalize: str = "theory",
        depth: DepthSource | None = None,
        reference_distance: float = 200.0,
        padding: str = "reflection",
        interpolation: str = "bilinear",
        backend: str = "auto",
        tolerance_px: float | None = TOLERANCE_PX,
        p: float = 1.0,
    ):
        super().__init__(padding=padding, interpolation=interpolation, backend=backend, tolerance_px=tolerance_px, p=p)
        self.amplitude_range = check_field_range("amplitude", amplitude_range)
        self.length_range = check_field_range("length", length_range)
        self.aperture_range = check_field_range("aperture", aperture_range)
        self.wind_x_range = check_wind("wind_x_range", wind_x_range)
        self.wind_y_range = check_wind("wind_y_range", wind_y_range)
        self.decorrelation_range = check_decorrelation(decorrelation_range)
        self.covariance = check_choice("covariance", covariance, COVARIANCES)
        self.normalize = check_choice("normalize", normalize, ("theory", "image"))
        self.depth = None if depth is None else check_depth_provider(depth)
        self.reference_distance = check_positive("reference_distance", reference_distance)

    def sample_params(self, stream: random.Stream, image: Tensor) -> TurbulenceParams:
        """Draw one field for each sample, every number uniform in its range."""
        motion = motion_ranges(self.wind_x_range, self.wind_y_range, decorrelation=self.decorrelation_range)
        ranges = (self.amplitude_range, self.length_range, self.aperture_range, *motion)
        applied, values = self.draw_in_ranges(stream, ranges, image)
        sizes, motion = values[:, :3].unbind(1), drawn_motion(values[:, 3:])
        return TurbulenceParams(applied, *sizes, **motion, key=random.noise_key(stream))

    def validate(self, params: TurbulenceParams, image: Tensor) -> None:
        """Raise ValueError for invalid parameters."""
        check_field_params(params)

    def flow(self, params: Any, points: Points, plan: WarpPlan) -> tuple[Tensor, Tensor]:
        """Compute the flow of each frame; it exists everywhere."""
        exists = everywhere(params.applied.device)
        if not isinstance(params, ParamsAtDepth):
            return self._field(params, points, plan, plan.details), exists
        share = share_at_depth(params.depth.to(params.params.amplitude.dtype), self.reference_distance)
        return self._smooth_field(params.params, points, plan) * sample_at(share, points), exists

    def error_model(self) -> ErrorModel | None:
        """Return the error bounds of the ranges; None if fields are normalized by the image."""
        if self.normalize != "theory":
            return None
        model = RandomFieldErrorModel(self.amplitude_range, self.length_range, self.aperture_range, self.covariance)
        return model if self.depth is None else _AtDepthErrorModel(model)

    @staticmethod
    def from_physics(
        cn2: float | Range,
        *,
        camera: Camera | None = None,
        aperture: float = 0.002,
        inner_scale: float = 0.005,
        outer_scale: float = 10.0,
        height: float | None = 1.3,
        horizon: float = 0.5,
        wind: float = 3.0,
        depth: DepthSource | None = None,
    ) -> PhysicalTurbulence:
        """Create the turbulence of air that is stated by its physics, in layers along the ray of each pixel.

        Args:
            cn2: m^(-2/3), at the height of the camera, one number or a range.
            camera, aperture, inner_scale, outer_scale, height, horizon, depth: as for `PhysicalTurbulence`.
            wind: m/s, the largest one across the line of sight, from the left or the right.

        Raises: as for `PhysicalTurbulence`.
        """
        ends = (cn2, cn2) if isinstance(cn2, int | float) else cn2
        return PhysicalTurbulence(
            cn2_range=ends,
            camera=camera,
            aperture=aperture,
            inner_scale=inner_scale,
            outer_scale=outer_scale,
            height=height,
            horizon=horizon,
            wind_x_range=(-wind, wind),
            depth=depth,
        )

    def equivalent_cn2(
        self,
        camera: Camera | None = None,
        *,
        width: int | None = None,
        distance: float | None = None,
        aperture: float = 0.002,
        inner_scale: float = 0.005,
        outer_scale: float = 10.0,
    ) -> Range:
        """Return Cn2, m^(-2/3), at which air would move what is a distance away as far as `amplitude_range` says.

            Cn2 = (amplitude / f)^2 / (sigma^2 for Cn2 = 1)

        `PhysicalTurbulence.equivalent_amplitude` is the inverse. Over a road 1e-12 is a hot day: larger numbers say
        that the effect exaggerates, as for wide lenses it has to in order to be seen.

        Args:
            camera: of the frames; None has a focal length of 0.9 widths.
            width: px, of the frames; None is that of the camera.
            distance: m, of a level path; None is the `reference_distance`.
            aperture, inner_scale, outer_scale: m, as for `PhysicalTurbulence`.

        Raises:
            ValueError: neither a camera nor a width; a number outside its range.
        """
        if width is None:
            if camera is None:
                raise ValueError("width must be that of the frames, in px, if there is no camera, got None")
            width = camera.width
        distance = self.reference_distance if distance is None else check_positive("distance", distance)
        sizes = {"aperture": aperture, "inner_scale": inner_scale, "outer_scale": outer_scale}
        air = Air(**{name: check_positive(name, value) for name, value in sizes.items()})
        unit = focal_px(camera, width) ** 2 * tilt_variance(distance, air)
        low, high = self.amplitude_range
        return low * low / unit, high * high / unit

    def _field(
        self, params: TurbulenceParams, points: Points, plan: WarpPlan, frequencies: Frequencies | None
    ) -> Tensor:
        """Compute the flow of the whole amplitude at the nodes of a lattice, from some frequencies or from all."""
        self._warn_if_folded(params)
        if frequencies is None:
            longest, widest = self.length_range[1], self.aperture_range[1]
            size = embedding_size(plan.height, plan.width, length=longest, kind=self.covariance, aperture=widest)
            frequencies = Frequencies.all(size)
        fields = field_params(params)
        amplitude = expand_batch(params.amplitude, len(fields.length))

        kind = {"covariance": self.covariance, "normalize": self.normalize}
        flow, clipped = turbulence_flow(fields, amplitude, frequencies=frequencies, lattice=points.lattice, **kind)
        if frequencies.is_all:
            warn_if_clipped(clipped, params, frequencies.size)
        return flow

    def _smooth_field(self, params: TurbulenceParams, points: Points, plan: WarpPlan) -> Tensor:
        """Compute the flow of the whole amplitude at pixels, interpolated from the lattice that its own plan allows."""
        stride, frequencies = (1, None) if plan.details is None else plan.details
        if stride <= 1:
            return self._field(params, points, plan, frequencies)
        is_pixels = points.lattice == pixel_lattice(plan.height, plan.width)
        lattice = lattice_with_stride(plan.height, plan.width, stride) if is_pixels else lattice_around(points, stride)
        nodes = lattice.points(dtype=params.amplitude.dtype, device=params.amplitude.device)
        flow = LatticeFlow(self._field(params, nodes, plan, frequencies), lattice)
        return flow.dense() if is_pixels else flow.at(points)

    def _warn_if_folded(self, params: TurbulenceParams) -> None:
        def folds() -> Tensor:
            gradient = gradient_rms(params.length, kind=self.covariance, aperture=params.aperture)
            return (params.applied & (params.amplitude * gradient > _FOLDING_GRADIENT)).any()

        if eager_values(folds, of=params.applied):
            warn(
                "Turbulence this strong folds the image; folded pixels are excluded from restore_valid. Lower "
                "amplitude_range, or raise length_range or aperture_range."
            )


@dataclass(frozen=True)
class _AtDepthErrorModel:
    """Error bounds of a field whose share changes with depth from pixel to pixel.

    `details` are the stride of the lattice that the field is interpolated from, and its frequencies.
    """

    field: RandomFieldErrorModel

    is_random = True

    def bounds(self, height: int, width: int) -> FlowBounds:
        """Return the largest displacement; depth has edges, so the flow is not smooth."""
        return FlowBounds(self.field.bounds(height, width).max_displacement)

    def simplify(self, height: int, width: int, budget_px: float) -> Simplification:
        """Interpolate the field, and compute its share at every pixel."""
        # Rounding is part of the budget already.
        plan = plan_warp(self.field, PlanRequest(height, width, budget_px, is_double=True))
        why = f"its share changes with depth; the field {plan.summary()}"
        return Simplification(plan.error_px, details=(plan.stride, plan.details), can_interpolate=False, why=why)

    def contains(self, params: Any) -> Tensor:
        """Return (), bool: the field lies in the ranges."""
        return self.field.contains(params)
