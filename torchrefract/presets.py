"""Named scenes: each says which phenomena it has, and nothing else."""

from torchrefract.effects.fog import UniformFog
from torchrefract.effects.lens import LensDistortion


def cheap_dashcam() -> LensDistortion:
    """A fleet of one cheap dashcam: a barrel lens with a small spread of decentring and tilt that folds nowhere."""
    return LensDistortion(
        k1_range=(-0.35, -0.15),
        # k2 >= 0.45 k1^2 keeps r (1 + k1 r^2 + k2 r^4) growing for every r.
        k2_range=(0.06, 0.12),
        p1_range=(-0.001, 0.001),
        p2_range=(-0.001, 0.001),
        focal_range=(0.7, 1.1),
        center_x_range=(-0.01, 0.01),
        center_y_range=(-0.01, 0.01),
    )


def cape_town_fog() -> UniformFog:
    """Morning fog off the cold sea, with 60 m to 200 m of visibility."""
    return UniformFog(visibility_range=(60.0, 200.0))
