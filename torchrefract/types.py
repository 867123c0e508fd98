"""Plain values that cross layers."""

from typing import NamedTuple

from torch import Tensor

Range = tuple[float, float]


class Frame(NamedTuple):
    """A clean frame, or a batch of them, before any corruption.

    image: (3, H, W) or (B, 3, H, W), float in [0, 1].
    key: () or (B,), int64, what the draw of a corruption depends on.
    depth: (1, H, W) or (B, 1, H, W), metres, inf for the sky; an empty tensor where the source knows no depth.
    """

    image: Tensor
    key: Tensor
    depth: Tensor


class Pair(NamedTuple):
    """A batch to learn a restoration from.

    degraded, clean: (B, 3, H, W), float in [0, 1].
    flow: (B, 2, H, W), px, with warp(degraded, flow) = clean; zero where the corruption moves nothing.
    valid: (B, 1, H, W), bool, the pixels that the degraded image can still give back.
    key: (B,), int64, the key that the corruption was drawn with.
    """

    degraded: Tensor
    clean: Tensor
    flow: Tensor
    valid: Tensor
    key: Tensor
