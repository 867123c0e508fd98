"""Differentiable image degradations for road cameras, and the maps that undo them.

Effects, each an `nn.Module` from images to images; in parentheses what they show:
    LensDistortion (a lens), Turbulence (heat haze), PhysicalTurbulence (heat haze by Cn2 and depth), RoadMirage,
    ThinPlateSpline and DivergenceFree (smooth random warps), Rectification (removes the lens of a calibrated camera),
    TurbulenceBlur (what the air blurs), BlurredTurbulence (what it moves and blurs),
    RollingShutter (rows that a moving, shaking camera exposes one after the other),
    UniformFog, HeterogeneousFog, LensFlare, Vignetting (dark corners), ChromaticAberration (colored edges),
    SunGlare (the sun, its glare and ghosts, and a camera that exposes for it), Exposure (gain, noise and clipping),
    NightGlow (lamps in fog),
    Compose (several effects in order), OneOf (one of several, at random)

Presets, in `torchrefract.presets`, are effects with the parameters of a place and a severity of 1 to 5:
    cheap_dashcam, cape_town_fog, night_fog, limpopo_sun_glare, highveld_heat_haze, highveld_telephoto, unpaved_road,
    and paper_refractive and paper_weather, which draw one of several effects for each image

Depth for fog: a map in m, `CorridorDepth`, `GroundPlaneDepth`, any function of the image, or a network
(`torchrefract.depth.from_transformers`).

`effect(image)` degrades an image; `effect.degrade(image, seed=..., keys=...)` returns a `Degraded` with the flow, its
inverse, masks and the drawn parameters, and `effect.apply(image, params)` repeats a draw. `warp`, `invert_flow` and
`compose_flows` work on flows, which are backward and in pixels: out(p) = image(p + flow(p)). `worst_case` searches the
parameters of an effect that harm a model most. `pretrained` loads a network that restores the lens of a frame.

Commands, each with a `--help`: python -m torchrefract.preview, degrade, generate, train, eval, restore, export,
calibrate, rectify, make_board, estimate_lens, estimate_depth, robustness, playground, merge.
"""

import sys as _sys

if _sys.argv[:1] == ["-m"] and _sys.stderr is not None:
    # Python has this argv while `python -m torchrefract.<command>` imports the package, and torch takes seconds.
    def _show_error(kind, error, traceback):
        """Print one line for Ctrl-C, and a traceback for any other error."""
        if kind is KeyboardInterrupt:
            print("stopped", file=_sys.stderr, flush=True)
        else:
            _sys.__excepthook__(kind, error, traceback)

    _sys.excepthook = _show_error
    print("torchrefract: loading …", file=_sys.stderr, flush=True)

from torchrefract import depth as depth
from torchrefract import presets as presets
from torchrefract.cameras.camera import Camera
from torchrefract.effects.chromatic_aberration import ChromaticAberration, ChromaticAberrationParams
from torchrefract.effects.compose import Compose, ComposeParams, OneOf
from torchrefract.effects.divergence_free import DivergenceFree, DivergenceFreeParams
from torchrefract.effects.exposure import Exposure, ExposureParams
from torchrefract.effects.flare import FlareParams, LensFlare
from torchrefract.effects.fog import FogParams, UniformFog, remove_fog
from torchrefract.effects.heterogeneous_fog import HeterogeneousFog, HeterogeneousFogParams
from torchrefract.effects.lens import LensDistortion, LensParams
from torchrefract.effects.night_glow import NightGlow, NightGlowParams
from torchrefract.effects.physical_turbulence import PhysicalTurbulence, PhysicalTurbulenceParams
from torchrefract.effects.rectification import Rectification, RectificationParams
from torchrefract.effects.road_mirage import RoadMirage, RoadMirageParams
from torchrefract.effects.rolling_shutter import RollingShutter, RollingShutterParams
from torchrefract.effects.sun_glare import SunGlare, SunGlareParams
from torchrefract.effects.thin_plate import ThinPlateParams, ThinPlateSpline
from torchrefract.effects.turbulence import Turbulence, TurbulenceParams
from torchrefract.effects.turbulence_blur import BlurredTurbulence, TurbulenceBlur, TurbulenceBlurParams
from torchrefract.effects.vignetting import Vignetting, VignettingParams
from torchrefract.fields.corridor import CorridorDepth
from torchrefract.fields.depth import (
    DepthProvider,
    GroundPlaneDepth,
    LinearDepth,
    check_depth,
    depth_from_disparity,
    depth_from_inverse,
    depth_from_normalized,
    ray_distance,
)
from torchrefract.labels.boxes import warp_boxes
from torchrefract.labels.maps import warp_depth, warp_mask, warp_optical_flow
from torchrefract.labels.points import warp_points
from torchrefract.labels.targets import warp_labels
from torchrefract.random import key_of
from torchrefract.restoration.pretrained import pretrained
from torchrefract.robustness.worst_case import WorstCase, worst_case
from torchrefract.types import Degraded, Folding, Frame, Pair
from torchrefract.warping.flow import compose_flows, folding, jacobian_determinant
from torchrefract.warping.invert import invert_flow
from torchrefract.warping.warp import warp

__version__ = "0.2.0"

__all__ = [
    "BlurredTurbulence",
    "Camera",
    "ChromaticAberration",
    "ChromaticAberrationParams",
    "Compose",
    "ComposeParams",
    "CorridorDepth",
    "Degraded",
    "DepthProvider",
    "DivergenceFree",
    "DivergenceFreeParams",
    "Exposure",
    "ExposureParams",
    "FlareParams",
    "FogParams",
    "Folding",
    "Frame",
    "GroundPlaneDepth",
    "HeterogeneousFog",
    "HeterogeneousFogParams",
    "LensDistortion",
    "LensFlare",
    "LensParams",
    "LinearDepth",
    "NightGlow",
    "NightGlowParams",
    "OneOf",
    "Pair",
    "PhysicalTurbulence",
    "PhysicalTurbulenceParams",
    "Rectification",
    "RectificationParams",
    "RoadMirage",
    "RoadMirageParams",
    "RollingShutter",
    "RollingShutterParams",
    "SunGlare",
    "SunGlareParams",
    "ThinPlateParams",
    "ThinPlateSpline",
    "Turbulence",
    "TurbulenceBlur",
    "TurbulenceBlurParams",
    "TurbulenceParams",
    "UniformFog",
    "Vignetting",
    "VignettingParams",
    "WorstCase",
    "check_depth",
    "compose_flows",
    "depth_from_disparity",
    "depth_from_inverse",
    "depth_from_normalized",
    "folding",
    "invert_flow",
    "jacobian_determinant",
    "key_of",
    "pretrained",
    "ray_distance",
    "remove_fog",
    "warp",
    "warp_boxes",
    "warp_depth",
    "warp_labels",
    "warp_mask",
    "warp_optical_flow",
    "warp_points",
    "worst_case",
]
