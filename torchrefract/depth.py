"""Depth in meters from networks of the transformers library, for images without a depth map (extra `depth`)."""

import inspect
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchrefract._tensor import to_float
from torchrefract._validation import check_choice, check_positive, check_rgb, is_whole
from torchrefract.fields.depth import DepthProvider, GroundPlaneDepth, check_depth
from torchrefract.fields.sky import sky_mask

# Types of models whose output is in meters, and those that have both kinds and say which.
_METRIC, _EITHER = ("depth_pro", "glpn", "zoedepth"), ("depth_anything",)
_MAX_SPREAD = 0.3
_SCALES = ("road", "model")
_FARTHEST_ROAD = 50.0  # m


class RoadScale(NamedTuple):
    """The scale of depth maps that puts the road at its distance.

    scale: (B,); NaN where no road pixel is known.
    spread: (B,), median absolute deviation of the single ratios over their median.
    """

    scale: Tensor
    spread: Tensor


def road_scale(depth: Tensor, road: DepthProvider) -> RoadScale:
    """Compare depth maps with a flat road, below the horizon in the middle third of the columns.

        scale = median(z_road / z)

    Args:
        depth: (B, 1, H, W), above 0, in any unit; inf and 0 are left out.
        road: depth of the flat road, which tells the height of the camera, its focal length and the horizon. Rows where
            it is farther than 50 m are left out, as a small error of the horizon counts too much there.
    """
    height, width = depth.shape[2:]
    rows = road(height, width, dtype=depth.dtype, device=depth.device).expand(1, 1, height, width)
    middle = slice(width // 3, max(width // 3 + 1, width - width // 3))
    ratio = (rows / depth)[..., middle]
    is_road = (rows[..., middle] < _FARTHEST_ROAD) & (depth[..., middle] > 0) & depth[..., middle].isfinite()
    values = torch.where(is_road, ratio, torch.nan).flatten(1)
    scale = values.nanmedian(dim=1).values
    deviation = (values - scale[:, None]).abs().nanmedian(dim=1).values
    return RoadScale(scale, deviation / scale)


class RoadSpreadError(ValueError):
    """Raised if the single ratios of a scale from the road differ too much to trust it."""


class ScaledDepth(NamedTuple):
    """The depth of one image."""

    depth: Tensor  # (1, H, W), m, inf in the sky
    scale: float | None  # that the output of the network was multiplied by; None with the meters of the model
    spread: float | None  # see `RoadScale`


class TransformersDepth:
    """A network of the transformers library as a function from images (B, 3, H, W), in [0, 1] or uint8, to depth in m.

    Pass it as `depth=` to a fog, or to `degrade`. The network runs without gradients. See `from_transformers`.
    """

    def __init__(self, model: Any, processor: Any, *, scale: str, road: DepthProvider, max_spread: float):
        self.model, self.processor = model, processor
        self.scale, self.road, self.max_spread = scale, road, max_spread

    def __call__(self, image: Tensor) -> Tensor:
        """Return (B, 1, H, W), m, inf in the sky.

        Raises:
            RoadSpreadError, ValueError: as for `each`, if a scale cannot be trusted.
        """
        results = self.each(image)
        for result in results:
            if isinstance(result, RoadSpreadError):
                raise result
        return torch.stack([result.depth for result in results if isinstance(result, ScaledDepth)])

    def each(self, image: Tensor) -> list["ScaledDepth | RoadSpreadError"]:
        """Return the depth of each image, or the error of those whose scale cannot be trusted.

        Raises:
            ValueError: not three channels; an output of the network that is not in m, see `check_depth`.
        """
        image = check_rgb("image", to_float(image) if is_whole(image) else image.detach().float())
        depth, is_sky = self._predict(image), sky_mask(image)
        check_depth(depth, name="output of the model")
        scaled = torch.where(is_sky, torch.inf, depth)
        if self.scale == "model":
            return [ScaledDepth(row, None, None) for row in scaled]
        scale, spread = road_scale(scaled, self.road)
        rows = zip(scaled * scale.view(-1, 1, 1, 1), scale.tolist(), spread.tolist(), strict=True)
        return [
            ScaledDepth(torch.where(sky, torch.inf, row), factor, width)
            if width <= self.max_spread
            else RoadSpreadError(
                f"depth must agree with a flat road up to a spread of {self.max_spread:g}, got {width:.2g}: describe "
                "your camera by road, in a command by road.camera_height, road.focal and road.horizon, or take the "
                'meters of the network by scale="model", in a command by scale_by=model'
            )
            for (row, factor, width), sky in zip(rows, is_sky, strict=True)
        ]

    @torch.no_grad()
    def _predict(self, image: Tensor) -> Tensor:
        """Return the depth of the network, (B, 1, H, W)."""
        device = next(self.model.parameters()).device
        inputs = self.processor(images=list(image.to(device)), do_rescale=False, return_tensors="pt").to(device)
        sizes = [tuple(image.shape[2:])] * len(image)
        arguments: dict[str, Any] = {"target_sizes": sizes}
        post_process = self.processor.post_process_depth_estimation
        if "source_sizes" in inspect.signature(post_process).parameters:
            arguments["source_sizes"] = sizes
        results = post_process(self.model(**inputs), **arguments)
        depth = torch.stack([result["predicted_depth"] for result in results])
        return depth.view(len(image), 1, *image.shape[2:]).to(image.device).float().clamp(min=0)


def from_transformers(
    name_or_folder: str | Path,
    *,
    scale: str = "road",
    road: DepthProvider | None = None,
    max_spread: float = _MAX_SPREAD,
    device: torch.device | str | None = None,
) -> TransformersDepth:
    """Load a network for monocular depth in meters, such as Depth Anything V2 (metric) or ZoeDepth.

    Args:
        name_or_folder: name in the hub, such as "depth-anything/Depth-Anything-V2-Metric-Outdoor-Small-hf", or a
            folder with config.json, preprocessor_config.json and model.safetensors.
        scale: "road" multiplies each frame by one factor that puts the road in the middle third at the distance of a
            flat road (networks are often off by a constant factor for cameras they were not trained with); "model"
            takes the meters of the network.
        road: the flat road; None is `GroundPlaneDepth()`.
        max_spread: largest spread of that factor over the pixels of the road, see `RoadScale`; above it a call raises.
        device: of the network; None is the CPU.

    Raises:
        ImportError: transformers is not installed.
        ValueError: a network that does not predict meters, as disparity and relative depth look alike; a name that
            cannot be loaded.
    """
    check_choice("scale", scale, _SCALES)
    max_spread = check_positive("max_spread", max_spread)
    road = GroundPlaneDepth() if road is None else road
    if not isinstance(road, DepthProvider):
        raise TypeError(f"road must be a depth provider such as GroundPlaneDepth(), got {type(road).__name__}")
    try:
        # It takes seconds.
        from transformers import AutoConfig, AutoImageProcessor, AutoModelForDepthEstimation  # noqa: PLC0415 - an extra
    except ImportError as error:
        raise ImportError('depth networks need transformers: pip install "torchrefract[depth]"') from error
    name = str(name_or_folder)
    try:
        config = AutoConfig.from_pretrained(name)
        _check_metric(config, name)
        processor = AutoImageProcessor.from_pretrained(name)
        model = AutoModelForDepthEstimation.from_pretrained(name).eval()
    except OSError as error:
        raise ValueError(
            f"name_or_folder must be a depth model of the hub that can be reached, or a folder of one (download it "
            f"elsewhere and pass the folder), got {name}: {str(error).splitlines()[0]}"
        ) from error
    if device is not None:
        model = model.to(device)
    return TransformersDepth(model, processor, scale=scale, road=road, max_spread=max_spread)


def _check_metric(config: Any, name: str) -> None:
    kind = config.model_type
    is_metric = kind in _METRIC or (kind in _EITHER and config.depth_estimation_type == "metric")
    if not is_metric:
        raise ValueError(
            f"name_or_folder must be a model that predicts meters ({', '.join(_METRIC)}, or depth_anything of the type "
            f'"metric"), got {name} of the type {kind}, which predicts relative depth; convert such maps with '
            "depth_from_inverse"
        )
