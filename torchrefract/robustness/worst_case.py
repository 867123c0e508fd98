"""The parameters of an effect, within its ranges, that harm a model most."""

from collections.abc import Callable, Sequence
from functools import reduce
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.utils import _pytree as pytree

from torchrefract import random
from torchrefract._validation import check_count, check_number, check_tensor, check_whole, type_name
from torchrefract.effects.base import Effect
from torchrefract.effects.batch import check_image, check_image_values
from torchrefract.robustness.evaluate import move_target
from torchrefract.types import Degraded

_EDGE = 2.0**-24  # uniform numbers lie in the open interval (0, 1)
_LAST_RATE = 0.1  # share of the learning rate in the last step


class WorstCase(NamedTuple):
    """The result of a search.

    params: of the effect; `effect.apply(image, params)` gives the image again.
    image: the degraded image, as the input.
    target: the labels of the degraded image; None without a target.
    loss: (B,), of each sample.
    curve: (restarts, steps, B), the loss at each step. Its first row of each restart is that of a random draw.
    """

    params: Any
    image: Tensor
    target: Any
    loss: Tensor
    curve: Tensor


def worst_case(
    loss: Callable[[Tensor, Any], Tensor],
    effect: Effect,
    image: Tensor,
    target: Any = None,
    *,
    steps: int = 20,
    restarts: int = 2,
    lr: float = 0.5,
    seed: int = 0,
    keys: Tensor | Sequence[int] | None = None,
    depth: Tensor | Callable[[Tensor], Tensor] | None = None,
) -> WorstCase:
    """Search the parameters within the ranges of an effect for which a loss is highest.

    Every parameter is a function of uniform numbers in (0, 1), those that `effect.sample` draws. Adam follows the
    gradient of the loss with respect to these numbers, which are clamped to (0, 1) after each step, so that all
    parameters stay in their ranges. Each restart begins at another draw; what has no gradient, such as the choice of
    `OneOf`, whether an effect is applied, and the noise of fog, stays as drawn. Of all steps, each sample keeps its
    worst. Needs steps * restarts + 1 calls of the loss, all but the last with a gradient.

    Args:
        loss: from the degraded image and its target to the loss of each sample, (B,), or to that of the batch, ().
            Differentiable with respect to the image.
        effect: any, with random parameters.
        image: (B, C, H, W) or (C, H, W), floating in [0, 1].
        target: labels of the image, as for `effect(image, target)`; they move along the flow of each step.
        steps: evaluations of a restart, at least 1; 1 is random search.
        restarts: number of draws to begin at, at least 1.
        lr: learning rate of the uniform numbers in the first step, in (0, 1]; it falls linearly to a tenth.
        seed, keys: of the draws, as for `effect.degrade`; restart i takes the seed `seed + i`.
        depth: as for `effect.degrade`.

    The gradients of a model in the loss stay as they are.

    Raises:
        TypeError: an image that is not floating; an effect or a seed of another type.
        ValueError: an argument out of range; an image that clearly is not in [0, 1]; an effect without random
            parameters, or a loss without a gradient.
        RuntimeError: in `torch.inference_mode`.
    """
    steps, restarts = check_count("steps", steps), check_count("restarts", restarts)
    lr, seed = check_number("lr", lr, low=1e-6, high=1.0), check_whole("seed", seed)
    if not isinstance(effect, Effect):
        raise TypeError(f"effect must be an effect of torchrefract, got {type_name(effect)}")
    if not check_tensor("image", image).is_floating_point():
        raise TypeError(f"image must be floating in [0, 1], got {image.dtype}; use image.float() / 255 for uint8")
    if torch.is_inference_mode_enabled():
        raise RuntimeError(
            "worst_case needs gradients, which torch.inference_mode disables; call it outside of it, with Lightning by "
            "Trainer(inference_mode=False)"
        )
    image = image.detach()
    check_image(image)
    check_image_values(image)
    steps_taken: list[tuple[Any, Tensor]] = []  # parameters and loss at each step
    for restart in range(restarts):
        draw = _Draw(effect, image, seed + restart, keys)
        optimizer = torch.optim.Adam(draw.numbers(), lr=lr, betas=(0.8, 0.95), maximize=True)
        for step in range(steps):
            with torch.enable_grad():
                params = draw.params()
                value = _evaluate(loss, effect, effect.apply(image, params, depth=depth), target)
            steps_taken.append((pytree.tree_map_only(Tensor, torch.Tensor.detach, params), value.detach()))
            if step < steps - 1:
                if not draw.differentiate(value):
                    raise ValueError(
                        "loss must be differentiable with respect to the degraded image, and effect must draw "
                        f"parameters, got a loss without a gradient for {type(effect).__name__}"
                    )
                for group in optimizer.param_groups:
                    group["lr"] = lr * (1 - (1 - _LAST_RATE) * step / (steps - 1))
                draw.step(optimizer)
    params, _ = reduce(_keep_worst, steps_taken)
    with torch.no_grad():
        degraded = effect.apply(image, params, depth=depth)
        value = _evaluate(loss, effect, degraded, target).detach()
    moved = move_target(target, degraded, effect)
    curve = torch.stack([value for _, value in steps_taken]).unflatten(0, (restarts, steps))
    return WorstCase(params, degraded.image, moved, value, curve)


class _Draw:
    """The uniform numbers of a draw, as leaves of the graph of its parameters."""

    def __init__(self, effect: Effect, image: Tensor, seed: int, keys: Tensor | Sequence[int] | None):
        self._effect, self._image, self._seed, self._keys = effect, image, seed, keys
        self._numbers: dict[Any, Tensor] = {}
        self.params()

    def numbers(self) -> list[Tensor]:
        """Return all numbers, each a leaf (B, n)."""
        return list(self._numbers.values())

    def params(self) -> Any:
        """Return the parameters of the numbers."""
        return self._effect.sample(self._image, seed=self._seed, keys=self._keys, substitute=self._substitute)

    def differentiate(self, value: Tensor) -> bool:
        """Set the gradients of the numbers to those of a loss (B,); return False if it depends on no number."""
        numbers = self.numbers()
        if not value.requires_grad:
            return False
        with torch.enable_grad():
            gradients = torch.autograd.grad(value.sum(), numbers, allow_unused=True)
        for number, gradient in zip(numbers, gradients, strict=True):
            number.grad = None if gradient is None else gradient.nan_to_num(0, 0, 0)
        return any(gradient is not None for gradient in gradients)

    def step(self, optimizer: torch.optim.Optimizer) -> None:
        """Take a step, and clamp the numbers to (0, 1)."""
        optimizer.step()
        with torch.no_grad():
            for number in self._numbers.values():
                number.clamp_(_EDGE, 1 - _EDGE)

    def _substitute(self, source: random.Stream, drawn: Tensor) -> Tensor:
        # The streams of different effects differ in their words or their lanes.
        words = source.words.tolist()
        name = (source.lane, drawn.shape[1], *map(tuple, words))
        if name not in self._numbers:
            self._numbers[name] = drawn.clone().requires_grad_()
        return self._numbers[name]


def _evaluate(loss: Callable[[Tensor, Any], Tensor], effect: Effect, degraded: Degraded, target: Any) -> Tensor:
    """Return the loss (B,)."""
    value = loss(degraded.image, move_target(target, degraded, effect))
    batch = len(degraded.params.applied)
    if not isinstance(value, Tensor) or value.shape not in ((), (batch,)):
        got = tuple(value.shape) if isinstance(value, Tensor) else type(value).__name__
        raise ValueError(f"loss must return a tensor of shape () or ({batch},), got {got}")
    return value.expand(batch)


def _keep_worst(best: tuple[Any, Tensor], other: tuple[Any, Tensor]) -> tuple[Any, Tensor]:
    """Choose the rows of the parameters with the higher loss."""
    is_worse = (other[1] > best[1]) | best[1].isnan()

    def choose(old: Tensor, new: Tensor) -> Tensor:
        return torch.where(is_worse.view(-1, *[1] * (new.ndim - 1)), new, old)

    return pytree.tree_map(choose, best[0], other[0]), torch.where(is_worse, other[1], best[1])
