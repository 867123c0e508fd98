"""The color of fog: from the frame that it will be added to, and brighter towards the sun."""

import math

import torch
from torch import Tensor

from torchrefract._tensor import as_device_tensor, highest_nearby, shareable
from torchrefract.fields.sky import find_sky
from torchrefract.fields.srgb import linear_to_srgb, luma, srgb_to_linear

_PATCH = 7  # nodes
_BRIGHTEST = 0.001  # share of the dark channel
_MIN_SKY, _LOWEST = 0.04, 0.25  # share of the frame from which sky counts, and of the sky that does
_NIGHT, _DUSK = 0.3, 0.35  # median luma of the upper third at night; and if it is darker than the rest by a tenth
_DUST = (0.78, 0.71, 0.61)  # of laterite by day
_KEPT_CHROMA = 0.25  # of blue light by day
_STEPS = 2.0**16  # results are rounded to multiples of 1 / _STEPS, so that they have equal bits in every batch


@shareable
def airlight_of_frame(image: Tensor) -> Tensor:
    """Estimate the airlight of frames: the light that fog would scatter towards the camera.

    With at least 4 % of sky, the mean color of the quarter of it that is lowest in the frame: at the horizon, the light
    of the sky has come through as much air as that of thick fog. Otherwise, by day, the mean color where the dark
    channel (the minimum over channels and patches) is among its brightest 0.1 %; by night, where these are lamps, the
    mean color of the upper third. A frame is taken for one of the night if it has no sky and a dark upper third. By day
    a color that is more blue than red keeps a quarter of its chroma: droplets scatter all colors alike, and sun and sky
    together are white.

    Args:
        image: (N, C, H, W), stored values in [0, 1], floating.

    Returns:
        (N, C), without a gradient. Each image is judged alone.

    Source: He, Sun and Tang, "Single image haze removal using dark channel prior", IEEE TPAMI 33 (2011).
    """
    image = image.detach()
    seen = find_sky(image)
    nodes = image[:, :, :: seen.stride, :: seen.stride].double().nan_to_num(nan=0.0).clamp(0, 1)
    count = seen.nodes.sum(dim=(2, 3))
    is_low = seen.nodes & (seen.nodes.sum(dim=3).cumsum(dim=2) > (1 - _LOWEST) * count[:, :, None])[..., None]
    sky = (nodes * is_low).sum(dim=(2, 3)) / is_low.sum(dim=(2, 3)).clamp(min=1)
    dark = -highest_nearby(-nodes.amin(dim=1, keepdim=True), _PATCH // 2)
    count = max(1, round(dark.shape[2:].numel() * _BRIGHTEST))
    is_haze = dark >= dark.flatten(1).topk(count, dim=1).values[:, -1].view(-1, 1, 1, 1)  # patches have equal values
    haze = (nodes * is_haze).sum(dim=(2, 3)) / is_haze.sum(dim=(2, 3))
    top = nodes[:, :, : max(1, nodes.shape[2] // 3)]
    upper, middle = (luma(part).flatten(1).median(dim=1).values for part in (top, nodes))
    is_night = seen.is_night | (upper < _NIGHT) | ((upper < _DUSK) & (upper < 0.9 * middle))
    has_sky = seen.nodes.double().mean(dim=(1, 2, 3))[:, None] >= _MIN_SKY
    day = torch.where(has_sky, sky, haze)
    if image.shape[1] == 3:
        gray = luma(day[..., None, None])[..., 0, 0]
        day = torch.where(day[:, 2:] > day[:, :1], torch.lerp(gray, day, _KEPT_CHROMA), day)
    color = torch.where(is_night[:, None] & ~has_sky, top.mean(dim=(2, 3)), day)
    return (color * _STEPS).round() / _STEPS


def dust_airlight(image: Tensor) -> Tensor:
    """Return the airlight of laterite dust, (0.78, 0.71, 0.61), or as much of it as the frame has light.

        A = dust min(1, luma(A_frame) / luma(dust))

    Args, Returns: as for `airlight_of_frame`, which gives A_frame.
    """
    dust = as_device_tensor(_DUST, dtype=torch.float64, device=image.device).view(1, 3, 1, 1)
    gray, light = luma(dust).view(1, 1), luma(airlight_of_frame(image)[..., None, None]).view(-1, 1)
    color = dust.view(1, 3) if image.shape[1] == 3 else gray.expand(1, image.shape[1])
    return color * (light / gray).clamp(max=1)


def forward_scattering(cosine: Tensor, asymmetry: float) -> Tensor:
    """Return how much light a particle scatters by an angle, relative to equal scattering in all directions.

        (1 - g^2) / (1 + g^2 - 2 g cosine)^(3/2)

    Args:
        cosine: of the angle between the ways of the light before and after, in [-1, 1].
        asymmetry: g, the mean cosine, in (-1, 1).

    Source: Henyey and Greenstein, "Diffuse radiation in the galaxy", Astrophysical Journal 93 (1941).
    """
    return (1 - asymmetry**2) / (1 + asymmetry**2 - 2 * asymmetry * cosine) ** 1.5


def sunlit_airlight(
    airlight: Tensor,
    sun: Tensor,
    *,
    height: int,
    width: int,
    focal: tuple[float, float],
    center: tuple[float, float],
    horizon: float,
    asymmetry: float,
) -> Tensor:
    """Return the airlight at each pixel of a frame: brighter on the side of the sun, darker on the other.

        A (1 - w + w p(theta)),  in linear light, at most 1

    A is the airlight of equal light from all directions, w the share of direct sunlight in it, p `forward_scattering`
    and theta the angle between the ray of the pixel and the sun. Light is taken to be scattered once.

    Args:
        airlight: (N, C), stored values in [0, 1].
        sun: (N, 3), degrees to the right of the camera, degrees above the horizon, and w in [0, 1].
        height, width: px.
        focal, center: px, of the camera.
        horizon: share of the height, from the top, at which the road vanishes.
        asymmetry: g in (-1, 1), as for `forward_scattering`.

    Returns:
        (N, C, H, W), stored values in [0, 1].
    """
    columns, rows = (torch.arange(size, dtype=airlight.dtype, device=airlight.device) for size in (width, height))
    x, y = ((columns - center[0]) / focal[0]).view(1, 1, width), ((rows - center[1]) / focal[1]).view(1, height, 1)
    azimuth, elevation = sun[:, 0].deg2rad().view(-1, 1, 1), sun[:, 1].deg2rad().view(-1, 1, 1)
    right, up, ahead = elevation.cos() * azimuth.sin(), elevation.sin(), elevation.cos() * azimuth.cos()
    # The axis of the camera points above the horizon by the pitch.
    pitch = math.atan((horizon * height - 0.5 - center[1]) / focal[1])
    down, ahead = math.sin(pitch) * ahead - math.cos(pitch) * up, math.cos(pitch) * ahead + math.sin(pitch) * up
    cosine = (x * right + y * down + ahead) / (x * x + y * y + 1).sqrt()
    share = sun[:, 2].view(-1, 1, 1)
    factor = 1 - share + share * forward_scattering(cosine, asymmetry)
    light = srgb_to_linear(airlight)[:, :, None, None] * factor[:, None]
    return linear_to_srgb(light.clamp(max=1.0))
