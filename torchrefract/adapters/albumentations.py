"""Effects as transforms of Albumentations, which move masks, boxes and keypoints along."""

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import get_worker_info

from torchrefract._validation import check_choice, check_number
from torchrefract.adapters.config import effect_from_config, effect_to_config
from torchrefract.effects.base import Effect
from torchrefract.labels.boxes import warp_boxes
from torchrefract.labels.maps import warp_mask
from torchrefract.labels.points import in_frame, solve_points
from torchrefract.types import Degraded
from torchrefract.warping.implicit import sample_linear

try:
    from albumentations.core.transforms_interface import DualTransform  # pyright: ignore[reportMissingImports]  # in its own extra
    from albumentations.core.type_definitions import ALL_TARGETS  # pyright: ignore[reportMissingImports]  # in its own extra
except ModuleNotFoundError as error:
    raise ImportError('this adapter needs Albumentations: pip install "torchrefract[albumentations]"') from error

_NUM_COLUMNS = 5  # of keypoints in Albumentations: x, y, z, angle, scale; labels follow
_SAME_FLOW_PX = 1e-3


class AlbumentationsEffect(DualTransform):
    """Make an effect a transform for `albumentations.Compose`, also inside the `augmentations=[...]` of Ultralytics.

    One draw degrades all images of a call and moves all labels: `image`, `images`, `mask`, `masks`, `bboxes`,
    `keypoints`, volumes, and additional targets. Images are uint8 or floating in [0, 1].

    The seed of the draw comes from the generator of the `Compose`, so `Compose(seed=...)` and `ReplayCompose` repeat
    it. In workers of a DataLoader, a `Compose` without a seed draws anew in each worker and epoch, and no seed of
    PyTorch repeats it; one with a seed repeats its draws in each worker and epoch, as it does for all transforms.

    Boxes become the smallest boxes around the part of their warped outlines in the frame. Those that leave it go, with
    their labels, as do those below the `min_visibility` of `BboxParams`, the visible share of the warped box. Masks
    take the nearest pixel; `Compose(mask_interpolation=...)` interpolates floating ones. Angles of keypoints, measured
    from x to y, turn by the local Jacobian, and their scales grow by the root of its area ratio. Keypoints outside of
    the frame keep their position there. Those that the degraded image hides go with their labels, or become (-1, -1)
    if `KeypointParams` has no `label_fields`. The vertices of polygons are keypoints.

    Args:
        effect: the effect, or its config from `A.to_dict`.
        p: probability that a call degrades its image, beside the `p` of the effect.
        channels: "rgb", or "bgr" for images as OpenCV reads them and Ultralytics passes them; effects look for the sky
            and know the colors of fog and sun.

    Raises:
        ValueError: p or channels out of range; images of one call whose draw gives them different flows, by a depth
            that is computed from the image: degrade them one by one.
    """

    _targets = ALL_TARGETS

    def __init__(self, effect: Effect | dict[str, Any], p: float = 1.0, channels: str = "rgb"):
        super().__init__(p=check_number("p", p, low=0.0, high=1.0))
        self.channels = check_choice("channels", channels, ("rgb", "bgr"))
        self.effect = effect if isinstance(effect, Effect) else effect_from_config(effect)
        self.mask_interpolation = 0  # cv2.INTER_NEAREST; `Compose` replaces it

    def to_dict_private(self) -> dict[str, Any]:
        """Return the arguments as plain values.

        Raises:
            TypeError: an effect that plain values do not describe, see `effect_to_config`.
        """
        return {**super().to_dict_private(), "effect": effect_to_config(self.effect)}

    def get_params(self) -> dict[str, Any]:
        """Draw the seed, which determines the parameters of the effect."""
        seed, worker = int(self.random_generator.integers(2**63)), get_worker_info()
        # Each worker of each epoch gets a copy of the same generator; Ultralytics seeds them itself.
        return {"seed": seed if worker is None or self.seed is not None else seed ^ worker.seed}

    def apply_with_params(self, params: dict[str, Any], *args: Any, **kwargs: Any) -> dict[str, Any]:
        """Degrade the first image, whose flow all labels follow, then each target."""
        name, depth = next((n, d) for n, d in _IMAGES.items() if kwargs.get(n) is not None)
        image = kwargs[name]
        for _ in range(depth):
            image = image[0]
        if not isinstance(image, np.ndarray):
            got = type(image).__name__
            raise TypeError(f"{name} must be an array (H, W) or (H, W, C), got {got}; place effects before ToTensorV2")
        if depth == 0:
            kwargs[name] = image = np.ascontiguousarray(image)  # so that `apply` receives this very array
        degraded = self._degrade(image, params["seed"])
        return super().apply_with_params({**params, "source": image, "degraded": degraded}, *args, **kwargs)

    def apply(self, img: np.ndarray, *args: Any, **params: Any) -> np.ndarray:
        """Degrade an image, (H, W) or (H, W, C)."""
        degraded = params["degraded"]
        if img is not params["source"]:
            flow, degraded = degraded.flow, self._degrade(img, params["seed"])
            if flow is not None and not (flow - degraded.flow).abs().max() <= _SAME_FLOW_PX:
                raise ValueError(
                    "images of one call must have one flow, got an effect whose depth is that of the image"
                )
        return _to_array(self._swapped(degraded.image), img)

    def apply_to_mask(self, mask: np.ndarray, *args: Any, **params: Any) -> np.ndarray:
        """Warp a mask, (H, W) or (H, W, C)."""
        if (flow := _flow(params)) is None:
            return mask
        soft = self.mask_interpolation != 0 and np.issubdtype(mask.dtype, np.floating)
        return _to_array(warp_mask(_to_tensor(mask), flow, soft=soft), mask)

    def apply_to_bboxes(self, bboxes: np.ndarray, *args: Any, **params: Any) -> np.ndarray:
        """Warp boxes, (N, 4 + labels), x1, y1, x2, y2 in units of the frame."""
        if (flow := _flow(params)) is None or len(bboxes) == 0:
            return bboxes
        size = flow.new_tensor([flow.shape[2], flow.shape[1]]).repeat(2)
        corners = torch.as_tensor(bboxes[:, :4], dtype=flow.dtype) * size - 0.5
        limits = self.get_processor("bboxes")
        min_visibility = getattr(limits and limits.params, "min_visibility", 0.0)
        warped, keep = warp_boxes(corners, flow, min_visibility=min_visibility)
        moved = ((warped + 0.5) / size).clamp(0, 1).numpy().astype(bboxes.dtype)
        return np.concatenate([moved, bboxes[:, 4:]], axis=1)[keep.numpy()]

    def apply_to_keypoints(self, keypoints: np.ndarray, *args: Any, **params: Any) -> np.ndarray:
        """Warp keypoints, (N, 5 + labels), x, y and z in px, the angle in radians, and the scale."""
        if (flow := _flow(params)) is None or len(keypoints) == 0:
            return keypoints
        rows = torch.as_tensor(keypoints[:, :_NUM_COLUMNS], dtype=flow.dtype)
        (x, y), angle, scale = rows[:, :2].T, rows[:, 3], rows[:, 4]
        solution = solve_points(torch.stack([x, y], dim=1)[None], flow[None])
        is_hidden = (in_frame(solution.points, flow[None], 0.5) & ~(solution.converged & solution.upright))[0]
        points = torch.where(is_hidden[:, None], -1, solution.points[0])
        # The flow leads from the degraded image to the clean one, so directions turn by the inverse of its Jacobian.
        jacobian = sample_linear(flow[None], solution.points.mT).jacobian
        u, v = jacobian.solve(angle.cos(), angle.sin())
        turned = torch.atan2(v, u).remainder(2 * math.pi)[0, 0]
        grown = scale / jacobian.determinant.clamp(min=1e-6).sqrt()[0, 0]
        turned = torch.where(turned < 2 * math.pi, turned, 0)
        moved = torch.stack([*points.T, rows[:, 2], turned, grown], dim=1).numpy().astype(keypoints.dtype)
        moved = np.concatenate([moved, keypoints[:, _NUM_COLUMNS:]], axis=1)
        return moved[~is_hidden.numpy()] if keypoints.shape[1] > _NUM_COLUMNS else moved

    def _degrade(self, image: np.ndarray, seed: int) -> Degraded:
        return self.effect.degrade(self._swapped(_to_tensor(image)), seed=seed)

    def _swapped(self, image: Tensor) -> Tensor:
        """Return an image (C, H, W) with red and blue swapped if they are."""
        return image.flip(0) if self.channels == "bgr" and len(image) == 3 else image


_IMAGES = {"image": 0, "images": 1, "volume": 1, "volumes": 2}  # by the number of leading dimensions


def _flow(params: dict[str, Any]) -> Tensor | None:
    """Return the flow, (2, H, W), or None if labels stay where they are."""
    flow = params["degraded"].flow
    return flow if flow is not None and flow.any() else None


def _to_tensor(image: np.ndarray) -> Tensor:
    """Return (H, W) or (H, W, C) as (C, H, W)."""
    return torch.from_numpy(np.ascontiguousarray(np.atleast_3d(image))).movedim(-1, 0)


def _to_array(image: Tensor, like: np.ndarray) -> np.ndarray:
    """Return (C, H, W) in the shape of an array (H, W) or (H, W, C)."""
    return np.ascontiguousarray(image.movedim(0, -1).numpy().reshape(like.shape))
