"""Add an effect, the bands of flickering lamps: python examples/06_add_an_effect.py [PICTURE]."""

import math
import sys
from typing import NamedTuple

import torch
from matplotlib.image import imsave

from torchrefract._validation import check_range, check_values
from torchrefract.data.road_scenes import render_road_scenes
from torchrefract.effects.batch import params_to
from torchrefract.effects.photometric_effect import PhotometricEffect, Rendered


def flicker(strength: torch.Tensor, *, bands: float, height: int) -> torch.Tensor:
    """Return t = 1 - s sin^2(pi n y / H), (B, 1, H, 1), of s (B,): rows see a lamp at n half periods of the mains."""
    y = torch.arange(height).to(strength) + 0.5
    return 1 - strength.view(-1, 1, 1, 1) * torch.sin(math.pi * bands * y / height).square().view(-1, 1)


class FlickerParams(NamedTuple):
    applied: torch.Tensor  # (B,), bool: the sample is degraded
    strength: torch.Tensor  # (B,), s in [0, 1]; 1 leaves no light between two bands
    to = params_to
    is_identity = property(lambda self: self.strength == 0)


class Flicker(PhotometricEffect):
    params_type, maps = FlickerParams, ("transmission",)

    def __init__(self, *, strength_range=(0.3, 0.6), bands=3.0, tolerance=None, p=1.0):
        super().__init__(tolerance=tolerance, p=p)
        self.strength_range = check_range("strength_range", strength_range, low=0.0, high=1.0)
        self.bands = bands  # 3 at 100 flashes a second, if the camera reads its rows in 30 ms

    def sample_params(self, stream, image):
        applied, values = self.draw_in_ranges(stream, [self.strength_range], image)
        return FlickerParams(applied, values[:, 0])

    def validate(self, params, image):
        check_values("params.strength", "lie in [0, 1]", params.strength, lambda s: (s >= 0) & (s <= 1))

    def render(self, image, params, depth):
        strength = params.strength.repeat_interleave(len(image) // len(params.strength))  # for the frames of clips
        t = flicker(strength.to(image), bands=self.bands, height=image.shape[2])
        return Rendered(image * t, lambda: t >= 1 / 255, transmission=t)


clean, _ = render_road_scenes(torch.tensor([29]), 216, 384)
image = Flicker(strength_range=(0.5, 0.5)).degrade(clean, seed=0).image
expected = 1 - 0.5 * math.sin(math.pi * 3 * 36.5 / 216) ** 2
print(f"row 36: {(image / clean)[0, :, 36].mean():.4f}, by the formula {expected:.4f}")
imsave([*sys.argv, "add_an_effect.webp"][1], torch.cat([clean, image], dim=3)[0].movedim(0, -1).numpy())
