"""The blur of short exposures by turbulent air, alone and together with the tilt of the same air."""

import math
from typing import NamedTuple, cast

import torch
from torch import Tensor

from torchrefract import random
from torchrefract._tensor import assume_constant_result, expand_batch, in_ranges
from torchrefract._validation import check_number, check_range, check_within, eager_values, finite_or, requires_grad
from torchrefract.cameras.camera import UNKNOWN_FOCAL, Camera, check_camera, pinhole_of
from torchrefract.effects.batch import check_shapes, params_to
from torchrefract.effects.compose import Compose, ComposeParams
from torchrefract.effects.photometric_effect import PhotometricEffect, Rendered
from torchrefract.effects.physical_turbulence import PhysicalTurbulence, road_depth
from torchrefract.fields.depth import DepthSource, check_depth_provider, frame_depth
from torchrefract.fields.exposure import finite_image
from torchrefract.fields.physical_turbulence import GREEN, fried_parameter, height_gain, height_gains
from torchrefract.fields.srgb import linear_to_srgb, srgb_to_linear
from torchrefract.fields.turbulence_blur import (
    Distances,
    View,
    blur_by_distance,
    distances_for,
    halo_px,
    largest_change,
)
from torchrefract.planning.photometric import PhotometricPlan, PhotometricRequest, plan_turbulence_blur
from torchrefract.types import Range

TOLERANCE = 0.5  # levels
_STRONGEST = 1e-4  # Cn2
_LARGEST_RATIO = 1e15
_EXPONENT = 8 / 3  # a stretch of air at s counts for r0 as (1 - s/L)^(5/3)


class TurbulenceBlurParams(NamedTuple):
    """The blur of a batch."""

    applied: Tensor  # (B,), bool: the sample is degraded
    ratio: Tensor  # (B,), D / r0 of a level path as long as the reach, in [0, 1e15]

    to = params_to

    @property
    def is_identity(self) -> Tensor:
        """Return (B,), bool: the air is still."""
        return self.ratio == 0


class TurbulenceBlur(PhotometricEffect):
    """The blur of a short exposure through turbulent air, in linear light, with the depth of each pixel.

    The transfer function at the distance L, for rho cycles per radian and up to the cut-off D / lambda, is

        exp(-3.44 (lambda rho / r0)^(5/3) (1 - (lambda rho / D)^(1/3) / 2)),  r0 = (0.423 k^2 Cn2 v L 3/8)^(-3/5)

    Beyond the cut-off it keeps its value there. The blur is that of the air alone: frames bring the diffraction of the
    aperture with them. L is the depth, at most the reach. v is 1 without a height; with one, v is that of Cn2 that
    falls with the height above the road as for `PhysicalTurbulence`, so that the sky stays sharp. Frames are blurred at
    some distances and interpolated between these, which changes the contrast of no frequency by more than 2 %. Light
    that would leave the frame is reflected at its border.

    The air has no inner scale, which would blur less where it exceeds the aperture, and scintillation is left out. The
    exposure is so short that the air stands still, some milliseconds. Where it also moves what is seen, see
    `BlurredTurbulence` for both with one Cn2.

    `valid` are the finite pixels; others count as black. In still air, and where D / r0 below 1 hides the blur, every
    pixel keeps its value and is valid.

    Args:
        cn2_range: m^(-2/3), at the height of the camera; its root is drawn uniformly. 1e-14 is weak, 1e-12 a hot day.
        camera: of the frames, whose pinhole counts; None is a centered one with the focal length `focal`.
        focal: widths of the frame, of a camera that is None, in [1e-3, 1e4].
        aperture: m, D, diameter of the entrance pupil.
        wavelength: m, lambda, in [1e-7, 1e-4].
        height: m, of the camera above the ground; None for Cn2 that is the same everywhere.
        horizon: of the frame, 0 at its top edge and 1 at its bottom edge; it counts if there is a height.
        reach: m, of the air. Farther pixels look through as much air as those at the reach.
        depth: of frames without a depth map, a provider or a function from images to their depth; None is a flat road
            below the horizon, seen from the height, or from 1.3 m.
        tolerance: largest error of the image, levels of 1/255, below which the blur is not computed. It is not either
            where D / r0 is below 1 for the reach and all of `cn2_range`, as the diffraction of the aperture hides it;
            then the `error` of the plan is what the blur would change in a frame that is sharper than its aperture.
            None always computes it.
        p: probability that a sample is degraded.

    Raises:
        ValueError: an argument outside its range; a camera of another aspect ratio than the frames.

    Source: see `torchrefract.fields.turbulence_blur`.
    """

    params_type = TurbulenceBlurParams
    maps = ()

    def __init__(
        self,
        *,
        cn2_range: Range = (1e-13, 1e-12),
        camera: Camera | None = None,
        focal: float = UNKNOWN_FOCAL,
        aperture: float = 0.002,
        wavelength: float = GREEN,
        height: float | None = 1.3,
        horizon: float = 0.5,
        reach: float = 1000.0,
        depth: DepthSource | None = None,
        tolerance: float | None = TOLERANCE,
        p: float = 1.0,
    ):
        super().__init__(tolerance=tolerance, p=p)
        self.cn2_range = check_range("cn2_range", cn2_range, low=0.0, high=_STRONGEST)
        self.camera = check_camera(camera)
        self.focal = check_number("focal", focal, low=1e-3, high=1e4)
        self.aperture = check_number("aperture", aperture, low=1e-6, high=100.0)
        self.wavelength = check_number("wavelength", wavelength, low=1e-7, high=1e-4)
        self.height = None if height is None else check_number("height", height, low=1e-3, high=1e6)
        self.horizon = check_number("horizon", horizon, low=-10.0, high=10.0)
        self.reach = check_number("reach", reach, low=1e-2, high=1e6)
        if depth is None:
            depth = road_depth(self.camera, focal=self.focal, height=self.height, horizon=self.horizon)
        self.depth = check_depth_provider(depth)
        self._gains = height_gains(_EXPONENT)
        self._highest_ratio = self.blur_ratio

    @property
    def blur_ratio(self) -> float:
        """Return D / r0 at the reach in the strongest air of the range, on a level path."""
        return self.aperture / fried_parameter(self.cn2_range[1], self.reach, wavelength=self.wavelength)

    def ratio_of(self, root_cn2: Tensor) -> Tensor:
        """Return D / r0 at the reach, on a level path, for roots of Cn2, m^(-1/3)."""
        return self.aperture / fried_parameter(1.0, self.reach, wavelength=self.wavelength) * root_cn2 ** (6 / 5)

    def sample_params(self, stream: random.Stream, image: Tensor) -> TurbulenceBlurParams:
        """Draw the root of Cn2 uniformly in its range."""
        low, high = self.cn2_range
        applied, roots = self.draw_in_ranges(stream, [(math.sqrt(low), math.sqrt(high))], image)
        return TurbulenceBlurParams(applied, self.ratio_of(roots[:, 0]))

    def validate(self, params: TurbulenceBlurParams, image: Tensor) -> None:
        """Raise ValueError for invalid parameters."""
        check_shapes(params, {"ratio": ()})
        check_within("params.ratio", params.ratio, 0.0, _LARGEST_RATIO)

    def params_in_range(self, params: TurbulenceBlurParams) -> Tensor:
        """Return (), bool: the air is no stronger than that of the range."""
        return in_ranges(params.ratio[:, None], [(0.0, self._highest_ratio)])

    def may_change(self, params: TurbulenceBlurParams) -> bool:
        """Return False, too, where the plan drops the blur of the whole range, so that no depth is computed for it."""
        is_hidden = self.tolerance is not None and self._highest_ratio < 1 and not requires_grad(params)
        return not is_hidden and super().may_change(params)

    def for_params(self, params: TurbulenceBlurParams, height: int, width: int) -> "TurbulenceBlur":
        """Return this effect, or an exact one for stronger air if parameters lie outside the range."""
        if eager_values(lambda: self.params_in_range(params), of=params.applied) is not False:
            return self
        effect = cast(TurbulenceBlur, self.exact())
        effect._highest_ratio = 10.0 ** math.ceil(math.log10(params.ratio.max().item()))
        return effect

    def make_plan(self, request: PhotometricRequest, *, has_depth: bool) -> PhotometricPlan:
        """Plan frames for the strongest air of the range and any depth."""
        change = largest_change(self._largest_strength, self._view(request.height, request.width))
        return plan_turbulence_blur(change, self._highest_ratio, request)

    def render(self, image: Tensor, params: TurbulenceBlurParams, depth: Tensor | None) -> Rendered:
        """Blur images."""
        height, width = image.shape[2:]

        def is_valid() -> Tensor:
            return image.isfinite().all(dim=1, keepdim=True)

        if self.plan_for(image, params, depth).is_identity:
            return Rendered(image, is_valid)
        view, largest = self._view(height, width), self._largest_strength
        light = srgb_to_linear(finite_image(image.contiguous()).clamp(0, 1))
        ratio = finite_or(params.ratio.to(light.dtype), 0.0).clamp(0.0, 1.05 * _LARGEST_RATIO).view(-1, 1, 1, 1)
        ratio, share = (
            expand_batch(value, len(image)) for value in (ratio, self._share_of_reach(image, depth, view.focal[1]))
        )
        blurred = blur_by_distance(
            light,
            ratio ** (5 / 3) * share,
            view,
            distances=self._constant_distances(id(self), height, width),
            halo=halo_px(largest, view),
        )
        return Rendered(linear_to_srgb(blurred.clamp(0, 1)), is_valid)

    @property
    def _largest_strength(self) -> float:
        gain = 1.0 if self.height is None else max(self._gains)
        return self._highest_ratio ** (5 / 3) * gain**2

    # torch.compile takes the distances as a constant; see `WarpEffect`.
    @assume_constant_result
    def _constant_distances(self, _: int, height: int, width: int) -> Distances:
        return distances_for(self._largest_strength, self._view(height, width))

    def _view(self, height: int, width: int) -> View:
        focal, _ = pinhole_of(self.camera, height=height, width=width, focal=self.focal)
        return View(focal, self.aperture, self.wavelength)

    def _share_of_reach(self, image: Tensor, depth: Tensor | None, focal: float) -> Tensor:
        """Return the turbulence in front of each pixel, that of a level path as long as the reach being 1."""
        depth = frame_depth(cast(DepthSource, self.depth), image, depth).clamp(max=self.reach)
        share = depth / self.reach
        if self.height is None:
            return share
        rows = torch.arange(image.shape[2], dtype=depth.dtype, device=depth.device).view(-1, 1)
        below = (rows - (self.horizon * image.shape[2] - 0.5)) / focal
        return share * height_gain(1 - depth * below / self.height, self._gains).square()


class BlurredTurbulence(Compose):
    """Turbulent air that moves what is seen through it and then blurs it, with one Cn2 for both.

    Args:
        turbulence: gives the Cn2 and the place. The blur is a `TurbulenceBlur` with its arguments.
        wavelength: m, of the blur.
        tolerance: of the blur, levels.
        p: probability that a sample is degraded, if the turbulence is.

    Raises:
        TypeError: another effect.
        ValueError: an argument outside its range.

    Source: Chan, "Tilt-then-blur or blur-then-tilt? Clarifying the atmospheric turbulence model", IEEE Signal
    Processing Letters 29 (2022), for the order.
    """

    def __init__(
        self,
        turbulence: PhysicalTurbulence,
        *,
        wavelength: float = GREEN,
        tolerance: float | None = TOLERANCE,
        p: float = 1.0,
    ):
        if not isinstance(turbulence, PhysicalTurbulence):
            raise TypeError(f"turbulence must be a PhysicalTurbulence, got {type(turbulence).__name__}")
        names = ("cn2_range", "camera", "focal", "aperture", "height", "horizon", "reach", "depth", "p")
        options = {name: getattr(turbulence, name) for name in names}
        blur = TurbulenceBlur(**options, wavelength=wavelength, tolerance=tolerance)
        super().__init__([turbulence, blur], tolerance_px=turbulence.tolerance_px, p=p)

    @property
    def turbulence(self) -> PhysicalTurbulence:
        """Return the effect that moves pixels."""
        return cast(PhysicalTurbulence, self.effects[0])

    @property
    def blur(self) -> TurbulenceBlur:
        """Return the effect that blurs."""
        return cast(TurbulenceBlur, self.effects[1])

    @property
    def wavelength(self) -> float:
        """Return the wavelength of the blur, m."""
        return self.blur.wavelength

    @property
    def tolerance(self) -> float | None:
        """Return the tolerance of the blur, levels."""
        return self.blur.tolerance

    def sample_params(self, stream: random.Stream, image: Tensor) -> ComposeParams:
        """Draw the turbulence as it is drawn alone; the blur is that of its Cn2."""
        applied, _ = self.sample_applied(random.fold(stream))
        turbulence = self.turbulence.sample_params(stream, image)
        turbulence = turbulence._replace(applied=turbulence.applied & applied)
        blur = TurbulenceBlurParams(turbulence.applied, self.blur.ratio_of(self.turbulence.root_cn2(turbulence)))
        return ComposeParams(applied, (turbulence, blur))
