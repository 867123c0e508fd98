"""Named scenes: each says which phenomena it has, and nothing else.

`severity` runs from 1 (hardly seen) over 3 (what the place is known for) to 5 (hardly anything is seen), in a quantity
that each scene states, so that a model's score can be drawn over it.

Scenes that move pixels count in px of a frame `width` wide; give the width of yours.
"""

from collections.abc import Sequence
from typing import TypeVar

from torchrefract._validation import check_positive
from torchrefract.effects.compose import Compose
from torchrefract.effects.depth import GroundPlaneDepth
from torchrefract.effects.divergence_free import DivergenceFree
from torchrefract.effects.flare import LensFlare
from torchrefract.effects.fog import UniformFog
from torchrefract.effects.heterogeneous_fog import HeterogeneousFog
from torchrefract.effects.lens import LensDistortion
from torchrefract.effects.one_of import OneOf
from torchrefract.effects.thin_plate import ThinPlateSpline
from torchrefract.effects.turbulence import Turbulence
from torchrefract.types import Range

SEVERITIES = (1, 2, 3, 4, 5)

_REFERENCE_WIDTH = 1920.0
_DUST = (0.78, 0.71, 0.61)  # of laterite in the air
_LOW_SUN = (1.0, 0.94, 0.82)
# Dashcams point somewhat upward, and each another way.
_ROAD = GroundPlaneDepth(horizon=0.55, spread=0.1)
_Chosen = TypeVar("_Chosen")


def cheap_dashcam(severity: int = 3) -> LensDistortion:
    """A fleet of one cheap dashcam: a barrel lens with a small spread of decentring and tilt that folds nowhere.

    severity: radial coefficient k1, of a focal length of 0.7 to 1.1 widths, from -0.03 … -0.10 over -0.15 … -0.35 to
        -0.45 … -0.60.
    """
    k1, k2 = _chosen(
        severity,
        # k2 >= 0.45 k1^2 keeps r (1 + k1 r^2 + k2 r^4) growing for every r.
        [
            ((-0.10, -0.03), (0.005, 0.02)),
            ((-0.20, -0.10), (0.02, 0.05)),
            ((-0.35, -0.15), (0.06, 0.12)),
            ((-0.45, -0.35), (0.10, 0.16)),
            ((-0.60, -0.45), (0.17, 0.24)),
        ],
    )
    return LensDistortion(
        k1_range=k1,
        k2_range=k2,
        p1_range=(-0.001, 0.001),
        p2_range=(-0.001, 0.001),
        focal_range=(0.7, 1.1),
        center_x_range=(-0.01, 0.01),
        center_y_range=(-0.01, 0.01),
    )


def cape_town_fog(severity: int = 3) -> HeterogeneousFog:
    """Morning fog off the cold sea, in drifts that the car drives through at 50 to 70 km/h, at 30 frames a second.

    severity: visibility, from 500 … 1000 m over 60 … 200 m to 20 … 40 m.
    """
    visibility = _chosen(severity, [(500.0, 1000.0), (200.0, 500.0), (60.0, 200.0), (40.0, 60.0), (20.0, 40.0)])
    return HeterogeneousFog(
        mode="ray",
        visibility_range=visibility,
        depth=_ROAD,
        contrast_range=(0.4, 0.8),
        wind_x_range=(-0.1, 0.1),
        wind_z_range=(-0.65, -0.45),
    )


def limpopo_sun_glare(severity: int = 3) -> LensFlare:
    """The low sun of the dry season ahead, shining into the lens.

    severity: light added at the sun, beta, from 0.2 over the paper's 0.6 to 1.0, each +-0.05, and with it the radius of
        the flare, rho, from 0.2 over 0.3 to 0.4 diagonals of the frame, each +-0.05.
    """
    beta, rho = _chosen(severity, [(0.2, 0.2), (0.4, 0.25), (0.6, 0.3), (0.8, 0.35), (1.0, 0.4)])
    return LensFlare(strength_range=_around(beta, 0.05), radius_range=_around(rho, 0.05), color=_LOW_SUN)


def highveld_heat_haze(severity: int = 3, *, width: float = _REFERENCE_WIDTH) -> Turbulence:
    """Hot air over a tarred road at noon: edges wobble and never come to rest.

    severity: standard deviation of the displacement, from 0.5 over 1.5 to 3.0 px of a frame 1920 px wide, each +-20 %.
    """
    return _hot_air(_chosen(severity, [0.5, 1.0, 1.5, 2.2, 3.0]), width)


def unpaved_road(severity: int = 3, *, width: float = _REFERENCE_WIDTH) -> Compose:
    """The dust of the car ahead over a gravel road, and hot air before it.

    severity: visibility in the dust, from 400 … 800 m over 80 … 200 m to 25 … 50 m, and the displacement by hot air,
        from 0.3 over 0.8 to 1.5 px of a frame 1920 px wide, each +-20 %.
    """
    visibility, amplitude = _chosen(
        severity,
        [((400.0, 800.0), 0.3), ((200.0, 400.0), 0.5), ((80.0, 200.0), 0.8), ((50.0, 80.0), 1.1), ((25.0, 50.0), 1.5)],
    )
    dust = HeterogeneousFog(
        mode="ray",
        visibility_range=visibility,
        airlight=_DUST,
        depth=_ROAD,
        scales=(6.0, 12.0, 24.0, 48.0),
        weights=(0.2, 0.3, 0.3, 0.2),
        contrast_range=(0.7, 1.1),
        wind_x_range=(-0.15, 0.15),
        wind_z_range=(-0.5, -0.3),
        decorrelation_range=(30.0, 60.0),
    )
    return Compose([dust, _hot_air(amplitude, width)])


def paper_refractive(severity: int = 3, *, width: float = _REFERENCE_WIDTH) -> OneOf:
    """One of the paper's four refractive distortions for each frame.

    severity: every coefficient and displacement at severity / 3 of the effects' own ranges, in px of a frame 1920 px
        wide; the lens as in `cheap_dashcam`.
    """
    scale = _chosen(severity, [1 / 3, 2 / 3, 1.0, 4 / 3, 5 / 3])
    px = check_positive("width", width) / _REFERENCE_WIDTH
    return OneOf(
        [
            cheap_dashcam(severity),
            Turbulence(
                amplitude_range=(0.5 * scale * px, 1.5 * scale * px),
                length_range=(20.0 * px, 60.0 * px),
                aperture_range=(3.0 * px, 5.0 * px),
            ),
            ThinPlateSpline(amplitude_range=(2.0 * scale * px, 8.0 * scale * px)),
            DivergenceFree(amplitude_range=(2.0 * scale * px, 6.0 * scale * px), length_range=(40.0 * px, 100.0 * px)),
        ]
    )


def paper_weather(severity: int = 3) -> OneOf:
    """One of the paper's three weathers for each frame, with its numbers: fog, fog in drifts, or glare.

    severity: visibility of 300 m / severity, and light added at the sun of 0.2 severity +-0.05.
    """
    visibility, beta = _chosen(severity, [(300 / s, 0.2 * s) for s in SEVERITIES])
    limits = (visibility, visibility)
    return OneOf(
        [
            UniformFog(visibility_range=limits),
            HeterogeneousFog(visibility_range=limits),
            LensFlare(strength_range=_around(beta, 0.05)),
        ]
    )


def _hot_air(amplitude: float, width: float) -> Turbulence:
    px = check_positive("width", width) / _REFERENCE_WIDTH
    return Turbulence(
        amplitude_range=(0.8 * amplitude * px, 1.2 * amplitude * px),
        length_range=(40.0 * px, 80.0 * px),
        aperture_range=(4.0 * px, 6.0 * px),
        # Hot air rises.
        wind_x_range=(-1.5 * px, 1.5 * px),
        wind_y_range=(-3.0 * px, -1.0 * px),
    )


def _around(value: float, spread: float) -> Range:
    return value - spread, value + spread


def _chosen(severity: int, choices: Sequence[_Chosen]) -> _Chosen:
    if isinstance(severity, bool) or severity not in SEVERITIES:
        raise ValueError(f"severity must be one of 1, 2, 3, 4, 5, got {severity}")
    return choices[severity - 1]
