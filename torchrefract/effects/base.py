"""The base class of all effects: parameters drawn by key, then a deterministic and differentiable degradation."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Any, cast
from weakref import WeakKeyDictionary

import torch
from torch import Tensor, nn
from torch.utils import _pytree as pytree

from torchrefract import random
from torchrefract._tensor import without_autocast
from torchrefract._validation import (
    check_count,
    check_number,
    check_range,
    check_values,
    check_whole,
    eager_values,
    is_whole,
    requires_grad,
)
from torchrefract.effects.batch import (
    BatchShape,
    check_applied,
    check_depth_fits,
    check_frames,
    check_image,
    check_image_values,
    check_kornia_keys,
    first_frames,
    fix_frame_size,
    frame_numbers,
    from_batch,
    is_foreign_image,
    params_at_frames,
    promote_params,
    to_batch,
    uses_boxes,
    with_vehicles,
)
from torchrefract.fields.depth import DepthSource, depth_of
from torchrefract.labels.plain_values import name_of
from torchrefract.labels.targets import is_tv_tensor, warp_moved_labels, wrap_like
from torchrefract.labels.vehicles import LabeledBoxes, boxes_of_target
from torchrefract.types import Degraded, Range
from torchrefract.warping.grid import field_dtype

# Shapes and types of images whose values were checked, by effect: a call stores nothing on the module.
_CHECKED_SHAPES: WeakKeyDictionary[nn.Module, set[Any]] = WeakKeyDictionary()
_MAX_CHECKED_SHAPES = 64
_IMAGE_NAMES = ("image", "images", "img", "imgs", "pixel_values")  # of the image in a sample that is a dict


class Effect(nn.Module, ABC):
    """A degradation of images.

    Images are (B, C, H, W) or (C, H, W), floating in [0, 1] or uint8, and come back with the same shape, type and
    memory format. A sample that the effect leaves alone comes back bit for bit.

    Clips are (B, T, C, H, W), or a torchvision `Video`, (T, C, H, W). A clip is one sample: its drawn parameters hold
    for all frames, fields of turbulence and fog move from frame to frame, and frame t alone, with the same seed and key
    and `frame=t`, equals frame t of the clip.

    Subclasses implement `sample_params`, `validate`, and `degrade_batch` or what `WarpEffect` and `PhotometricEffect`
    make of it.

    Args:
        p: probability that a sample is degraded, in [0, 1].

    Attributes:
        labels_getter: what `effect(image, target)` removes together with boxes that leave the frame, see `warp_labels`;
            set it to a function of the arguments, as for `SanitizeBoundingBoxes` of torchvision, (image, target) or one
            sample. Of a batch, the function takes the target of each image.
    """

    params_type: type[Any]
    labels_getter: str | Callable[[Any], Any] | None = "default"
    depth: DepthSource | None = None  # of frames without a depth map; None for an effect that depends on no depth

    def __init__(self, *, p: float = 1.0):
        super().__init__()
        self.p = check_number("p", p, low=0.0, high=1.0)

    def __init_subclass__(cls, **kwargs: Any):
        """Let `torch.load` read saved parameters with its default `weights_only=True`."""
        super().__init_subclass__(**kwargs)
        if "params_type" in vars(cls):
            torch.serialization.add_safe_globals([cls.params_type])

    def forward(self, image: Any, *target: Any) -> Any:
        """Degrade an image by a draw that the global torch generator seeds, and move its labels along.

        `effect(image)`, `effect(image, target)`, `effect(image, boxes, labels)` and one sample, a dict, list or tuple
        with the image in it, work as in torchvision's transforms. The image of a sample is its torchvision `Image` or
        `Video` or, if it has neither, its first plain tensor. A list of images raises ValueError.

        Args:
            image: as for the class, or a sample.
            target: any nesting of torchvision tv_tensors and plain values; see `warp_labels` for what moves and what
                raises, and `labels_getter` for what is removed together with boxes. A batch of images takes a list of
                targets. Photometric effects leave labels as they are; dust with `vehicle_labels` is thicker behind the
                vehicles among the boxes.

        Returns:
            What was passed, in the same nesting, with the degraded image and the moved labels. A mask is 0 where the
            degraded image shows nothing of the clean one; `degrade` and `warp_labels` with `mask_fill` give another id.
        """
        if target:
            result, degraded = self._degrade_like(image, target)
            return result, *self._move_labels(target, degraded.flow, (image, *target))
        if isinstance(image, Tensor):
            result, degraded = self._degrade_like(image, ())
            if degraded.has("flow"):
                check_kornia_keys()
            return result
        pairs, spec = pytree.tree_flatten_with_path(image)
        leaves = [leaf for _, leaf in pairs]
        place = _find_image(leaves, [name_of(path) for path, _ in pairs])
        result, degraded = self._degrade_like(leaves[place], (image,))
        marker = torch.empty((), dtype=torch.float32, device="cpu")  # stands for the image, which is not a label
        (moved,) = self._move_labels(
            (pytree.tree_unflatten([*leaves[:place], marker, *leaves[place + 1 :]], spec),), degraded.flow, image
        )
        return pytree.tree_map(lambda leaf: result if leaf is marker else leaf, moved)

    def _degrade_like(self, image: Any, targets: tuple[Any, ...]) -> tuple[Tensor, Degraded]:
        """Return the degraded image in the torchvision type of the image, and with its maps."""
        boxes = self._boxes(image, targets) if targets and uses_boxes(self) else ()
        if boxes:
            self._check_values(image)
            degraded = self.apply(image, with_vehicles(self, self.sample(image), boxes))
        else:
            degraded = self.degrade(image)
        is_tv = is_tv_tensor(image, "Image", "Video")
        return wrap_like(degraded.image, image) if is_tv else degraded.image, degraded

    def _boxes(self, image: Any, targets: tuple[Any, ...]) -> list[LabeledBoxes]:
        """Return the boxes in the target of each image; none for clips, whose boxes are not of one frame."""
        if not isinstance(image, Tensor) or is_tv_tensor(image, "Video") or image.ndim not in (3, 4):
            return []
        size = image.shape[-2:]
        if image.ndim == 3:
            return [boxes_of_target(targets, size=size)]
        if all(type(target) in (list, tuple) and len(target) == len(image) for target in targets):
            return [boxes_of_target(sample, size=size) for sample in zip(*targets, strict=True)]
        if len(boxes_of_target(targets, size=size).boxes):
            raise ValueError(f"target must be a list of {len(image)} samples, one for each image, if it holds boxes")
        return []

    def _move_labels(self, targets: tuple[Any, ...], flow: Tensor | None, inputs: Any) -> tuple[Any, ...]:
        """Return the targets of an image, or of a batch of images, that moved along its flow."""
        if flow is None:
            return targets
        if flow.ndim == 5:
            raise TypeError("target must be None for a batch of clips: warp_labels moves the target of each clip")
        getter = self.labels_getter
        if flow.ndim == 3:
            of_inputs = (lambda _: getter(inputs)) if callable(getter) else getter
            return (
                (warp_moved_labels(targets[0], flow, of_inputs),)
                if len(targets) == 1
                else warp_moved_labels(targets, flow, of_inputs)
            )
        if len(targets) == 1:
            return (warp_moved_labels(targets[0], flow, getter),)
        # Labels of a batch are lists, one entry for each image, as the targets are.
        for target in targets:
            if type(target) not in (list, tuple) or len(target) != flow.shape[0]:
                raise TypeError(
                    f"target must be lists of {flow.shape[0]} entries, one for each image, got {type(target).__name__}"
                )
        moved = warp_moved_labels(list(zip(*targets, strict=True)), flow, getter)
        return tuple(map(list, zip(*moved, strict=True)))

    def degrade(
        self,
        image: Tensor,
        *,
        seed: int | Tensor | None = None,
        keys: Tensor | Sequence[int] | None = None,
        depth: Tensor | Callable[[Tensor], Tensor] | None = None,
        frame: float | Tensor = 0,
    ) -> Degraded:
        """Degrade an image and return it with its flow, masks, maps and drawn parameters.

        Args:
            image: (B, C, H, W) or (C, H, W), floating in [0, 1] or uint8; clips, (B, T, C, H, W).
            seed: of the draw; None takes one from the global torch generator.
            keys: (B,), integers: sample i depends on (seed, keys[i]) alone; None counts from 0.
            depth: (B, 1, H, W) or (1, H, W), m, for effects that need it; for clips (B, T, 1, H, W), or
                (B, 1, 1, H, W) if it is the same in all frames. Or a function from images (N, C, H, W), floating, all
                frames of clips in one batch, to their depth (N, 1, H, W), such as `depth.from_transformers` returns.
            frame: number of the image in its clip, or of the first frame of a clip, in [-1e9, 1e9]; a number or (B,).

        Raises:
            ValueError, TypeError: an invalid argument; a floating image that clearly is not in [0, 1], see
                `check_image_values`.
        """
        shape = check_image(image)
        self._check_values(image)
        image = fix_frame_size(image)
        params = self._draw(image, shape, seed, keys, 0, frame)
        return self._degrade(image, shape, params, depth)

    def sample(
        self,
        image: Tensor,
        *,
        seed: int | Tensor | None = None,
        keys: Tensor | Sequence[int] | None = None,
        place: int = 0,
        frame: float | Tensor = 0,
        substitute: Callable[[random.Stream, Tensor], Tensor] | None = None,
    ) -> Any:
        """Draw parameters for an image, a NamedTuple of tensors.

        Args:
            image, seed, keys, frame: as for `degrade`.
            place: position in a pipeline.
            substitute: returns other uniform numbers than the drawn ones, see `random.Stream`.
        """
        shape, image = check_image(image), fix_frame_size(image)
        return self._draw(image, shape, seed, keys, place, frame, substitute)

    def apply(  # pyright: ignore[reportIncompatibleMethodOverride]  # nn.Module uses this name; both uses work
        self,
        image: Any,
        params: Any = None,
        *,
        depth: Tensor | Callable[[Tensor], Tensor] | None = None,
        frame: float | Tensor | None = None,
    ) -> Any:
        """Degrade an image with given parameters, such as those of an earlier draw -> Degraded.

        Floating parameters of a smaller type than the flow are converted. With a function as the only argument this is
        `nn.Module.apply`, so that an effect works inside a model.

        Args:
            image, depth: as for `degrade`.
            params: of `params_type`, with B rows.
            frame: number of the (first) frame, for the same draw at another time; None keeps that of `params`.

        Raises: as for `degrade` and `check_params`.
        """
        if params is None and callable(image) and not isinstance(image, Tensor):
            return super().apply(cast(Callable[[nn.Module], None], image))
        shape, image = check_image(image), fix_frame_size(image)
        self.check_params(params, first_frames(image, shape))
        params = promote_params(params, field_dtype(image.dtype))
        if frame is not None:
            params = params_at_frames(params, frame_numbers(frame, image, shape))
        return self.for_params(params, *image.shape[-2:])._degrade(image, shape, params, depth)

    def for_params(self, params: Any, height: int, width: int) -> "Effect":
        """Return an effect whose plan covers given parameters: itself, or one without a tolerance."""
        return self

    def plan(self, height: int, width: int, *, dtype: torch.dtype = torch.float32) -> Any:
        """Return how the effect is computed under its tolerance; `print` shows it as a table.

        Args:
            height, width: px, of the frame.
            dtype: of the image.

        Raises:
            ValueError: a side below 1; a tolerance below the rounding of positions in such a frame.
        """
        check_count("height", height)
        check_count("width", width)
        return self.plan_for_dtype(height, width, field_dtype(dtype))

    @abstractmethod
    def plan_for_dtype(self, height: int, width: int, dtype: torch.dtype) -> Any:
        """Return the plan for flows or maps of a type, from the ranges alone."""

    @property
    def keeps_uint8(self) -> bool:
        """Return True if `degrade_batch` accepts uint8 images as they are."""
        return False

    @abstractmethod
    def sample_params(self, stream: random.Stream, image: Tensor) -> Any:
        """Draw parameters for images (B, C, H, W) from the random streams of the samples; a `frame` is 0."""

    @abstractmethod
    def validate(self, params: Any, image: Tensor) -> None:
        """Raise ValueError for invalid parameters, as far as reading them costs no wait for a device."""

    @abstractmethod
    def degrade_batch(self, image: Tensor, params: Any, depth: Tensor | None) -> Degraded:
        """Degrade images (N, C, H, W), floating or uint8 if `keeps_uint8`, with valid parameters of B samples."""

    def active(self, params: Any) -> Tensor:
        """Return (B,), bool: the samples that change."""
        return params.applied & ~params.is_identity

    def may_change(self, params: Any) -> bool:
        """Return False if no sample changes; True if one does, if that cannot be read, or if gradients are needed."""
        active = self.active(params)
        return len(active) > 0 and (eager_values(active.any, of=active) is not False or requires_grad(params))

    def check_params(self, params: Any, image: Tensor) -> None:
        """Raise unless these are valid parameters of this effect for images (B, C, H, W).

        Raises:
            TypeError: not of `params_type`.
            ValueError: another batch size, NaN, or values that `validate` rejects.
        """
        if not isinstance(params, self.params_type):
            raise TypeError(f"params must be {self.params_type.__name__}, got {type(params).__name__}")
        for name, value in zip(params._fields, params, strict=True):
            if name == "children" or (value is None and name in params._field_defaults):
                continue  # a composition checks the parameters of its effects in `validate`
            if not isinstance(value, Tensor) or value.ndim == 0 or value.shape[0] != image.shape[0]:
                got = tuple(value.shape) if isinstance(value, Tensor) else type(value).__name__
                raise ValueError(f"params.{name} must have one row for each of the {image.shape[0]} images, got {got}")
            if value.is_floating_point():
                # Some parameters, as a visibility, may be infinite; `validate` decides.
                check_values(f"params.{name}", "not be NaN", value, lambda v: ~v.isnan())
        check_applied(params.applied, len(image))
        self.validate(params, image)

    def draw_in_ranges(self, stream: random.Stream, ranges: Sequence[Range], image: Tensor) -> tuple[Tensor, Tensor]:
        """Draw `applied`, (B,), bool, with probability `p`, and a uniform value in each of n ranges, (B, n)."""
        values = random.uniform_in_ranges(stream, [(0.0, 1.0), *ranges], dtype=field_dtype(image.dtype))
        return values[:, 0].float() < self.p, values[:, 1:]

    def _set_ranges(self, ranges: Mapping[str, Range], bounds: Mapping[str, Range]) -> None:
        """Set the attribute `<name>_range` for each name, after a check against the bounds of the name."""
        for name, value in ranges.items():
            low, high = bounds[name]
            setattr(self, f"{name}_range", check_range(f"{name}_range", value, low=low, high=high))

    def _range(self, name: str) -> Range:
        return getattr(self, f"{name}_range")

    def extra_repr(self) -> str:
        """Show the arguments in the representation of the module."""
        return ", ".join(
            f"{name}={value}" for name, value in vars(self).items() if name[0] != "_" and name != "training"
        )

    def _check_values(self, image: Tensor) -> None:
        """Check the range of the first image of each shape, but not of one that a network with gradients computed."""
        if torch.compiler.is_compiling() or not image.is_floating_point() or image.requires_grad:
            return
        checked = _CHECKED_SHAPES.setdefault(self, set())
        kind = (image.shape, image.dtype)
        if kind not in checked and not check_image_values(image):
            if len(checked) >= _MAX_CHECKED_SHAPES:
                checked.clear()
            checked.add(kind)

    def _draw(
        self,
        image: Tensor,
        shape: BatchShape,
        seed: int | Tensor | None,
        keys: Tensor | Sequence[int] | None,
        place: int,
        frame: float | Tensor,
        substitute: Callable[[random.Stream, Tensor], Tensor] | None = None,
    ) -> Any:
        seed = random.call_seed() if seed is None else _check_seed(seed)
        stream = random.stream(seed, _check_keys(keys, shape.batch), device=image.device)
        params = self.sample_params(stream._replace(lane=place, substitute=substitute), first_frames(image, shape))
        if not isinstance(frame, Tensor) and frame == 0 and shape.frames == 1:
            return params  # the frame numbers that were drawn
        return params_at_frames(params, frame_numbers(frame, image, shape))

    def _degrade(
        self, image: Tensor, shape: BatchShape, params: Any, depth: Tensor | Callable[[Tensor], Tensor] | None
    ) -> Degraded:
        batch = to_batch(image, keep_uint8=self.keeps_uint8)
        check_frames(params, shape)
        if depth is not None and not isinstance(depth, Tensor) and callable(depth):
            given = depth_of(depth, to_batch(image), field_dtype(image.dtype))
            depth = given.expand(len(batch), 1, *batch.shape[2:])
        elif depth is not None:
            depth = check_depth_fits(depth, image, shape)
        with without_autocast(image.device):  # it would compute matrix products in half, and positions need float32
            result = self.degrade_batch(batch, params, depth)
        result.image = from_batch(result.image, image, batch)
        return result if image.ndim == 4 and not shape.is_clip else result.map(shape.restore)


def _find_image(leaves: list[Any], names: list[str]) -> int:
    """Return the index of the image among the leaves of a sample, whose names are those in their dict."""
    images = [k for k, leaf in enumerate(leaves) if is_tv_tensor(leaf, "Image", "Video")]
    if len(images) > 1:
        raise ValueError(
            f"image must be the only Image or Video of a sample, got {len(images)}; pass it as the first argument"
        )
    # `check_image` raises for pictures of Pillow and arrays, which torchvision would take for the image too.
    plain = [k for k, leaf in enumerate(leaves) if type(leaf) in (Tensor, nn.Parameter) or is_foreign_image(leaf)]
    if not images + plain:
        raise TypeError("image must be a tensor, or a sample with an Image of torchvision in it, got none")
    place = (images + plain)[0]
    named = [k for k in plain if names[k] in _IMAGE_NAMES]
    if not images and named and place not in named:
        raise ValueError(
            f"image must be the first tensor of a sample, or an Image of torchvision, got {names[place]!r} before "
            f"{names[named[0]]!r}; wrap it as tv_tensors.Image(...)"
        )
    alike = [k for k in plain if names[k] == names[place] and _looks_alike(leaves[k], leaves[place])]
    if not images and len(alike) > 1:
        raise ValueError(
            f"image must be the only image of a sample, got {len(alike)} tensors such as {tuple(leaves[place].shape)}; "
            "stack images of one size, call the effect for each image, or pass other tensors after the image"
        )
    return place


def _looks_alike(value: Any, image: Any) -> bool:
    """Return True for tensors (C, H, W) of one type and number of channels, as in the list of a detector's images."""
    is_tensor = isinstance(value, Tensor) and isinstance(image, Tensor)
    return is_tensor and value.ndim == 3 and value.dtype is image.dtype and value.shape[:1] == image.shape[:1]


def _check_seed(seed: int | Tensor) -> int | Tensor:
    if not isinstance(seed, Tensor):
        return check_whole("seed", seed)
    if not is_whole(seed):
        raise TypeError(f"seed must be a whole number, got {seed.dtype}")
    if seed.numel() != 1:
        raise ValueError(f"seed must be one number, got shape {tuple(seed.shape)}")
    return seed.reshape(())


def _check_keys(keys: Tensor | Sequence[int] | None, batch: int) -> Tensor | range:
    if keys is None:
        return range(batch)
    if not isinstance(keys, Tensor):
        try:
            # An empty list has no type of its own.
            keys = torch.as_tensor(keys, dtype=None if len(keys) else torch.int64, device="cpu")
        except (TypeError, ValueError, RuntimeError) as error:
            raise TypeError(
                f"keys must be a list of whole numbers in [-2^63, 2^63), one for each of the {batch} images, got "
                f"{keys!r:.60}; torchrefract.key_of gives that of a name"
            ) from error
    if not is_whole(keys):
        raise TypeError(f"keys must be whole numbers, got {keys.dtype}")
    if keys.reshape(-1).shape[0] != batch or keys.ndim > 1:
        raise ValueError(f"keys must have one key for each of the {batch} images, got shape {tuple(keys.shape)}")
    return keys.reshape(-1)
