"""Bad lenses, hot air, fog and sun as differentiable layers, and the maps that undo them.

Every effect is an `nn.Module` from images to images: `LensDistortion`, `UniformFog`. Beside `effect(image)` there is
`effect.degrade(image, seed=…, keys=…)`, which returns a `Degraded` with the flow, the flow back, masks and the drawn
parameters, and `effect.apply(image, params)`, which replays a draw. `warp`, `invert_flow` and `compose_flows` work on
flows, which are backward and in pixels: out(p) = image(p + flow(p)).
"""

from torchrefract.effects.fog import FogParams, UniformFog
from torchrefract.effects.lens import LensDistortion, LensParams
from torchrefract.types import Degraded, Frame, Pair
from torchrefract.warping.compose import compose_flows
from torchrefract.warping.invert import invert_flow
from torchrefract.warping.jacobian import Folding, folding, jacobian_determinant
from torchrefract.warping.resample import warp

__all__ = [
    "Degraded",
    "FogParams",
    "Folding",
    "Frame",
    "LensDistortion",
    "LensParams",
    "Pair",
    "UniformFog",
    "compose_flows",
    "folding",
    "invert_flow",
    "jacobian_determinant",
    "warp",
]
