"""Frames behind fog: by a kernel where one can, or in PyTorch."""

import math
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchrefract._compiled import SMALLEST, gradients_of, kernels, obstacle, with_gradients
from torchrefract._threads import share
from torchrefract._validation import requires_grad
from torchrefract.fields.fog import drifting_transmission_, linear_to_srgb, srgb_to_linear, veil

_LEAST = 87.0  # -ln of the smallest t that kernels tell from 0


class Ends(NamedTuple):
    """Of t: below `opaque` it counts as 0, so that the scene is not looked at, above `clear` as 1, nor is the fog."""

    opaque: float = 0.0
    clear: float = 1.0

    def within(self, least: float, most: float) -> "Ends":
        """Those that a t between two others meets."""
        return Ends(self.opaque if least < self.opaque else 0.0, self.clear if most > self.clear else 1.0)


NO_ENDS = Ends()


class Drifting(NamedTuple):
    """Fog with an extinction a n + b, n a noise, before something at a distance."""

    noise: Tensor  # (N, 1, H, W)
    scale: Tensor  # (N, 1, 1, 1), a, 1/m
    offset: Tensor  # (N, 1, 1, 1), b, 1/m
    distance: Tensor  # (N or 1, 1, H, W or 1), m


def veiled(image: Tensor, t: Tensor, airlight: Tensor, *, ends: Ends, linear: bool) -> Tensor:
    """I t + A (1 - t), exactly I where t = 1.

    Args:
        image: (N, C, H, W).
        t: (N or 1, 1, H, W or 1), in [0, 1].
        airlight: (N, C).
        ends: of t.
        linear: of linear light, not of stored values (sRGB).
    """
    # Stored values behind one t in each row, all of them read, are PyTorch's at no more than a copy.
    plain = not linear and t.shape[3] == 1 and ends.opaque == 0 and ends.clear == 1
    if plain or obstacle(image, t, airlight):
        return _in_pytorch(image, _between(t, ends), airlight, linear=linear)
    if requires_grad((t, airlight)):
        return _learning(image, _between(t, ends), airlight, linear=linear)
    through = _between(t, ends) if requires_grad((image,)) else t  # for the gradient alone
    fill = partial(_filled, _behind(t, ends, linear=linear), linear=linear)
    return _Veiled.apply(fill, linear, image, through, airlight)


def veiled_by_drifts_(
    image: Tensor, drifting: Drifting, airlight: Tensor, *, ends: Ends, linear: bool
) -> tuple[Tensor, Tensor]:
    """`veiled` with t = exp(-(a n + b) d) between the ends, and t, (N, 1, H, W), in memory of n if it has no gradient.

    Args:
        image, airlight, linear: as for `veiled`.
        drifting: n, a, b and d.
        ends: of t.
    """
    if obstacle(image, airlight, *drifting):
        t = _transmission_in_pytorch(*drifting, ends=ends)
        return _in_pytorch(image, t, airlight, linear=linear), t
    if requires_grad((*drifting, airlight)):
        t = with_gradients(partial(_transmission, ends=ends), partial(_transmission_in_pytorch, ends=ends), *drifting)
        return _learning(image, t, airlight, linear=linear), t
    noise = drifting.noise.detach().contiguous()
    fill = partial(_filled, _behind_drifts(drifting._replace(noise=noise), ends, linear=linear), linear=linear)
    return _Veiled.apply(fill, linear, image, noise, airlight), noise


def _learning(image: Tensor, t: Tensor, airlight: Tensor, *, linear: bool) -> Tensor:
    """The same numbers where t or the airlight has a gradient."""

    def kernel(image: Tensor, t: Tensor, airlight: Tensor) -> Tensor:
        return _filled(_behind(t, NO_ENDS, linear=linear), image, airlight, linear=linear)

    return with_gradients(kernel, partial(_in_pytorch, linear=linear), image, t, airlight)


def _transmission(*drifting: Tensor, ends: Ends) -> Tensor:
    """That of drifts by the kernel, before an image without channels."""
    own = Drifting(*drifting)
    t = own.noise.clone(memory_format=torch.contiguous_format)
    none = t[:, :0]
    _filled(_behind_drifts(own._replace(noise=t), ends, linear=False), none, none[:, :, 0, 0], linear=False)
    return t


def _transmission_in_pytorch(*drifting: Tensor, ends: Ends) -> Tensor:
    return _between(drifting_transmission_(*drifting), ends)


def _behind(t: Tensor, ends: Ends, *, linear: bool) -> Callable[..., None]:
    limits = np.float32(ends.clear), np.float32(ends.opaque)
    return partial(kernels("fields.kernels.veils").behind, linear, t.detach()[:, 0].contiguous().numpy(), limits)


def _behind_drifts(drifting: Drifting, ends: Ends, *, linear: bool) -> Callable[..., None]:
    """What writes t over the noise."""
    noise, *numbers, distance = (value.detach() for value in drifting)
    rows = (value.expand(len(noise), 1, 1, 1).flatten().numpy() for value in numbers)
    known = noise.view(-1).numpy(), distance[:, 0].contiguous().numpy(), *rows
    low, high = -math.log(ends.clear), -math.log(ends.opaque) if ends.opaque else _LEAST
    limits = np.float32(low), np.float32(min(high, _LEAST))
    return partial(kernels("fields.kernels.veils").behind_drifts, linear, known, limits)


def _between(t: Tensor, ends: Ends) -> Tensor:
    if ends.clear < 1:
        t = torch.where(t >= ends.clear, 1.0, t)
    return torch.where(t <= ends.opaque, 0.0, t) if ends.opaque > 0 else t


def _in_pytorch(image: Tensor, t: Tensor, airlight: Tensor, *, linear: bool) -> Tensor:
    airlight = airlight[:, :, None, None]
    if not linear:
        return veil(image, t, airlight)
    blended = linear_to_srgb(veil(srgb_to_linear(image), t, srgb_to_linear(airlight)))
    return torch.where(t == 1, image, blended)


def _filled(work: Callable[..., None], image: Tensor, airlight: Tensor, *, linear: bool) -> Tensor:
    """What a kernel makes of frames."""
    image, out = image.contiguous(), torch.empty(image.shape)
    light = torch.stack([airlight, srgb_to_linear(airlight) if linear else airlight]).numpy()
    known = image.view(-1).numpy(), tuple(image.shape[1:]), light
    rows, least, into = len(image) * image.shape[2], SMALLEST // image.shape[3] + 1, out.view(-1).numpy()
    share(lambda start, stop: work(*known, start, stop, into), rows, least=least)
    return out


class _Veiled(torch.autograd.Function):
    """What `fill` makes of an image and an airlight, with a gradient of the image, differentiable in turn."""

    @staticmethod
    def forward(
        ctx: Any, fill: Callable[..., Tensor], linear: bool, image: Tensor, t: Tensor, airlight: Tensor
    ) -> Tensor:
        ctx.linear = linear
        found = fill(image.detach(), airlight.detach())
        ctx.save_for_backward(*((image, t, airlight) if linear else (t,)))
        return found

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Any:
        if not ctx.linear:
            (t,) = ctx.saved_tensors
            return None, None, gradients[0] * t, None, None
        image, t, airlight = ctx.saved_tensors
        if torch.is_grad_enabled():  # for gradients of these
            plain = partial(_in_pytorch, linear=True)
            found = gradients_of(plain, ctx.saved_tensors, (True, False, False), gradients[0])
            return None, None, *found
        work = partial(kernels("fields.kernels.veils").slopes, t.detach()[:, 0].contiguous().numpy())
        slopes = _filled(work, image.detach(), airlight, linear=True)
        return None, None, gradients[0] * slopes, None, None
