"""The effects that several scripts time."""

from collections.abc import Callable, Mapping
from functools import partial

from torchrefract import (
    Compose,
    DivergenceFree,
    GroundPlaneDepth,
    HeterogeneousFog,
    LensDistortion,
    LensFlare,
    ThinPlateSpline,
    Turbulence,
    UniformFog,
)
from torchrefract.effects.base import Effect
from torchrefract.effects.lattice_warp import LatticeWarp

TOLERANCE_PX = 0.05
LENS, PLATE, AIR, SWIRLS, HOT_AIR = "mild lens", "thin plate", "Gaussian air", "swirls", "hot air"
_exact = partial(partial, tolerance_px=None)
FOG, DRIFTS, SPACE, FLARE = "fog", "drifts of fog", "fog in space", "flare"
# Flows that are smooth enough for a lattice, exact; to be called with `tolerance_px` and other arguments of a warp.
SMOOTH: Mapping[str, Callable[..., LatticeWarp]] = {
    LENS: _exact(LensDistortion, k1_range=(-0.25, -0.25), k2_range=(0.09, 0.09), focal_range=(0.9, 0.9)),
    PLATE: _exact(ThinPlateSpline),
    AIR: _exact(Turbulence, covariance="gaussian", length_range=(40.0, 60.0)),
    SWIRLS: _exact(DivergenceFree, length_range=(40.0, 60.0)),
}
# Of exponential covariance, as `presets.highveld_heat_haze` has it, likewise.
ROUGH: Mapping[str, Callable[..., LatticeWarp]] = {
    HOT_AIR: _exact(Turbulence, amplitude_range=(1.2, 1.8), length_range=(40.0, 80.0), aperture_range=(4.0, 6.0)),
}
WEATHER: Mapping[str, Callable[..., Effect]] = {
    FOG: UniformFog,
    DRIFTS: HeterogeneousFog,
    SPACE: partial(HeterogeneousFog, mode="ray", depth=GroundPlaneDepth()),
    FLARE: LensFlare,
}


def effects(tolerance_px: float | None = TOLERANCE_PX) -> dict[str, Effect]:
    """The smooth warps within a tolerance, and the weather, by name."""
    warps = {name: make(tolerance_px=tolerance_px) for name, make in SMOOTH.items()}
    return {**warps, **{name: make() for name, make in WEATHER.items()}}


def all_warps(count: int = len(SMOOTH), *, tolerance_px: float | None = None) -> Compose:
    """The first few of the smooth warps, in one look-up, their composite within a tolerance."""
    warps = [make(tolerance_px=tolerance_px) for make in list(SMOOTH.values())[:count]]
    return Compose(warps, tolerance_px=tolerance_px)
