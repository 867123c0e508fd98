"""The blur of short exposures through turbulent air: less contrast of fine detail, the more the farther it is.

An exposure of some milliseconds freezes the air. Its tilt moves a point, see `torchrefract.fields.physical_turbulence`;
what remains blurs it.
"""

import math
from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor

from torchrefract._tensor import cached_constant
from torchrefract.fields.random_field import fast_size

# Of the contrast, by the interpolation between distances; 2 % with what the bound by a chord omits.
_ERROR = 0.0199
_HALO = 14.5  # widths lambda / r0 of the blur, beyond which it has 0.1 % of the light
_BEND = 2 * (1 - 1 / math.e)  # of `_spacing` at 2
_KERNEL_SIDE = 128  # px, of the kernel whose sum bounds the change of an image
_TINY = 1e-30


class View(NamedTuple):
    """The camera behind the air.

    focal: px, fx and fy.
    aperture, wavelength: m.
    """

    focal: tuple[float, float]
    aperture: float
    wavelength: float


def short_exposure_exponent(frequency: Tensor, view: View) -> Tensor:
    """Return -ln of the transfer function of short exposures for an aperture of Fried's parameter, D = r0.

        g = 3.44 q^(5/3) (1 - q^(1/3) / 2),  q = min(lambda rho / D, 1)

    With (D / r0)^(5/3) g it is that of any D. Beyond the cut-off D / lambda of the aperture, where a frame shows no
    detail of the scene, but noise and edges that its camera sharpened, the function keeps its value at the cut-off.
    So clear air changes nothing, and the contrast never rises with the frequency.

    Args:
        frequency: rho, cycles per radian, at least 0.
        view: gives aperture and wavelength.

    Source: Fried, "Optical resolution through a randomly inhomogeneous medium for very long and very short exposures",
    JOSA 56 (1966), for an aperture far smaller than sqrt(lambda L) and than the outer scale.
    """
    q = (frequency * (view.wavelength / view.aperture)).clamp(max=1.0)
    return 3.44 * (q ** (5 / 3) - q.square() / 2)


def num_distances(strength: float, view: View) -> int:
    """Return at how many distances `blur_by_distance` must blur, so that the contrast is off by at most 2 %.

    Args:
        strength: largest (D / r0)^(5/3) of a pixel.
        view: of the frame.
    """
    spacing = _spacing(torch.tensor(strength * _largest_exponent(view), dtype=torch.float64, device="cpu"))
    # The chord of exp(-g x) is off by spacing^2 / 8, and up to 0.5 % of that more for steps of this size.
    return 1 + max(1, math.ceil(spacing.item() / math.sqrt(8 * _ERROR)))


def halo_px(strength: float, view: View) -> int:
    """Return the distance in px beyond which 0.1 % of the light of a point goes at most.

    The rest of the light beyond a radius R is 0.086 (w / R)^(5/3), w = focal lambda / r0, as that of long exposures.

    Args:
        strength: largest (D / r0)^(5/3) of a pixel.
        view: of the frame.
    """
    width = max(view.focal) * view.wavelength / view.aperture * strength**0.6
    return math.ceil(min(_HALO * width, 1e9))


def blur_by_distance(light: Tensor, strength: Tensor, view: View, *, count: int, halo: int) -> Tensor:
    """Blur light, each pixel by a strength of its own.

    The frame is blurred with `count` strengths from the lowest to the highest one, each by its transfer function, and
    interpolated linearly between these. Light that would leave the frame is reflected at its border.

    Args:
        light: (N, C, H, W), linear, finite.
        strength: (N, 1, H or 1, W or 1), (D / r0)^(5/3), at least 0; it grows linearly with the distance.
        view: of the frame.
        count: of strengths, at least 2, see `num_distances`.
        halo: px, how far the frame is continued, see `halo_px`; from half a side on all light stays in the frame.

    Returns:
        (N, C, H, W).
    """
    height, width = light.shape[2:]
    sizes = _extended_size(height, halo), _extended_size(width, halo)
    rows, columns = (_reflected(size, to, light.device) for size, to in zip((height, width), sizes, strict=True))
    spectrum = torch.fft.rfft2(light.index_select(2, rows).index_select(3, columns))
    exponent = short_exposure_exponent(_frequencies(sizes, view.focal, light), view)

    def in_frame(spectrum: Tensor) -> Tensor:
        lines = torch.fft.ifft(spectrum, dim=2).narrow(2, 0, height)
        return torch.fft.irfft(lines, n=sizes[1], dim=3).narrow(3, 0, width)

    steps = _steps(strength.amin(dim=(1, 2, 3)), strength.amax(dim=(1, 2, 3)), count, _largest_exponent(view))
    steps = [step.view(-1, 1, 1, 1) for step in steps]
    passed = torch.exp(-steps[0] * exponent)
    result = in_frame(spectrum * passed)
    for low, high in pairwise(steps):
        before, passed = passed, torch.exp(-high * exponent)
        share = ((strength - low) / (high - low).clamp(min=_TINY)).clamp(0, 1)
        result = torch.addcmul(result, share, in_frame(spectrum * (passed - before)))
    return result


@cached_constant(maxsize=64)
def largest_change(strength: float, view: View) -> float:
    """Return the largest change of a pixel by the blur, in linear light, of frames in [0, 1].

    It is half the sum of the magnitudes of the kernel that is subtracted, whose sum is 0.

    Args:
        strength: largest (D / r0)^(5/3) of a pixel.
        view: of the frame.
    """
    like = torch.empty(0, dtype=torch.float64, device="cpu")
    exponent = short_exposure_exponent(_frequencies((_KERNEL_SIDE, _KERNEL_SIDE), view.focal, like), view)
    return torch.fft.irfft2(-torch.expm1(-strength * exponent)).abs().sum().item() / 2


def _largest_exponent(view: View) -> float:
    """Return the exponent at the highest frequency of the frame."""
    highest = torch.tensor([math.hypot(*view.focal) / 2], dtype=torch.float64, device="cpu")
    return short_exposure_exponent(highest, view).item()


def _steps(low: Tensor, high: Tensor, count: int, largest: float) -> list[Tensor]:
    """Return strengths from low to high, (N,), whose chords of exp(-strength g) are off alike for the worst g."""
    start, end = _spacing(low * largest), _spacing(high * largest)
    inner = [_from_spacing(torch.lerp(start, end, k / (count - 1))) / largest for k in range(1, count - 1)]
    return [low, *inner, high]


def _spacing(x: Tensor) -> Tensor:
    """Return int_0^x max over g in [0, 1] of g exp(-g y / 2) dy.

    2 (1 - exp(-x / 2)) up to x = 2, then 2 (1 - 1/e) + 2 ln(x / 2) / e
    """
    return -2 * torch.expm1(-x.clamp(max=2.0) / 2) + (x.clamp(min=2.0) / 2).log() * (2 / math.e)


def _from_spacing(spacing: Tensor) -> Tensor:
    """Return x for `_spacing`."""
    low, high = spacing.clamp(max=_BEND), spacing.clamp(min=_BEND)
    return -2 * torch.log1p(-low / 2) + 2 * torch.expm1((high - _BEND) * (math.e / 2))


def _extended_size(size: int, halo: int) -> int:
    """Return the size, px, of the period of a reflected side, in which its middle may be left out."""
    return min(2 * size, fast_size(min(2 * size, size + 2 * halo)))


def _reflected(size: int, period: int, device: torch.device) -> Tensor:
    """Return (period,), the index of each pixel: those of a side, of its end reflected, and of its start reflected."""
    index = torch.arange(period, device=device)
    beyond = index - size
    end = (period - size + 1) // 2
    return torch.where(beyond < 0, index, torch.where(beyond < end, size - 1 - beyond, period - 1 - index))


def _frequencies(sizes: tuple[int, int], focal: tuple[float, float], like: Tensor) -> Tensor:
    """Return the frequencies of `rfft2`, (Ht, Wt / 2 + 1), cycles per radian."""
    options = {"dtype": like.dtype, "device": like.device}
    down = torch.fft.fftfreq(sizes[0], **options) * focal[1]
    across = torch.fft.rfftfreq(sizes[1], **options) * focal[0]
    return torch.hypot(down[:, None], across)
