"""Scenes: effects with the parameters of a place, as a function of severity.

`severity` is 1 (barely visible), 2, 3 (typical of the place), 4 or 5 (barely anything else is visible). It sets a
physical quantity, which each scene states, so that the score of a model can be plotted over it. Other severities, and
arguments that the effects of a scene do not take, raise ValueError and TypeError.

All scenes take the same keyword arguments about the frames, so that a loop over scenes can pass them to each:

    camera: of the frames, a `Camera` or a camera file; None is unknown, with a focal length of 0.9 widths.
    horizon: its position in the frame, 0 at the top edge and 1 at the bottom edge. Dashcams point slightly upward.
    depth: a depth provider or a function from images to their depth in m, for frames without a depth map. None is a
        `CorridorDepth`, which warns that it is a guess; for the paper's scenes it is the paper's.
    width: of the frames, px; displacements are stated for a width of 1920 px and scale with it.

A scene does not depend on all of them. The others change nothing:

    cheap_dashcam       none, as it draws lenses of its own
    cape_town_fog       camera, horizon, depth
    night_fog           camera, horizon, depth
    limpopo_sun_glare   camera
    highveld_heat_haze  camera, horizon, depth, width
    highveld_telephoto  camera, horizon, depth
    unpaved_road        camera, horizon, depth, width
    paper_refractive    depth (of the turbulence), width
    paper_weather       camera, depth (of the fogs)

Scenes but the paper's also take the arguments of their effect, in place of their values here.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

from torch import Tensor

from torchrefract._validation import check_flag, check_positive
from torchrefract.cameras.camera import UNKNOWN_FOCAL, Camera, check_camera
from torchrefract.cameras.io import read_camera
from torchrefract.effects.compose import Compose, OneOf
from torchrefract.effects.divergence_free import DivergenceFree
from torchrefract.effects.exposure import Exposure
from torchrefract.effects.flare import LensFlare
from torchrefract.effects.fog import UniformFog
from torchrefract.effects.heterogeneous_fog import HeterogeneousFog
from torchrefract.effects.lens import LensDistortion
from torchrefract.effects.night_glow import NightGlow
from torchrefract.effects.physical_turbulence import PhysicalTurbulence
from torchrefract.effects.road_mirage import RoadMirage
from torchrefract.effects.rolling_shutter import RollingShutter
from torchrefract.effects.sun_glare import SunGlare
from torchrefract.effects.thin_plate import ThinPlateSpline
from torchrefract.effects.turbulence import Turbulence
from torchrefract.effects.turbulence_blur import BlurredTurbulence
from torchrefract.fields.corridor import CorridorDepth
from torchrefract.fields.depth import DepthProvider
from torchrefract.labels.vehicles import VEHICLES
from torchrefract.types import Range

SEVERITIES = (1, 2, 3, 4, 5)

_REFERENCE_WIDTH = 1920.0
_HORIZON, _SPREAD = 0.55, 0.1  # an angle that varies from car to car
_FOG_VISIBILITIES = [(500.0, 1000.0), (200.0, 500.0), (60.0, 200.0), (40.0, 60.0), (20.0, 40.0)]  # m
# Real fog by day has a mean of 0.17 to 0.2 of white in the pictures of dashcams.
_FOG_EXPOSURE: dict[str, Any] = {"target_range": (0.16, 0.24), "gamma_range": (0.7, 1.0), "max_gain": 1.0}
_NEAR_LAMP, _FAR_LAMP = 20.0, 40.0  # m, away from the camera; 3 d / V is their optical depth
_LAMP_LUMINANCE = 100.0  # times white; lamps have thousands, over which a lens spreads their light
_LOW_SUN = (1.0, 0.94, 0.82)
_TELEPHOTO_FOCAL = 4.0  # widths
_T = TypeVar("_T")
_CameraSource = Camera | str | Path | None
_DepthSource = DepthProvider | Callable[[Tensor], Tensor] | None


def cheap_dashcam(severity: int = 3, **arguments: Any) -> LensDistortion:
    """Create the lenses of a fleet of cheap dashcams: barrel distortion, slightly off center, without folds.

    Args:
        severity: 1 to 5, radial coefficient k1 of -0.03 … -0.10 at 1, -0.15 … -0.35 at 3, -0.45 … -0.60 at 5, for focal
            lengths of 0.7 to 1.1 widths. The frames are filled.
        arguments: of `LensDistortion`, and those of all scenes.
    """
    return _cheap_lens(severity, **_without_place(arguments))


def cape_town_fog(
    severity: int = 3,
    *,
    camera: _CameraSource = None,
    horizon: float = _HORIZON,
    depth: _DepthSource = None,
    exposure: bool = False,
    **arguments: Any,
) -> HeterogeneousFog | Compose:
    """Create heterogeneous morning fog, through which the car drives at 50 to 70 km/h, at 30 frames per second.

    Its color comes from the frame: that of the sky at the horizon, dark at night. See `night_fog` for lamps in it.

    Args:
        severity: 1 to 5, visibility of 500 … 1000 m at 1, 60 … 200 m at 3, 20 … 40 m at 5.
        camera, horizon, depth: as for all scenes.
        exposure: True for a camera that meters the foggy frame and darkens it, by `Exposure`: fog by day is gray in its
            pictures, not white, and the road in it is dark. The scene is then a composition.
        arguments: of `HeterogeneousFog`, and those of all scenes.
    """
    fog = _morning_fog(_at_severity(severity, _FOG_VISIBILITIES), camera, horizon, depth, arguments)
    # A camera that has opened for the night does not open further.
    return Compose([fog, Exposure(**_FOG_EXPOSURE)]) if check_flag("exposure", exposure) else fog


def night_fog(
    severity: int = 3,
    *,
    camera: _CameraSource = None,
    horizon: float = _HORIZON,
    depth: _DepthSource = None,
    glow: dict[str, Any] | None = None,
    **arguments: Any,
) -> Compose:
    """Create the fog of `cape_town_fog` at night: dark, with lamps that shine through it in a glow.

    Frames by day have the fog alone.

    Args:
        severity: 1 to 5, visibility as for `cape_town_fog`; the glow is that of lamps 20 to 40 m away.
        camera, horizon, depth: as for all scenes.
        glow: arguments of `NightGlow`.
        arguments: of `HeterogeneousFog`, and those of all scenes.
    """
    low, high = visibility = _at_severity(severity, _FOG_VISIBILITIES)
    lamps = {"linear_light": True, "lamp_luminance": _LAMP_LUMINANCE}
    of_glow: dict[str, Any] = {
        "optical_depth_range": (3 * _NEAR_LAMP / high, 3 * _FAR_LAMP / low),
        "luminance_range": (0.2 * _LAMP_LUMINANCE, 0.6 * _LAMP_LUMINANCE),
        "threshold": 0.88,  # above most white paint in the light of headlamps
        "camera": _camera(camera),
    }
    fog = _morning_fog(visibility, camera, horizon, depth, lamps | arguments)
    # The lamps that the fog leaves bright glow: fog after the glow would hide it.
    return Compose([fog, NightGlow(**of_glow | dict(glow or {}))])


def _morning_fog(
    visibility: Range, camera: _CameraSource, horizon: float, depth: _DepthSource, arguments: dict[str, Any]
) -> HeterogeneousFog:
    options: dict[str, Any] = {
        "mode": "ray",
        "visibility_range": visibility,
        "airlight": "frame",
        "contrast_range": (0.4, 0.8),
        "wind_x_range": (-0.1, 0.1),
        "wind_z_range": (-0.65, -0.45),
        "horizon": horizon,
    }
    return HeterogeneousFog(**options | _place(camera, horizon, depth) | _without_place(arguments))


def limpopo_sun_glare(severity: int = 3, *, camera: _CameraSource = None, **arguments: Any) -> SunGlare:
    """Create the glare of a low sun ahead, through a windscreen that scatters the more the dirtier it is.

    The camera darkens the frame for it, the road with it. The sun stands in the sky of the frame or above it.

    Args:
        severity: 1 to 5, share of the sun's light that is scattered: 0.5 … 1.5 % at 1, 4 … 8 % at 3, 20 … 40 % at 5.
        camera: as for all scenes.
        arguments: of `SunGlare`, and those of all scenes.
    """
    scatter = _at_severity(severity, [(0.005, 0.015), (0.015, 0.04), (0.04, 0.08), (0.08, 0.2), (0.2, 0.4)])
    options: dict[str, Any] = {"scatter_range": scatter, "color": _LOW_SUN, "camera": _camera(camera)}
    return SunGlare(**options | _without_place(arguments))


def highveld_heat_haze(
    severity: int = 3,
    *,
    camera: _CameraSource = None,
    horizon: float = _HORIZON,
    depth: _DepthSource = None,
    width: float = _REFERENCE_WIDTH,
    mirage: dict[str, Any] | None = None,
    **arguments: Any,
) -> Compose:
    """Create the air over a tarred road at noon: a mirage on the road, a shimmering horizon, and a still bonnet.

    The displacement of far things is exaggerated for a wide lens, as haze of a hot day moves them by some tenths of a
    pixel: `Turbulence.equivalent_cn2` tells by how much. See `highveld_telephoto` for what physics gives.

    Args:
        severity: 1 to 5, temperature of the air at the road above that at the camera of 5, 10, 15, 20, 30 K, and
            standard deviation of the displacement 200 m away of 0.5, 1.0, 1.5, 2.2, 3.0 px, each +-20 %, which is that
            of a Cn2 of 7.6e-11, 3e-10, 6.8e-10, 1.5e-9, 2.7e-9 m^(-2/3): 76 to 2700 times a hot day.
        camera, horizon, depth, width: as for all scenes.
        mirage: arguments of `RoadMirage`.
        arguments: of `Turbulence`.
    """
    kelvin, amplitude = _at_severity(severity, [(5.0, 0.5), (10.0, 1.0), (15.0, 1.5), (20.0, 2.2), (30.0, 3.0)])
    place = _place(camera, horizon, depth)
    options: dict[str, Any] = {"difference_range": _around(kelvin, 0.2 * kelvin), "horizon": horizon}
    options |= _focal(place["camera"]) | ({} if depth is None else {"depth": depth})
    haze = _turbulence(amplitude, width, **{"depth": place["depth"]} | arguments)
    return Compose([RoadMirage(**options | dict(mirage or {})), haze])


def highveld_telephoto(
    severity: int = 3,
    *,
    camera: _CameraSource = None,
    horizon: float = _HORIZON,
    depth: _DepthSource = None,
    blur: dict[str, Any] | None = None,
    **arguments: Any,
) -> BlurredTurbulence:
    """Create the heat haze of `highveld_heat_haze` as a camera with a long lens sees it, by its physics.

    Args:
        severity: 1 to 5, Cn2 of 1e-13, 3e-13, 1e-12, 3e-12, 1e-11 m^(-2/3), each +-50 %. 1e-12 is a hot day. The
            aperture over Fried's parameter, D / r0 at 1 km, is up to 0.25, 0.48, 0.99, 1.9, 3.9: below 1 the air blurs
            nothing that the aperture of 2 mm shows, so severities 1 to 3 are not blurred.
        camera, horizon, depth: as for all scenes; without a camera, frames have a focal length of 4 widths.
        blur: `wavelength` and `tolerance` of `BlurredTurbulence`.
        arguments: of `PhysicalTurbulence`, and those of all scenes.
    """
    cn2 = _at_severity(severity, [1e-13, 3e-13, 1e-12, 3e-12, 1e-11])
    place = _place(camera, horizon, depth, focal=_TELEPHOTO_FOCAL)
    options: dict[str, Any] = {"cn2_range": (0.5 * cn2, 1.5 * cn2), "horizon": horizon, "focal": _TELEPHOTO_FOCAL}
    options |= _focal(place["camera"]) | place
    return BlurredTurbulence(PhysicalTurbulence(**options | _without_place(arguments)), **dict(blur or {}))


def unpaved_road(
    severity: int = 3,
    *,
    camera: _CameraSource = None,
    horizon: float = _HORIZON,
    depth: _DepthSource = None,
    width: float = _REFERENCE_WIDTH,
    vehicle_labels: Sequence[int | str] | None = VEHICLES,
    dust: dict[str, Any] | None = None,
    haze: dict[str, Any] | None = None,
    shutter: dict[str, Any] | None = None,
) -> Compose:
    """Create the dust of a car ahead on a gravel road, which thins with height, seen through haze by a shaken camera.

    Args:
        severity: 1 to 5, visibility of 400 … 800 m at 1, 60 … 150 m at 3, 20 … 35 m at 5; standard deviation of the
            displacement 200 m away of 0.3, 0.8, 1.5 px, each +-20 %; time to read out a frame of 15, 25, 40 ms, and
            vibration of the pitch of 0.05, 0.12, 0.2 degrees. The car drives at 40 to 80 km/h.
        camera, horizon, depth, width: as for all scenes.
        vehicle_labels: names or numbers of the classes of vehicles, behind which the dust is thicker where the target
            of an image, or the labels of `degrade`, have boxes. Boxes of torchvision have numbers: pass those of yours.
        dust: arguments of `HeterogeneousFog`.
        haze: arguments of `Turbulence`.
        shutter: arguments of `RollingShutter`.
    """
    visibility, amplitude, readout, pitch = _at_severity(
        severity,
        [
            ((400.0, 800.0), 0.3, 15.0, 0.05),
            ((150.0, 300.0), 0.5, 20.0, 0.08),
            ((60.0, 150.0), 0.8, 25.0, 0.12),
            ((35.0, 60.0), 1.1, 33.0, 0.16),
            ((20.0, 35.0), 1.5, 40.0, 0.2),
        ],
    )
    place = _place(camera, horizon, depth)
    of_dust: dict[str, Any] = {
        "mode": "ray",
        "visibility_range": visibility,
        "airlight": "dust",
        "scales": (6.0, 12.0, 24.0, 48.0),
        "weights": (0.2, 0.3, 0.3, 0.2),
        "contrast_range": (0.7, 1.1),
        "wind_x_range": (-0.15, 0.15),
        "wind_z_range": (-0.5, -0.3),
        "decorrelation_range": (30.0, 60.0),
        "scale_height_range": (1.5, 4.0),
        "vehicle_labels": vehicle_labels,
        "horizon": horizon,
    }
    of_shutter: dict[str, Any] = {
        "speed_range": (40.0, 80.0),
        "readout_range": (readout, readout),
        "pitch_range": (0.5 * pitch, pitch),
        "yaw_range": (0.25 * pitch, 0.5 * pitch),
        "roll_range": (0.5 * pitch, pitch),
    }
    return Compose(
        [
            HeterogeneousFog(**of_dust | place | dict(dust or {})),
            _turbulence(amplitude, width, **{"depth": place["depth"]} | dict(haze or {})),
            RollingShutter(**of_shutter | place | dict(shutter or {})),
        ]
    )


def paper_refractive(
    severity: int = 3,
    *,
    camera: _CameraSource = None,
    horizon: float = _HORIZON,
    depth: _DepthSource = None,
    width: float = _REFERENCE_WIDTH,
    frame: str = "pad",
) -> OneOf:
    """Create the paper's four refractive distortions, one of them for each sample.

    Args:
        severity: 1 to 5, displacements of severity / 3 times the paper's; the lens is that of `cheap_dashcam`.
        camera, horizon: change nothing.
        depth: of the turbulence, which then moves far things more than near ones; None moves all alike, as the paper.
        width: of the frames, px.
        frame: of the lens, see `LensDistortion`. The paper's has a black border; Table 1 fills the frames.
    """
    _camera(camera)
    scale = _at_severity(severity, [1 / 3, 2 / 3, 1.0, 4 / 3, 5 / 3])
    px = check_positive("width", width) / _REFERENCE_WIDTH
    return OneOf(
        [
            _cheap_lens(severity, frame=frame),
            Turbulence(
                depth=depth,
                amplitude_range=(0.5 * scale * px, 1.5 * scale * px),
                length_range=(20.0 * px, 60.0 * px),
                aperture_range=(3.0 * px, 5.0 * px),
            ),
            ThinPlateSpline(amplitude_range=(2.0 * scale * px, 8.0 * scale * px)),
            DivergenceFree(amplitude_range=(2.0 * scale * px, 6.0 * scale * px), length_range=(40.0 * px, 100.0 * px)),
        ]
    )


def paper_weather(
    severity: int = 3,
    *,
    camera: _CameraSource = None,
    horizon: float = _HORIZON,
    depth: _DepthSource = None,
    width: float = _REFERENCE_WIDTH,
) -> OneOf:
    """Create the paper's three weather effects, one of them for each sample: uniform fog, heterogeneous fog or flare.

    Args:
        severity: 1 to 5, visibility of 300 m / severity, and light added at the sun of 0.2 severity +-0.05.
        camera: of the frames, for the distance along the rays of the fogs; None is the depth alone, as in the paper.
        horizon, width: change nothing.
        depth: of the fogs; None is the ramp over the rows of the paper, `LinearDepth`.
    """
    visibility, strength = _at_severity(severity, [(300 / s, 0.2 * s) for s in SEVERITIES])
    fog: dict[str, Any] = {"visibility_range": (visibility, visibility), "camera": _camera(camera), "depth": depth}
    return OneOf(
        [
            UniformFog(**fog),
            HeterogeneousFog(**fog),
            LensFlare(strength_range=_around(strength, 0.05)),
        ]
    )


def _camera(source: _CameraSource) -> Camera | None:
    return read_camera(source) if isinstance(source, str | Path) else check_camera(source)


def _place(
    source: _CameraSource, horizon: float, depth: _DepthSource, *, focal: float = UNKNOWN_FOCAL
) -> dict[str, Any]:
    """Return the arguments of an effect that tell the camera and the depth; `focal` is that of no camera, widths."""
    camera = _camera(source)
    if depth is None:
        depth = CorridorDepth(horizon=horizon, spread=_SPREAD, **{"focal": focal} | _focal(camera))
    return {"camera": camera, "depth": depth}


def _focal(camera: Camera | None) -> dict[str, float]:
    """Return the argument of an effect that tells the focal length, widths."""
    return {} if camera is None else {"focal": camera.fx / camera.width}


def _without_place(arguments: dict[str, Any]) -> dict[str, Any]:
    """Return the arguments of an effect, without those that all scenes take; check the camera."""
    _camera(arguments.get("camera"))
    return {name: value for name, value in arguments.items() if name not in ("camera", "horizon", "depth", "width")}


def _cheap_lens(severity: int, **arguments: Any) -> LensDistortion:
    k1, k2 = _at_severity(
        severity,
        # The slope of r (1 + k1 r^2 + k2 r^4) is at least 1 - 0.45 k1^2 / k2 >= 0.08, so that no lens is near a fold.
        [
            ((-0.10, -0.03), (0.005, 0.02)),
            ((-0.20, -0.10), (0.02, 0.05)),
            ((-0.35, -0.15), (0.06, 0.12)),
            ((-0.45, -0.35), (0.10, 0.16)),
            ((-0.60, -0.45), (0.18, 0.24)),
        ],
    )
    options: dict[str, Any] = {"k1_range": k1, "k2_range": k2, "focal_range": (0.7, 1.1)}
    return LensDistortion(**options | arguments)


def _turbulence(amplitude: float, width: float, **arguments: Any) -> Turbulence:
    px = check_positive("width", width) / _REFERENCE_WIDTH
    options: dict[str, Any] = {
        "amplitude_range": (0.8 * amplitude * px, 1.2 * amplitude * px),
        "length_range": (40.0 * px, 80.0 * px),
        "aperture_range": (4.0 * px, 6.0 * px),
        # Thermal convection moves upward.
        "wind_x_range": (-1.5 * px, 1.5 * px),
        "wind_y_range": (-3.0 * px, -1.0 * px),
    }
    return Turbulence(**options | arguments)


def _around(value: float, spread: float) -> Range:
    return value - spread, value + spread


def _at_severity(severity: int, values: Sequence[_T]) -> _T:
    if isinstance(severity, bool) or severity not in SEVERITIES:
        raise ValueError(f"severity must be one of 1, 2, 3, 4, 5, got {severity!r}")
    return values[SEVERITIES.index(severity)]
