"""A small network that removes fog: it sees how much each pixel differs from the color of the fog."""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from torchrefract._tensor import pad_to_multiple
from torchrefract._validation import check_count, check_rgb
from torchrefract.restoration.models.coordconv import pixel_coordinates
from torchrefract.warping.grid import field_dtype

_STRIDE = 32
_INPUTS = 6
_WIDTHS = (1, 2, 4, 6, 6)  # of the scales, in multiples of the width
_SHARPNESS = 50.0  # of the weights of the airlight, per unit of the dark channel
_LEVEL = 1 / 255
_DARKEST = 0.05  # airlight, below which an image is not brightened further for the network
_MAX_LOG_GAIN = 4.0  # beyond, 8 bits hold little of the scene


class FogNet(nn.Module):
    """Predict maps of foggy images by a small U-Net that is given the airlight.

    Fog adds A (1 - t) and leaves t (J - A) of the scene J. In units of the airlight A, as of `airlight_in_fog`, it is
    D = I / A - 1, whatever the color and the exposure of the camera, and log |D| falls with the distance as log t does.
    The inputs are D, the logarithm, and the coordinates of the pixels. The mean of the coarsest features, which tells
    how dense the fog is, is added to all of them. The first three maps, the change of the image, are
    A (D (exp(g) - 1) + r) with g and r of the last layer, which starts at zero: exp(g) takes the part of 1 / t, so that
    details come from the image.

    Args:
        channels: number of maps to predict, at least the three of the change.
        width: number of features of the finest scale.
        smooth: must be False: the maps follow the edges of the image.

    Raises:
        ValueError: `channels` is below 3, the width below 1, or `smooth` is True.

    Source: Ronneberger, Fischer, Brox, "U-Net", MICCAI 2015.
    """

    def __init__(self, channels: int, *, width: int = 16, smooth: bool = False):
        super().__init__()
        if smooth:
            raise ValueError("smooth must be False for fog_net, which predicts no flow, got True: use model=lens_net")
        widths = [check_count("width", width) * factor for factor in _WIDTHS]
        steps = list(zip([_INPUTS, *widths[:-1]], widths, strict=True))
        self.down = nn.ModuleList(
            nn.Sequential(_convolution(before, after, stride=2), *[_convolution(after, after)] * (before != _INPUTS))
            for before, after in steps
        )
        self.of_frame = nn.Sequential(nn.Linear(widths[-1], widths[-1]), nn.SiLU(), nn.Linear(widths[-1], widths[-1]))
        self.up = nn.ModuleList(_convolution(after + before, before) for before, after in reversed(steps[1:]))
        self.finest = _convolution(widths[0] + _INPUTS, widths[0])
        self.head = nn.Conv2d(widths[0], 1 + check_count("channels", channels, low=3), 3, padding=1)
        for parameter in self.head.parameters():
            nn.init.zeros_(parameter)
        self.to(memory_format=torch.channels_last)

    def forward(self, image: Tensor) -> Tensor:
        """Predict the maps (B, channels, H, W) for images (B, 3, H, W) in [0, 1].

        Raises:
            ValueError: the image has another shape.
        """
        check_rgb("image", image)
        height, width = image.shape[2:]
        airlight = airlight_in_fog(image)[:, :, None, None].clamp(min=_DARKEST)
        difference = image / airlight - 1
        logarithm = (difference.abs().amax(dim=1, keepdim=True) + _LEVEL).log()
        parts = [4 * difference, logarithm / 2 + 1, pixel_coordinates(image)]
        inputs = pad_to_multiple(torch.cat(parts, dim=1), _STRIDE).contiguous(memory_format=torch.channels_last)
        scales = [inputs]
        for layer in self.down:
            scales.append(layer(scales[-1]))
        features = scales.pop()
        features = features + self.of_frame(features.mean(dim=(2, 3)))[:, :, None, None]
        for layer in (*self.up, self.finest):
            features = F.interpolate(features, scale_factor=2, mode="bilinear")
            features = layer(torch.cat([features, scales.pop()], dim=1))
        log_gain, maps = self.head(features)[:, :, :height, :width].split([1, self.head.out_channels - 1], dim=1)
        change = difference * torch.expm1(log_gain.clamp(max=_MAX_LOG_GAIN)) + maps[:, :3]
        return torch.cat([airlight * change, maps[:, 3:]], dim=1)


def airlight_in_fog(image: Tensor) -> Tensor:
    """Estimate the airlight of frames that show fog: the mean color, weighted by how bright and how gray they are.

        A = sum_p w_p I_p,  w_p ~ exp(50 d_p),  d_p = min of I over the channels and a patch of a sixth of the frame

    `airlight_of_frame` estimates the light that fog would have from a clear frame, where blue sky must count less.

    Args:
        image: (B, 3, H, W), stored values in [0, 1].

    Returns:
        (B, 3), differentiable.

    Source: He, Sun, Tang, "Single image haze removal using dark channel prior", IEEE TPAMI 33 (2011), with the mean in
    place of the brightest 0.1 %.
    """
    radius = min(image.shape[2:]) // 12
    dark = -image.amin(dim=1, keepdim=True)
    for kernel, padding in (((2 * radius + 1, 1), (radius, 0)), ((1, 2 * radius + 1), (0, radius))):
        dark = F.max_pool2d(dark, kernel, 1, padding)
    weight = (-_SHARPNESS * dark.to(field_dtype(image.dtype))).flatten(1).softmax(dim=1)
    return torch.einsum("bcn,bn->bc", image.to(weight.dtype).flatten(2), weight).to(image.dtype)


def _convolution(before: int, after: int, *, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(before, after, 3, stride, 1, bias=False), nn.BatchNorm2d(after), nn.SiLU(inplace=True)
    )
