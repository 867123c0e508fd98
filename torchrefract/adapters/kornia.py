"""Effects as augmentations of kornia, whose containers move masks, boxes and keypoints along."""

from typing import Any

import torch
from torch import Tensor

from torchrefract import random
from torchrefract._validation import type_name
from torchrefract.effects.base import Effect
from torchrefract.effects.batch import check_kornia_keys
from torchrefract.labels.boxes import warp_boxes
from torchrefract.labels.maps import warp_mask
from torchrefract.labels.points import warp_points

try:
    import kornia
    from kornia.augmentation import RigidAffineAugmentationBase2D
    from kornia.constants import Resample
    from kornia.geometry.boxes import Boxes
    from kornia.geometry.keypoints import Keypoints
except ModuleNotFoundError as error:
    raise ImportError("this adapter needs kornia: pip install kornia") from error

if tuple(map(int, kornia.__version__.split(".")[:2])) < (0, 9):
    raise ImportError(
        f"this adapter needs kornia 0.9, as labels do not follow the image in the containers of earlier versions, got "
        f"{kornia.__version__}: pip install -U kornia"
    )


class KorniaEffect(RigidAffineAugmentationBase2D):
    """Make an effect an augmentation for `kornia.augmentation.AugmentationSequential` with any `data_keys`.

    Masks take the nearest pixel, as kornia's do, or are interpolated if they are floating and `extra_args` ask for it.
    Boxes become the smallest boxes around their warped outlines, and a box that leaves the frame becomes zeros, as by
    kornia's `filter_boxes_by_area`, since a batch cannot drop one. Keypoints without a position in the degraded image
    become (-1, -1). Class labels stay. `params` replay a draw; it has no inverse, and its matrix is the identity.
    Labels come in one call with their image, whose depth may decide its flow. In a `VideoSequential` with
    `same_on_frame`, the frames of a clip have one draw, at one time.

    Args:
        effect: the effect; its own `p` decides which samples it degrades.
        same_on_batch: draw once for all samples of a batch.
        keepdim: see kornia.

    Raises:
        TypeError: effect is not one of torchrefract; a call in a container that would leave labels behind.
        ValueError: labels without their image in the same call.
    """

    def __init__(self, effect: Effect, *, same_on_batch: bool = False, keepdim: bool = False):
        super().__init__(p=1.0, same_on_batch=same_on_batch, keepdim=keepdim)
        if not isinstance(effect, Effect):
            raise TypeError(f"effect must be an effect of torchrefract, got {type_name(effect)}")
        self.effect = effect
        self._drawn: tuple[Tensor | None, Tensor | None] = None, None  # the seed and flow of the last images
        self.flags = {"resample": Resample.NEAREST}  # of masks; `extra_args` of a container replace it

    def generate_parameters(self, batch_shape: tuple[int, ...]) -> dict[str, Tensor]:
        """Draw the seed and the keys of the samples, which determine the parameters of the effect."""
        keys = torch.zeros(batch_shape[0], dtype=torch.int64) if self.same_on_batch else torch.arange(batch_shape[0])
        # A `VideoSequential` repeats each parameter along its first dimension, once for each frame.
        rows = torch.arange(batch_shape[0])
        return {"seed": torch.as_tensor(random.call_seed()).reshape(1), "keys": keys, "rows": rows}

    def compute_transformation(self, input: Tensor, params: dict[str, Tensor], flags: dict[str, Any]) -> Tensor:
        """Return identities, (B, 3, 3): no matrix describes an effect."""
        return self.identity_matrix(input)

    def apply_transform(
        self, input: Tensor, params: dict[str, Tensor], flags: dict[str, Any], transform: Tensor | None = None
    ) -> Tensor:
        """Degrade images, (B, C, H, W)."""
        degraded = self.effect.degrade(input, seed=params["seed"].reshape(-1)[:1], keys=params["keys"])
        self._drawn = params["seed"], degraded.flow
        return degraded.image

    def forward(self, input: Tensor, params: dict[str, Tensor] | None = None, **kwargs: Any) -> Tensor:
        """Degrade images; raise TypeError if the container would leave labels behind."""
        result = super().forward(input, params=params, **kwargs)
        # Containers give parameters to augmentations and to ImageSequential, but not to other modules.
        if params is None and self._drawn[1] is not None:
            check_kornia_keys("pass KorniaEffect to the container itself, or in kornia's ImageSequential")
        return result

    def apply_transform_mask(
        self, input: Tensor, params: dict[str, Tensor], flags: dict[str, Any], transform: Tensor | None = None
    ) -> Tensor:
        """Warp masks, (B, C, H, W)."""
        flow = self._flow(params, input)
        soft = Resample.get(flags.get("resample", Resample.NEAREST)) is not Resample.NEAREST
        return input if flow is None else warp_mask(input, flow, soft=soft and input.is_floating_point())

    def apply_transform_box(
        self, input: Boxes, params: dict[str, Tensor], flags: dict[str, Any], transform: Tensor | None = None
    ) -> Boxes:
        """Warp boxes."""
        flow = self._flow(params, input.data)
        if flow is None or input.data.shape[1] == 0:
            return input
        # Corners in kornia are the centers of pixels that still belong to the box.
        low, high = input.data.amin(dim=2) - 0.5, input.data.amax(dim=2) + 0.5
        corners, keep = warp_boxes(torch.cat([low, high], dim=-1), flow)
        x1, y1, x2, y2 = corners.unbind(-1)
        x1, y1, x2, y2 = x1 + 0.5, y1 + 0.5, x2 - 0.5, y2 - 0.5
        quadrilaterals = torch.stack([x1, y1, x2, y1, x2, y2, x1, y2], dim=-1).unflatten(-1, (4, 2))
        boxes = input.clone()
        boxes._data = torch.where(keep[..., None, None], quadrilaterals, 0).to(input.data.dtype)
        boxes._valid = boxes._valid & keep
        return boxes

    def apply_transform_keypoint(
        self, input: Keypoints, params: dict[str, Tensor], flags: dict[str, Any], transform: Tensor | None = None
    ) -> Keypoints:
        """Warp keypoints, (B, N, 2)."""
        flow = self._flow(params, input.data)
        if flow is None:
            return input
        points, valid = warp_points(input.data, flow)
        return Keypoints(torch.where(valid[..., None], points, -1.0), raise_if_not_floating_point=False)

    def _unchanged(self, input: Any, *args: Any, **kwargs: Any) -> Any:
        """Return labels as they are: kornia asks for them even though every sample is passed to the effect."""
        return input

    apply_non_transform_mask = apply_non_transform_box = apply_non_transform_keypoint = _unchanged

    def _flow(self, params: dict[str, Tensor], like: Tensor) -> Tensor | None:
        """Return the flow of the image, (B, 2, H, W), on the device of a label; None for a photometric effect."""
        seed, flow = self._drawn
        if seed is None or not torch.equal(seed, params["seed"]):
            raise ValueError("labels must be passed in one call with their image, whose depth may decide its flow")
        if flow is None:
            return None
        rows = params["rows"]  # of a list of masks, each comes with the parameters of its image alone
        return (flow[rows] if len(rows) < len(flow) else flow).to(like.device)
