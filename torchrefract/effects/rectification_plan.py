"""What a rectification will compute under a tolerance."""

from functools import lru_cache

from torchrefract.cameras.models import Camera
from torchrefract.effects.lens_plan import MOST_STRETCH
from torchrefract.effects.plan import Plan, PlanRequest, coarsest
from torchrefract.fields.rectifying import rectification_errors
from torchrefract.warping.lattice import Lattice


@lru_cache(maxsize=64)
def rectification_plan(camera: Camera, ask: PlanRequest) -> Plan:
    """The plan for frames of a camera.

    Raises:
        ValueError: frames of another shape than the camera's.
    """
    if ask.tolerance_px is None:
        return ask.plan(1, 0.0, "no tolerance")
    room = ask.room()
    if camera.is_pinhole:
        return ask.plan(0, 0.0, "no coefficient is other than zero")
    resized = camera.resized(width=ask.width, height=ask.height)

    def attempt(stride: int) -> Plan | None:
        errors = rectification_errors(resized, Lattice(ask.height, ask.width, stride))
        if errors is None or errors.stretch > MOST_STRETCH or errors.cubic > room:
            return None
        return ask.plan(stride, errors.cubic + ask.rounding, "cubics between", slope=errors.slope)

    return coarsest(attempt) or ask.plan(1, 0.0, "the camera bends too much for cubics, or shows not all rays around")
