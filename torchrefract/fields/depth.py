"""Depth in meters: of a flat road, along rays, converted from other units, and checked."""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from torchrefract._tensor import to_float
from torchrefract._validation import check_number, check_positive, check_tensor, check_values, eager_values
from torchrefract.warping.grid import field_dtype, pixel_axes

_FARTHEST = 1e12  # m; beyond it a depth is infinite and has no gradient
_MAX_HOLES = 0.5  # share of values of 0
_FARTHEST_MEDIAN = 1000.0  # m, of a map of whole numbers, or of the lower half of any map
_FEWEST = 256  # values of a sample that tell stored integers and holes
_NUM_CHECKED = 128 * 128  # values of a sample by which `check_depth` judges it
_MIN_UPPER_HALF = 128  # values of its upper half; fewer are not judged


class DepthProvider(ABC):
    """The depth of a frame of any size if no depth map is passed in; derive your own provider from it."""

    @abstractmethod
    def __call__(self, height: int, width: int, *, dtype: torch.dtype, device: torch.device) -> Tensor:
        """Return the depth along the axis of the camera in m, inf for the sky.

        Args:
            height, width: px, of the frame.
            dtype, device: of the result.

        Returns:
            (1, 1, H, W), or (1, 1, H, 1) if all pixels of a row have one depth.
        """


@dataclass(frozen=True, kw_only=True)
class LinearDepth(DepthProvider):
    """The ramp over the rows of the paper: d(y) = (1 - (y + 1/2) / H) max_depth.

    max_depth: m, at the top edge of the frame, in [0, 1e12]; another number raises ValueError.
    """

    max_depth: float = 160.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "max_depth", check_number("max_depth", self.max_depth, low=0.0, high=_FARTHEST))

    def __call__(self, height: int, width: int, *, dtype: torch.dtype, device: torch.device) -> Tensor:
        """Return (1, 1, H, 1), m."""
        margin = self.max_depth / (2 * height)
        rows = torch.linspace(self.max_depth - margin, margin, height, dtype=dtype, device=device)
        return rows.view(1, 1, height, 1)


@dataclass(frozen=True, kw_only=True)
class GroundPlaneDepth(DepthProvider):
    """A flat road below the horizon: its depth along the axis of the camera, not along the ray of each pixel.

        z(y) = min(h sqrt(f^2 + (c_y - y_h)^2) / b, far),  y_h = horizon H - 1/2,  c_y = (H - 1) / 2
        b = max(y - y_h, 0),  or with s = spread H > 0 its mean (y - y_h) Phi(u) + s phi(u),  u = (y - y_h) / s

    The camera is a pinhole that looks down by theta, tan(theta) = (c_y - y_h) / f, so sqrt(...) is f / cos(theta). A
    spread averages inverse depth over normally distributed horizons.

    Numbers out of range raise ValueError.

    camera_height: m, h, above the road, above 0.
    focal: f, focal length of the pinhole, widths of the frame, above 0.
    horizon: its position, 0 at the top edge of the frame and 1 at its bottom edge, in [-10, 10].
    spread: standard deviation of an uncertain horizon, in heights of the frame, in [0, 10]; depth then grows smoothly
        across the horizon instead of jumping there.
    far: m, the largest depth, which is that of the sky; may be inf.
    """

    camera_height: float = 1.3
    focal: float = 0.9
    horizon: float = 0.5
    spread: float = 0.0
    far: float = 200.0

    def __post_init__(self) -> None:
        for name in ("camera_height", "focal"):
            object.__setattr__(self, name, check_positive(name, getattr(self, name)))
        for name, low, high in (("horizon", -10.0, 10.0), ("spread", 0.0, 10.0), ("far", 1e-6, math.inf)):
            object.__setattr__(self, name, check_number(name, getattr(self, name), low=low, high=high))

    def __call__(self, height: int, width: int, *, dtype: torch.dtype, device: torch.device) -> Tensor:
        """Return (1, 1, H, 1), m."""
        y_h = self.horizon * height - 0.5
        # Close to the horizon float32 would lose the digits of the difference.
        below = torch.arange(height, dtype=torch.float64, device=device) - y_h
        distance = self.camera_height * math.hypot(self.focal * width, (height - 1) / 2 - y_h)
        z = distance / _mean_positive(below, self.spread * height)
        return z.clamp(max=self.far).to(dtype).view(1, 1, height, 1)


DepthSource = DepthProvider | Callable[[Tensor], Tensor]


def check_depth_provider(depth: DepthSource) -> DepthSource:
    """Return `depth` if it is a depth provider or a function.

    Raises:
        TypeError: otherwise.
    """
    if not callable(depth):
        raise TypeError(
            "depth must be a provider such as LinearDepth(), or a function from images (B, C, H, W) to their depth "
            f"(B, 1, H, W) in m, got {type(depth).__name__}"
        )
    return depth


def frame_depth(source: DepthSource, image: Tensor, depth: Tensor | None) -> Tensor:
    """Return the depth of frames: the map that was passed in, or that of the effect.

    Args:
        source: of the effect.
        image: (N, C, H, W), the frames.
        depth: (N or B, 1, H, W), m; None takes that of the source.

    Returns:
        (N, B or 1, 1, H, W or 1), m, of the type of a field.

    Raises:
        ValueError: a depth that is not in meters, see `check_depth`.
    """
    dtype = field_dtype(image.dtype)
    if depth is None:
        return depth_of(source, image, dtype)
    check_depth(depth)
    # On an accelerator nothing is read: invalid values become 0.
    return depth.to(dtype).nan_to_num(nan=0.0, posinf=torch.inf).clamp(min=0)


def depth_of(source: DepthSource, image: Tensor, dtype: torch.dtype) -> Tensor:
    """Return the depth of images (N, C, H, W) by a provider, or by a function of the images, in m.

    Raises:
        TypeError: the function returns no floating tensor.
        ValueError: it returns another shape than (N, 1, H, W), or a depth that `check_depth` refuses.
    """
    height, width = image.shape[2:]
    if isinstance(source, DepthProvider):
        return source(height, width, dtype=dtype, device=image.device)
    depth = check_floating("depth(image)", source(to_float(image) if image.dtype is torch.uint8 else image))
    if depth.shape != (image.shape[0], 1, height, width):
        raise ValueError(
            f"depth(image) must have shape {(image.shape[0], 1, height, width)}, (N, 1, H, W) for images (N, C, H, W), "
            f"got {tuple(depth.shape)}"
        )
    check_depth(depth, name="depth(image)")
    return depth.to(dtype).nan_to_num(nan=0.0, posinf=torch.inf).clamp(min=0)


def _mean_positive(value: Tensor, deviation: float) -> Tensor:
    """Compute the mean of max(X, 0) for a normal X with this mean and standard deviation."""
    if deviation == 0:
        return value.clamp(min=0)
    u = value / deviation
    density = torch.exp(-0.5 * u * u) / math.sqrt(2 * math.pi)
    # Far above the horizon rounding could make the sum negative.
    return (value * torch.special.ndtr(u) + deviation * density).clamp(min=0)


def ray_distance(
    depth: Tensor,
    *,
    fx: float | Tensor,
    fy: float | Tensor,
    cx: float | Tensor,
    cy: float | Tensor,
    width: int | None = None,
) -> Tensor:
    """Convert depth along the axis of the camera to the distance along the ray of each pixel.

        d = z sqrt((1 + ((v - cy) / fy)^2) + ((u - cx) / fx)^2),  inf where z is inf

    Args:
        depth: (B, 1, H, W), or (B, 1, H, 1) if all pixels of a row have one depth, m.
        fx, fy, cx, cy: px, focal lengths and principal point of a pinhole; a number, or (B,).
        width: px, of the frame; None is that of the depth.

    Returns:
        (B, 1, H, W), m, float32, or float64 for such a depth.

    Raises:
        ValueError: an invalid shape, a focal length that is not above 0, an intrinsic that is not finite.
        TypeError: depth is not a floating tensor.
    """
    if check_floating("depth", depth).ndim != 4 or depth.shape[1] != 1:
        raise ValueError(f"depth must have shape (B, 1, H, W) or (B, 1, H, 1), got {tuple(depth.shape)}")
    if width is not None and depth.shape[3] not in (1, width):
        raise ValueError(f"depth must be 1 or {width} px wide, as the frame, got {tuple(depth.shape)}")
    z = depth.to(field_dtype(depth.dtype))
    columns, rows = pixel_axes(z.shape[2], width or z.shape[3], dtype=z.dtype, device=z.device)
    x = (columns - _intrinsic("cx", cx, z)) / _focal("fx", fx, z)
    y = (rows - _intrinsic("cy", cy, z)) / _focal("fy", fy, z)
    stretch = ((1 + y * y) + x * x).sqrt()
    if not any(isinstance(value, Tensor) for value in (fx, fy, cx, cy)):
        return z * stretch
    # The gradient of an intrinsic would be inf times 0 at the sky.
    sky = z.isinf()
    return torch.where(sky, z, torch.where(sky, 0, z) * stretch)


def depth_from_disparity(disparity: Tensor, *, focal_px: float, baseline: float) -> Tensor:
    """Convert the disparity of a rectified stereo pair to depth.

        z = (f b) / disparity,  inf where the disparity is 0 or z would be above 1e12 m

    Args:
        disparity: px, at least 0, of any shape.
        focal_px: f, of the rectified pair, at the size of the disparity.
        baseline: m, b, between the two cameras.

    Returns:
        Depth in m, of the same shape, float32, or float64 for a float64 disparity.

    Raises:
        ValueError: a disparity that is negative or NaN (on the CPU); a focal length or baseline that is not above 0.
        TypeError: disparity is not a floating tensor.
    """
    product = check_positive("focal_px", focal_px) * check_positive("baseline", baseline)
    check_values("disparity", "be at least 0, in px", check_floating("disparity", disparity), lambda d: d >= 0)
    return _quotient(product, disparity.to(field_dtype(disparity.dtype)))


def depth_from_normalized(value: Tensor, *, near: float, far: float) -> Tensor:
    """Convert a map that is linear in depth, 0 at `near` and 1 at `far`.

        z = near + value (far - near)

    Args:
        value: in [0, 1], of any shape.
        near, far: m, 0 <= near < far, both finite.

    Returns:
        Depth in m, of the same shape, float32, or float64 for a float64 map.

    Raises:
        ValueError: a value outside [0, 1] or NaN (on the CPU); a near or far out of range.
        TypeError: value is not a floating tensor.
    """
    near, far = check_number("near", near, low=0.0), check_number("far", far)
    return near + _unit(value, near, far) * (far - near)


def depth_from_inverse(value: Tensor, *, near: float, far: float) -> Tensor:
    """Convert a map that is linear in inverse depth, 1 at `near` and 0 at `far`.

        z = 1 / (value / near + (1 - value) / far),  inf where that would be above 1e12 m

    Monocular networks such as MiDaS predict such maps, up to a scale to [0, 1].

    Args, Returns, Raises: as for `depth_from_normalized`, but 0 < near < far, and far may be inf.

    Source: Ranftl et al., "Towards Robust Monocular Depth Estimation", IEEE TPAMI 44 (2022).
    """
    near, far = check_positive("near", near), check_number("far", far, low=0.0, high=math.inf)
    value = _unit(value, near, far)
    return _quotient(1.0, value / near + (1 - value) / far)


def check_depth(depth: Tensor, *, name: str = "depth") -> None:
    """Raise ValueError if a depth is not in meters, as far as reading it costs no wait for a device.

    Each sample or clip is judged alone. Invalid are negative values and NaN; maps that look normalized (all finite
    values lie in [0, 1] and differ); whole numbers with a median above 1000, as of millimeters, and any numbers with
    such a median in the lower half; maps of which more than half is 0, as of lidar, whose zeros are holes; and maps
    that look like disparity or inverse depth: a tenth of the upper half is inf or at most 2 % of the largest value, the
    median of the lowest quarter is at least 20 % of it and, with inf as readers of files give for 0, more than twice
    that of the upper half. Frames of a few pixels are tested for the first two alone.

    Args:
        depth: (B, 1, H, W) or (B, T, 1, H, W), m, inf for the sky.
        name: of the argument, for the message.
    """
    lowest = eager_values(lambda: depth.detach().amin(), of=depth) if depth.numel() else None
    if lowest is None:
        return
    if not lowest >= 0:  # also for NaN
        check_values(name, "be at least 0, in m", depth, lambda v: v >= 0)
    for sample in depth.detach():
        values = _subsample(sample)
        if _ends_in_unit_range(values) and (ends := _ends_in_unit_range(sample)):
            raise ValueError(
                f"{name} must be in m, not normalized (see depth_from_normalized and depth_from_inverse), "
                f"got values in [{ends[0]:g}, {ends[1]:g}]"
            )
        _check_not_raw(name, values)
        _check_not_inverse(name, values.double())


def _check_not_raw(name: str, values: Tensor) -> None:
    """Raise ValueError for stored integers, as millimeters, and for maps with holes, as lidar and stereo give."""
    share = (values == 0).float().mean().item()
    if values.numel() < _FEWEST:
        return
    if share > _MAX_HOLES:
        raise ValueError(
            f"{name} must be known at each pixel, got 0 at {100 * share:.0f} % of them; fill these holes, such as by a "
            "depth network"
        )
    measured = values[values.isfinite() & (values > 0)]
    if measured.numel() == 0 or measured.amin() == measured.amax():
        return
    if measured.median() > _FARTHEST_MEDIAN and bool((measured == measured.round()).all()):
        raise ValueError(
            f"{name} must be in m, got whole numbers from {measured.amin():g} to {measured.amax():g}; divide by 1000 "
            "if they are millimeters, by 256 if they are those of a PNG of KITTI"
        )
    # A sky may be finite and far, the lower half of a road is neither.
    lower = values[:, values.shape[1] // 2 :]
    lower = lower[lower.isfinite()]
    if lower.numel() and (median := lower.median().item()) > _FARTHEST_MEDIAN:
        raise ValueError(
            f"{name} must be in m, got a median of {median:.4g} in the lower half; divide by 1000 if it is in "
            "millimeters, by 256 if it holds the steps of a PNG of KITTI"
        )


def check_floating(name: str, value: Tensor) -> Tensor:
    """Return `value` if it is a floating tensor."""
    if not check_tensor(name, value).is_floating_point():
        raise TypeError(f"{name} must be of a floating type, got {value.dtype}")
    return value


def _focal(name: str, value: float | Tensor, like: Tensor) -> float | Tensor:
    if isinstance(value, Tensor):
        check_values(name, "be above 0, in px", value, lambda f: f > 0)
        return _intrinsic(name, value, like)
    return check_positive(name, value)


def _intrinsic(name: str, value: float | Tensor, like: Tensor) -> float | Tensor:
    """A number, or (B, 1, 1, 1) of the type of `like`."""
    if not isinstance(value, Tensor):
        return check_number(name, value)
    if value.ndim > 1 or (like.shape[0] != 1 and value.numel() not in (1, like.shape[0])):
        raise ValueError(f"{name} must be a number or have shape ({like.shape[0]},), got {tuple(value.shape)}")
    check_values(name, "be finite", value, torch.isfinite)
    return value.to(like.dtype).view(-1, 1, 1, 1)


def _quotient(numerator: float, denominator: Tensor) -> Tensor:
    """numerator / denominator, inf above 1e12, with a gradient that is finite everywhere."""
    near = denominator > numerator / _FARTHEST
    return torch.where(near, numerator / torch.where(near, denominator, 1), torch.inf)


def _unit(value: Tensor, near: float, far: float) -> Tensor:
    if not near < far:
        raise ValueError(f"far must be above near = {near:g}, got {far:g}")
    check_values("value", "be in [0, 1]", check_floating("value", value), lambda v: (v >= 0) & (v <= 1))
    return value.to(field_dtype(value.dtype))


def _subsample(sample: Tensor) -> Tensor:
    """(T, h, w): evenly spaced rows and columns, about _NUM_CHECKED values in all."""
    height, width = sample.shape[-2:]
    side = max(16, math.isqrt(_NUM_CHECKED // sample.shape[:-2].numel()))
    return sample[..., :: -(-height // side), :: -(-width // side)].flatten(0, -3).contiguous()


def _ends_in_unit_range(values: Tensor) -> tuple[float, float] | None:
    """The smallest and the largest finite value, if they lie in [0, 1] and differ."""
    low = values.amin().item()
    if low >= 1:
        return None
    high = torch.where(values.isinf(), low, values).amax().item()
    return (low, high) if low < high <= 1 else None


def _check_not_inverse(name: str, values: Tensor) -> None:
    is_far = values.isinf()
    values = torch.where(is_far, 0.0, values)
    top, bottom = values[:, : values.shape[1] // 2], values[:, -max(1, values.shape[1] // 4) :]
    largest = values.amax().item()
    if top.numel() < _MIN_UPPER_HALF:
        return
    share, median = (top <= 0.02 * largest).double().mean().item(), bottom.median().item()
    positive = top[top > 0]
    falls = not is_far.any() or (positive.numel() > 0 and positive.median().item() < 0.5 * median)
    if share >= 0.1 and 0 < 0.2 * largest <= median and falls:
        raise ValueError(
            f"{name} must be in m, not disparity or inverse depth, where 0 is far (see depth_from_disparity and "
            f"depth_from_inverse), got {share:.0%} of the upper half near 0 over a median of {median:g} at the bottom"
        )
