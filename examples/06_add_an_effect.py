"""Add an effect, natural vignetting: python examples/06_add_an_effect.py [PICTURE.png]."""

import sys
from typing import NamedTuple

import torch
from matplotlib.image import imsave

from torchrefract._validation import check_range, check_values
from torchrefract.data.road_scenes import render_road_scenes
from torchrefract.effects.batch import params_to, per_sample
from torchrefract.effects.photometric_effect import PhotometricEffect, Rendered


def vignetting(strength: torch.Tensor, *, height: int, width: int) -> torch.Tensor:
    """Return t = 1 - s (1 - cos^4 a), tan a = r / (0.9 W), (B, 1, H, W), of s (B,). Source: Reiss, JOSA 35 (1945)."""
    y, x = (torch.arange(size).to(strength) - (size - 1) / 2 for size in (height, width))
    tangent = torch.hypot(x, y[:, None]) / (0.9 * width)
    return 1 - per_sample(strength) * (1 - (1 + tangent.square()) ** -2)


class VignettingParams(NamedTuple):
    applied: torch.Tensor  # (B,), bool: the sample is degraded
    strength: torch.Tensor  # (B,), s in [0, 1]; 1 is the cos^4 law
    to = params_to
    is_identity = property(lambda self: self.strength == 0)


class Vignetting(PhotometricEffect):
    params_type, maps = VignettingParams, ("transmission",)

    def __init__(self, *, strength_range=(0.5, 1.0), tolerance=None, p=1.0):
        super().__init__(tolerance=tolerance, p=p)
        self.strength_range = check_range("strength_range", strength_range, low=0.0, high=1.0)

    def sample_params(self, stream, image):
        applied, values = self.draw_in_ranges(stream, [self.strength_range], image)
        return VignettingParams(applied, values[:, 0])

    def validate(self, params, image):
        check_values("params.strength", "lie in [0, 1]", params.strength, lambda s: (s >= 0) & (s <= 1))

    def render(self, image, params, depth):
        strength = params.strength.repeat_interleave(len(image) // len(params.strength))  # for the frames of clips
        t = vignetting(strength.to(image), height=image.shape[2], width=image.shape[3])
        return Rendered(image * t, lambda: t >= 1 / 255, transmission=t)


clean, _ = render_road_scenes(torch.tensor([29]), 216, 384)
image = Vignetting(strength_range=(0.9, 0.9)).degrade(clean, seed=0).image
angle = torch.tensor([107.5, 191.5]).norm().div(0.9 * 384).atan()
print(f"corner: {(image / clean)[0, :, 0, 0].mean():.4f}, by the formula {1 - 0.9 * (1 - angle.cos() ** 4):.4f}")
imsave([*sys.argv, "add_an_effect.png"][1], torch.cat([clean, image], dim=3)[0].movedim(0, -1).numpy())
