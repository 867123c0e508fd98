"""The exposure of a camera: its gain follows the light that it meters."""

from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchrefract import random
from torchrefract._tensor import expand_batch
from torchrefract._validation import (
    check_flag,
    check_number,
    check_range,
    check_values,
    check_within,
    eager_values,
    finite_or,
    requires_grad,
)
from torchrefract.effects.batch import check_shapes, params_to
from torchrefract.effects.photometric_effect import PhotometricEffect, Rendered
from torchrefract.effects.random_field import check_frame
from torchrefract.fields.exposure import (
    apply_gain,
    exposure_gain,
    finite_image,
    follow_gain,
    metered_mean,
    metered_nodes,
    sensor_noise,
)
from torchrefract.fields.srgb import linear_to_srgb, srgb_to_linear
from torchrefract.types import Range
from torchrefract.warping.grid import field_dtype

MOST_GAMMA = 4.0
LONGEST = 1e6  # frames, of a time constant
_LEVELS = 255
_ROUNDING = 1e-6
_WORD = 0xFFFFFFFF
_LARGEST_GAIN = 4.0  # up to which `apply_gain` is good to half a level
_FRAME_WORD = 0x5851F42D  # odd, so that its multiples differ for 2^32 frames


class ExposureParams(NamedTuple):
    """The parameters of exposure for a batch."""

    applied: Tensor  # (B,), bool: the sample is degraded
    target: Tensor  # (B,), mean linear light that the camera aims at, above 0
    gamma: Tensor  # (B,), strength of the control, in [0, 4]
    time_constant: Tensor  # (B,), frames, at least 0
    shot: Tensor  # (B,), variance of the noise for each unit of light, in [0, 1]
    read: Tensor  # (B,), variance of the noise in the dark, in [0, 1]
    key: Tensor  # (B, 4), int64, of the noise
    frame: Tensor  # (B, T), number of each frame in its clip

    to = params_to

    @property
    def is_identity(self) -> Tensor:
        """Return (B,), bool: neither gain nor noise."""
        return (self.gamma == 0) & (self.shot == 0) & (self.read == 0)


class Exposure(PhotometricEffect):
    """Automatic exposure, in linear light x.

        I = quantize(clip(G x + n, 0, 1)),  G = ((target + 0.001) / (mean + 0.001))^gamma

    The mean is that of the frame over a lattice, in which light of more than 16 times white counts as that. The noise
    n is normal with the variance shot G x + read G^2. `valid` are the pixels that do not saturate. NaN and infinite
    pixels count as black. In a clip each frame is metered, and G follows with the time constant tau:

        d(log G)/dt = (log G* - log G) / tau,  G = G* in the first frame of the clip that is passed

    So with a time constant, a frame of a clip depends on those before it; without, each is exposed by itself.

    Args:
        target_range: mean linear light after the gain, in [0.001, 1]; 0.18 is a gray card.
        gamma_range: in [0, 4]; 1 reaches the target, 0 is no exposure.
        min_gain: lowest G, in [1/32, 1].
        max_gain: highest G, in [1, 4].
        time_constant_range: tau in frames, 0 or above.
        shot_range: variance of the noise for each unit of light, in [0, 1]; 0.001 is that of a sensor with 1000
            electrons.
        read_range: variance of the noise in the dark, in [0, 1].
        quantize: round the result to 1/255, with the gradient of the unrounded one.
        tolerance: all of the effect is computed under any tolerance. Without noise, pixels may be off by 0.06 levels
            of 1/255 for G up to 2, and by 0.4 up to 4.
        p: probability that a sample is degraded.

    Raises:
        ValueError: an argument outside its range.

    Source: Foi et al., "Practical Poissonian-Gaussian noise modeling and fitting for single-image raw-data", IEEE
    Transactions on Image Processing 17 (2008), for the noise.
    """

    params_type = ExposureParams
    maps = ()

    def __init__(
        self,
        *,
        target_range: Range = (0.15, 0.2),
        gamma_range: Range = (0.8, 1.0),
        min_gain: float = 1 / 16,
        max_gain: float = 4.0,
        time_constant_range: Range = (0.0, 0.0),
        shot_range: Range = (0.0, 0.0),
        read_range: Range = (0.0, 0.0),
        quantize: bool = False,
        tolerance: float | None = None,
        p: float = 1.0,
    ):
        super().__init__(tolerance=tolerance, p=p)
        self.target_range = check_range("target_range", target_range, low=1e-3, high=1.0)
        self.gamma_range = check_range("gamma_range", gamma_range, low=0.0, high=MOST_GAMMA)
        self.min_gain = check_number("min_gain", min_gain, low=1 / 32, high=1.0)
        self.max_gain = check_number("max_gain", max_gain, low=1.0, high=_LARGEST_GAIN)
        self.time_constant_range = check_range("time_constant_range", time_constant_range, low=0.0, high=LONGEST)
        self.shot_range = check_range("shot_range", shot_range, low=0.0, high=1.0)
        self.read_range = check_range("read_range", read_range, low=0.0, high=1.0)
        self.quantize = check_flag("quantize", quantize)

    def sample_params(self, stream: random.Stream, image: Tensor) -> ExposureParams:
        """Draw all parameters uniformly in their ranges."""
        ranges = [self.target_range, self.gamma_range, self.time_constant_range, self.shot_range, self.read_range]
        applied, values = self.draw_in_ranges(stream, ranges, image)
        key = random.noise_key(stream)
        target, gamma, time_constant, shot, read = values.unbind(1)
        frame = torch.zeros_like(values[:, :1])
        return ExposureParams(applied, target, gamma, time_constant, shot, read, key, frame)

    def validate(self, params: ExposureParams, image: Tensor) -> None:
        """Raise ValueError for invalid parameters."""
        check_shapes(params, dict.fromkeys(("target", "gamma", "time_constant", "shot", "read"), ()) | {"key": (4,)})
        check_frame(params)
        check_values("params.target", "be in (0, 1]", params.target, lambda v: (v > 0) & (v <= 1))
        check_within("params.shot", params.shot, 0.0, 1.0)
        check_within("params.read", params.read, 0.0, 1.0)
        check_control(params)

    def render(self, image: Tensor, params: ExposureParams, depth: Tensor | None) -> Rendered:
        """Expose images."""
        image = image.contiguous()  # the rounding of a sum of products depends on the memory format
        rows, dtype = len(image), field_dtype(image.dtype)
        target, shot, read = (
            expand_batch(finite_or(value.to(dtype), 0.0), rows) for value in (params.target, params.shot, params.read)
        )
        light, _ = metered_nodes(image)
        gain = controlled_gain(metered_mean(light), target, params, low=self.min_gain, high=self.max_gain)
        if self._has_noise(params):
            light = gain.view(-1, 1, 1, 1) * srgb_to_linear(finite_image(image))
            light = light + sensor_noise(light, gain, shot, read, _white_noise(params, image))
            result = linear_to_srgb(light).clamp(0, 1)
        else:
            result = apply_gain(image, gain)
        if self.quantize:
            result = result + ((_LEVELS * result).round() / _LEVELS - result).detach()

        def is_valid() -> Tensor:
            return is_unsaturated(image, gain.view(-1, 1, 1, 1) * srgb_to_linear(finite_image(image)))

        return Rendered(result, is_valid)

    def _has_noise(self, params: ExposureParams) -> bool:
        """Return False if no sample has noise, as far as that is known without waiting for a device."""
        if requires_grad((params.shot, params.read)):
            return True
        is_noisy = eager_values(((params.shot > 0) | (params.read > 0)).any, of=params.shot)
        return self.shot_range[1] + self.read_range[1] > 0 if is_noisy is None else is_noisy


def check_control(params: Any) -> None:
    """Raise ValueError for a gamma or a time constant that `controlled_gain` does not take."""
    check_within("params.gamma", params.gamma, 0.0, MOST_GAMMA)
    check_within("params.time_constant", params.time_constant, 0.0, LONGEST)


def controlled_gain(mean: Tensor, target: Tensor, params: Any, *, low: float, high: float) -> Tensor:
    """Return the gain of each frame, (N,), from its metered mean and target, both (N,).

    Args:
        mean, target: linear light.
        params: give gamma and time constant, (B,), and the numbers of the frames, (B, T).
        low, high: limits of the gain.
    """
    gamma, time_constant = (finite_or(value.to(mean.dtype), 0.0) for value in (params.gamma, params.time_constant))
    gain = exposure_gain(mean, target, expand_batch(gamma, len(mean)), low=low, high=high)
    return gain if params.frame.shape[1] == 1 else follow_gain(gain.view_as(params.frame), time_constant).flatten()


def is_unsaturated(image: Tensor, light: Tensor) -> Tensor:
    """Return (N, 1, H, W), bool: finite pixels of the clean image whose light after the gain does not exceed white."""
    return ((light <= 1 + _ROUNDING) & image.isfinite()).all(dim=1, keepdim=True)


def _white_noise(params: ExposureParams, image: Tensor) -> Tensor:
    """Return standard normal numbers for each pixel and channel, which differ from frame to frame of a clip."""
    rows, size = len(image), image.shape[1:].numel()
    shift = (finite_or(params.frame, 0.0).round().long() * _FRAME_WORD).reshape(-1, 1)
    key = (expand_batch(params.key, rows) + shift) & _WORD
    return random.white_noise(key, -(-size // 2)).flatten(1)[:, :size].view(image.shape).to(image.dtype)
