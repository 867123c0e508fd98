"""Exposure of a frame by a camera, in linear light: metering, gain, noise, and the delay of the gain in clips."""

import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from torchrefract._tensor import rows_at_once
from torchrefract._validation import requires_grad
from torchrefract.fields.srgb import LINEAR_TOE, STORED_TOE, linear_to_srgb, srgb_to_linear

_NODES = 192  # of the metered lattice along the longer side
_CEILING = 16.0  # times white; brighter light counts as this, since a sensor saturates
_CLIPPED = (0.8, 0.95)  # linear light, from where a frame may be clipped, and is: JPEG blurs white by a few levels
_DARK = 1e-3  # added to both sides of a ratio of means, so that black frames have a gain
_SHORTEST = 1e-3  # frames, of a time constant
_CACHED_VALUES = 1 << 18  # float32 values; half as many take as long, with more starts of operations
_LEAST_WIDTH = 1e-6  # of the part between line and power, which vanishes for a gain of 1
_LEAST_VARIANCE = 1e-20  # whose square root has a finite gradient


def metered_nodes(image: Tensor) -> tuple[Tensor, int]:
    """Return the linear light (N, C, h, w) at the nodes that a camera meters, and their distance in px.

    Args:
        image: (N, C, H, W), stored values (sRGB); NaN and infinite ones count as black. The nodes are the upper left
            pixels of blocks, of which the longer side of the frame has at most 192.
    """
    stride = -(-max(image.shape[2:]) // _NODES)
    # Contiguous, since the order of a sum must not depend on the memory format of the image.
    return srgb_to_linear(finite_image(image[:, :, ::stride, ::stride].contiguous())), stride


def metered_mean(light: Tensor) -> Tensor:
    """Return (N,), the mean of linear light (N, C, h, w), of which more than 16 times white counts as that."""
    return light.clamp(max=_CEILING).mean(dim=(1, 2, 3))


def exposure_gain(mean: Tensor, target: Tensor, gamma: Tensor, *, low: float, high: float) -> Tensor:
    """Return the gain G = ((target + 0.001) / (mean + 0.001))^gamma, limited to [low, high].

    Args:
        mean: metered light, at least 0; white is 1.
        target: mean that the camera aims at, at least 0. The 0.001 gives a black frame a gain.
        gamma: 1 reaches the target, 0 leaves the frame as it is.
        low, high: limits, above 0.
    """
    stops = gamma * ((target + _DARK).log() - (mean + _DARK).log())
    return stops.clamp(math.log(low), math.log(high)).exp()


def follow_gain(gain: Tensor, time_constant: Tensor) -> Tensor:
    """Return the gain G of each frame of a clip if the camera follows the metered one G* with a delay.

    d(log G)/dt = (log G* - log G) / tau, solved exactly for a G* that is constant from one frame to the next, and
    G = G* in the first frame.

    Args:
        gain: (B, T), G*.
        time_constant: (B,), tau in frames; less than 0.001 counts as 0.001.

    Returns:
        (B, T), G.
    """
    metered = gain.log().unbind(1)
    remaining = (-1 / time_constant.clamp(min=_SHORTEST)).exp()
    followed = [metered[0]]
    for value in metered[1:]:
        followed.append(torch.lerp(value, followed[-1], remaining))
    return torch.stack(followed, dim=1).exp()


def apply_gain(image: Tensor, gain: Tensor) -> Tensor:
    """Return the stored values of G x, clipped to [0, 1], where x is the linear light of the image.

    Where x and G x both lie on the line of the sRGB curve, G x is stored as G I; where both lie on its power, as
    G^(1/2.4) (I + 0.055) - 0.055. Between, the cubic that continues both stands for a power. It is off by at most 0.06
    levels of 1/255 for G from 1/32 to 2, and by at most 0.4 up to 4.

    Args:
        image: (N, C, H, W), stored values (sRGB), I; NaN and infinite ones count as black.
        gain: (N,), G, above 0.
    """
    gain = gain.view(-1, 1, 1, 1)
    end = linear_to_srgb(LINEAR_TOE / gain)
    low, high = end.clamp(max=STORED_TOE), end.clamp(min=STORED_TOE)
    # G (low + t) + a2 t^2 + a3 t^3, t = I - low, has the values and slopes of line and power at both ends.
    steep, width = gain ** (1 / 2.4), high - low + _LEAST_WIDTH
    secant = (steep * (high + 0.055) - 0.055 - gain * low) / width
    a2, a3 = (3 * secant - 2 * gain - steep) / width, (gain + steep - 2 * secant) / width.square()
    bend = gain - steep

    def of_rows(band: Tensor, _: slice, out: Tensor | None) -> Tensor:
        band = finite_image(band)
        # A sum of the three parts: torch.where over pixels takes several times as long.
        above = (band - low).relu_()
        t = torch.minimum(above, width)
        curve = torch.addcmul(bend, t, (t * a3).add_(a2))
        line = torch.mul(gain, band, out=out).addcmul_(-bend, above).addcmul_(t, curve)
        return torch.clamp(line, 0, 1, out=out)

    return map_rows(of_rows, image, (gain,))


def expose_clipped(light: Tensor, gain: Tensor) -> Tensor:
    """Return G x + (1 - G) w x for G below 1, w = s^2 (3 - 2 s), s = (darkest channel - 0.8) / 0.15 within [0, 1].

    White in a frame is light that its camera clipped, and so brighter by an unknown factor: it stays white under a
    lower gain, where G x alone would turn an overcast sky into a gray plane.

    Args:
        light: (N, C, H, W), x, linear light in [0, 1].
        gain: (N, 1, 1, 1), G.
    """
    low, high = _CLIPPED
    clipped = (light.amin(dim=1, keepdim=True) - low).mul_(1 / (high - low)).clamp(0, 1)
    clipped = clipped * clipped * (3 - 2 * clipped)
    return light * torch.addcmul(gain, 1 - gain, clipped)


def finite_image(image: Tensor) -> Tensor:
    """Return the image with black in place of NaN and infinite values, which the gain would spread over the frame."""
    return image.nan_to_num(nan=0.0, posinf=0.0, neginf=0.0)


def map_rows(
    function: Callable[[Tensor, slice, Tensor | None], Tensor], image: Tensor, others: Sequence[Tensor]
) -> Tensor:
    """Return a function of pixels, computed for bands of rows that fit into the cache of a core.

    Args:
        function: maps rows of the image (N, C, h, W), which rows they are, and a tensor for the result, or None, to
            that tensor or a new one (N, C, h, W).
        image: (N, C, H, W).
        others: tensors that the result depends on as well.
    """
    batch, channels, height, width = image.shape
    if torch.compiler.is_compiling() or requires_grad((image, *others)):
        return function(image, slice(0, height), None)
    count = rows_at_once(image.device, height, each=batch * channels * width, cached=_CACHED_VALUES, shared=True)
    result = torch.empty_like(image)
    for start in range(0, height, count):
        rows = slice(start, start + count)
        function(image[:, :, rows], rows, result[:, :, rows])
    return result


def sensor_noise(light: Tensor, gain: Tensor, shot: Tensor, read: Tensor, noise: Tensor) -> Tensor:
    """Return the noise of a sensor, normal with the variance a G x + b G^2.

    Args:
        light: (N, C, H, W), G x, linear light after the gain.
        gain: (N,), G.
        shot: (N,), a, white being 1.
        read: (N,), b.
        noise: (N, C, H, W), standard normal.

    Source: Foi, Trimeche, Katkovnik, Egiazarian, "Practical Poissonian-Gaussian noise modeling and fitting for
    single-image raw-data", IEEE Transactions on Image Processing 17 (2008).
    """
    gain, shot, read = (value.view(-1, 1, 1, 1) for value in (gain, shot, read))
    return noise * (shot * light.clamp(min=0) + read * gain.square()).clamp(min=_LEAST_VARIANCE).sqrt()
