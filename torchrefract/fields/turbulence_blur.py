"""The blur of short exposures through turbulent air: less contrast of fine detail, the more the farther it is.

An exposure of some milliseconds freezes the air. Its tilt moves a point, see `torchrefract.fields.physical_turbulence`;
what remains blurs it.
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from torchrefract._tensor import cached_constant
from torchrefract.fields.random_field import fast_size

_ERROR = 0.0199  # of the contrast, by the interpolation between distances; 2 % with what the grid below omits
_GRID = 257  # shares of the largest strength, and of the largest exponent, at which that error is computed
_HALO = 14.5  # widths lambda / r0 of the blur, beyond which it has 0.1 % of the light
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


class Distances(NamedTuple):
    """The distances at which a frame is blurred; all others are interpolated between these.

        exp(-x u g) = sum_i exp(-rates_i u) sum_j weights_ij exp(-x places_j g)  for u and g in [0, 1], up to 2 %

    It is exact for u in `places`, at n distances, and for n exponents, of which one is 0, as `rates` start with 0.
    """

    places: tuple[float, ...]  # (n,), shares of the largest strength, the first one 0
    rates: tuple[float, ...]  # (n,)
    weights: tuple[tuple[float, ...], ...]  # (n, n)


@cached_constant(maxsize=64)
def distances_for(strength: float, view: View) -> Distances:
    """Return at how many distances `blur_by_distance` blurs, so that the contrast is off by at most 2 %, and at which.

    Each is the one, with an exponent, where the interpolation between those before it is off the most.

    Args:
        strength: largest (D / r0)^(5/3) of a pixel.
        view: of the frame.

    Source: Bebendorf, "Approximation of boundary element matrices", Numerische Mathematik 86 (2000), for the choice.
    """
    largest = strength * _largest_exponent(view)
    shares = torch.linspace(0, 1, _GRID, dtype=torch.float64, device="cpu").square()
    error = torch.exp(-largest * shares[:, None] * shares)
    chosen: list[tuple[int, int]] = []
    while error.abs().amax() > _ERROR:
        place, exponent = divmod(int(error.abs().argmax()), _GRID)
        chosen.append((place, exponent))
        error = error - error[:, exponent, None] * error[place] / error[place, exponent]
    places, exponents = (shares[list(index)] for index in zip(*chosen, strict=True))
    weights = torch.linalg.inv(torch.exp(-largest * places[:, None] * exponents))
    rates = (largest * exponents).tolist()
    return Distances(tuple(places.tolist()), tuple(rates), tuple(map(tuple, weights.tolist())))


def halo_px(strength: float, view: View) -> int:
    """Return the distance in px beyond which 0.1 % of the light of a point goes at most.

    The rest of the light beyond a radius R is 0.086 (w / R)^(5/3), w = focal lambda / r0, as that of long exposures.

    Args:
        strength: largest (D / r0)^(5/3) of a pixel.
        view: of the frame.
    """
    width = max(view.focal) * view.wavelength / view.aperture * strength**0.6
    return math.ceil(min(_HALO * width, 1e9))


def blur_by_distance(light: Tensor, strength: Tensor, view: View, *, distances: Distances, halo: int) -> Tensor:
    """Blur light, each pixel by a strength of its own.

    The strengths of the frame lie between the lowest one and the highest one, u in [0, 1] of the way. For each of the
    rates the frame is blurred once by a transfer function. Their sum, each times exp(-rate u), is the result. Light
    that would leave the frame is reflected at its border.

    Args:
        light: (N, C, H, W), linear, finite.
        strength: (N, 1, H or 1, W or 1), (D / r0)^(5/3), at least 0; it grows linearly with the distance.
        view: of the frame.
        distances: for the highest strength or a higher one, see `distances_for`.
        halo: px, how far the frame is continued, see `halo_px`; from half a side on all light stays in the frame.

    Returns:
        (N, C, H, W).
    """
    height, width = light.shape[2:]
    sizes = _extended_size(height, halo), _extended_size(width, halo)
    rows, columns = (_reflected(size, to, light.device) for size, to in zip((height, width), sizes, strict=True))
    spectrum = torch.fft.rfft2(light.index_select(2, rows).index_select(3, columns))
    exponent = short_exposure_exponent(_frequencies(sizes, view.focal, light), view)
    low = strength.amin(dim=(1, 2, 3), keepdim=True)
    span = strength.amax(dim=(1, 2, 3), keepdim=True) - low
    share = ((strength - low) / span.clamp(min=_TINY)).clamp(0, 1)
    passed = [torch.exp(-(low + place * span) * exponent) for place in distances.places]
    result = torch.zeros((), dtype=light.dtype, device=light.device)
    for rate, weights in zip(distances.rates, distances.weights, strict=True):
        transfer = torch.stack([weight * value for weight, value in zip(weights, passed, strict=True)]).sum(dim=0)
        lines = torch.fft.ifft(spectrum * transfer, dim=2).narrow(2, 0, height)
        blurred = torch.fft.irfft(lines, n=sizes[1], dim=3).narrow(3, 0, width)
        result = torch.addcmul(result, torch.exp(-rate * share), blurred)
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
