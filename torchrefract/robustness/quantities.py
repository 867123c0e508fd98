"""The physical quantity by which a scene is stated."""

from collections.abc import Callable, Iterable
from typing import Any, NamedTuple, cast

from torch import Tensor

from torchrefract.effects.base import Effect
from torchrefract.effects.compose import Compose, OneOf
from torchrefract.effects.fog import UniformFog
from torchrefract.effects.heterogeneous_fog import HeterogeneousFog
from torchrefract.effects.lens import LensDistortion
from torchrefract.effects.physical_turbulence import PhysicalTurbulence
from torchrefract.effects.road_mirage import RoadMirage
from torchrefract.effects.sun_glare import SunGlare
from torchrefract.robustness.evaluate import Quantity
from torchrefract.types import Range

# Those of torchrefract.presets that have a quantity.
SCENES = (
    *("cheap_dashcam", "cape_town_fog", "night_fog", "limpopo_sun_glare"),
    *("highveld_heat_haze", "highveld_telephoto", "unpaved_road"),
)
_VISIBILITY = Quantity("visibility", "m", False, lambda params: params.visibility)
_OF_EFFECTS: dict[type[Effect], Quantity] = {
    UniformFog: _VISIBILITY,
    HeterogeneousFog: _VISIBILITY,
    SunGlare: Quantity("scattered sunlight", "%", True, lambda params: 100 * params.scatter),
    RoadMirage: Quantity("road hotter than air", "K", True, lambda params: params.difference),
    PhysicalTurbulence: Quantity("tilt", "microradians", True, lambda params: params.tilt),
    LensDistortion: Quantity("k1", "", False, lambda params: params.coefficients[:, 0]),
}


def quantity_of(effects: Iterable[Effect]) -> Quantity | None:
    """Return the quantity of a scene by its effects, one for each severity; a composition has that of its first part.

    A lens has one if all its draws are barrel lenses, since the sign of k1 decides which values harm more. None if no
    effect has one, if they differ, or if an effect is not always applied.
    """
    quantities = {_quantity(effect) for effect in effects}
    return quantities.pop() if len(quantities) == 1 else None


def _quantity(effect: Effect) -> Quantity | None:
    if effect.p < 1:
        return None
    if isinstance(effect, Compose) and not isinstance(effect, OneOf):
        for i, child in enumerate(cast(Iterable[Effect], effect.effects)):
            if quantity := _quantity(child):
                return quantity._replace(get=_GetOfChild(i, quantity.get))
        return None
    if isinstance(effect, LensDistortion) and (effect._source or max(cast(Range, effect.k1_range)) > 0):
        return None
    return _OF_EFFECTS.get(type(effect))


class _GetOfChild(NamedTuple):
    """Return the value of a child from the parameters of its composition."""

    child: int
    get: Callable[[Any], Tensor]

    def __call__(self, params: Any) -> Tensor:
        return self.get(params.children[self.child])
