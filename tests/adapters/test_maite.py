"""Effects as augmentations of MAITE."""

from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from torchvision import tv_tensors

import torchrefract as tr
from torchrefract.adapters.maite import MaiteAugmentation
from torchrefract.effects.base import Effect
from torchrefract.random import key_of

H, W = 96, 128
LENS = tr.LensDistortion(k1_range=(-0.35, -0.2), k2_range=(0.12, 0.12), focal_range=(0.65, 0.65), padding="border")
BULGE = tr.LensDistortion(k1_range=(0.4, 0.4), k2_range=(0, 0), focal_range=(0.7, 0.7), frame="pad")
CHAIN = tr.Compose([tr.ThinPlateSpline(), tr.UniformFog(), LENS, tr.Turbulence(amplitude_range=(2, 2))])
# Of pixel edges in px; the second one leaves the frame of `BULGE`.
BOXES = np.array([[30.0, 20, 60, 50], [0, 0, 4, 4], [60, 40, 128, 96], [5, 60, 40, 90]], np.float32)
SIZES: Any = {"format": "XYWH", "canvas_size": (H, W)}
XYWH = tv_tensors.BoundingBoxes(torch.tensor([[30.0, 20, 60, 50]]).repeat(4, 1), **SIZES)


@dataclass
class Detections:
    """A target of a data set."""

    boxes: Any
    labels: Any
    scores: Any


def pictures(count: int = 3) -> list[np.ndarray]:
    return [*np.random.default_rng(0).integers(0, 256, (count, 3, H, W), np.uint8)]


def detections() -> Detections:
    return Detections(BOXES.copy(), np.arange(4), np.array([0.9, 0.8, 0.7, 0.6], np.float32))


def batch(count: int = 3) -> tuple[list[Any], list[Any], list[Any]]:
    return pictures(count), [detections() for _ in range(count)], [{"id": i, "hour": 7 + i} for i in range(count)]


@pytest.mark.quick
@pytest.mark.parametrize("effect", [LENS, BULGE, CHAIN], ids=["lens", "bulge", "chain"])
def test_images_and_boxes_are_the_native_ones_of_the_key_of_the_id(effect):
    given = batch()
    images, targets, metadata = MaiteAugmentation(effect, seed=5)(given)
    assert len(images) == len(targets) == len(metadata) == 3
    for i, (image, target) in enumerate(zip(images, targets, strict=True)):
        native = effect.degrade(torch.from_numpy(given[0][i]), seed=5, keys=[key_of(str(i))])
        boxes, keep = tr.warp_boxes(torch.from_numpy(BOXES) - 0.5, native.flow)
        assert type(image) is np.ndarray
        assert np.array_equal(image, native.image.numpy())
        assert np.array_equal(target.boxes, (boxes + 0.5)[keep].numpy())
        assert target.labels.tolist() == [label for label in range(4) if keep[label]]
        assert np.array_equal(target.scores, given[1][i].scores[keep.numpy()])
    assert np.array_equal(given[0], pictures())  # the batch itself stays
    assert np.array_equal(given[1][0].boxes, BOXES)


def test_boxes_that_leave_the_frame_go_with_their_labels_and_scores_of_each_class():
    target = Detections(BOXES, np.array([[7], [8], [9], [10]]), np.eye(4))
    _, (moved,), _ = MaiteAugmentation(BULGE)((pictures(1), [target], [{"id": "a"}]))
    assert moved.boxes.shape == (3, 4)
    assert moved.labels.tolist() == [[7], [9], [10]]
    assert np.array_equal(moved.scores, np.eye(4)[[0, 2, 3]])


def test_a_draw_does_not_depend_on_its_batch_and_is_repeated_by_its_metadata():
    augmentation = MaiteAugmentation(CHAIN, seed=3, id="rain of Pretoria")
    images, _, metadata = augmentation(batch())
    given = batch()
    (alone,), _, _ = augmentation((given[0][2:], given[1][2:], given[2][2:]))
    assert np.array_equal(alone, images[2])
    assert metadata[2] == {"id": 2, "hour": 9, "rain of Pretoria": {"seed": 3, "key": key_of("2")}}
    draw = metadata[2][augmentation.metadata["id"]]
    again = CHAIN.degrade(torch.from_numpy(pictures()[2]), seed=draw["seed"], keys=[draw["key"]])
    assert np.array_equal(again.image.numpy(), images[2])
    other, _, _ = MaiteAugmentation(CHAIN, seed=4)(batch())
    assert not np.array_equal(other[2], images[2])
    assert MaiteAugmentation(CHAIN).metadata == {"id": "torchrefract.Compose"}


@pytest.mark.parametrize("dtype", [np.uint8, np.float32, np.float64])
@pytest.mark.parametrize("as_tensors", [False, True])
def test_arrays_stay_arrays_and_tensors_stay_tensors_of_their_type(dtype, as_tensors):
    image = pictures(1)[0] if dtype is np.uint8 else (pictures(1)[0] / 255).astype(dtype)
    values = [image, BOXES.astype(np.float64), np.arange(4), np.ones(4)]
    given, boxes, labels, scores = [torch.from_numpy(v) for v in values] if as_tensors else values
    target = Detections(boxes, labels, scores)
    (out,), (moved,), _ = MaiteAugmentation(LENS)(([given], [target], [{"id": 0}]))
    for value, expected in ((out, given), (moved.boxes, boxes), (moved.labels, labels), (moved.scores, scores)):
        assert type(value) is type(expected)
        assert value.dtype == expected.dtype
    assert out.shape == given.shape


def test_arrays_that_are_read_only_flipped_or_whole_numbers_work():
    image = pictures(1)[0]
    flipped = image[:, :, ::-1]
    fixed = image.copy()
    fixed.setflags(write=False)
    target = Detections(BOXES.astype(np.int64).tolist(), [3, 4, 5, 6], [1.0] * 4)
    images, (moved, _), _ = MaiteAugmentation(BULGE)(([fixed, flipped], [target] * 2, [{"id": 0}, {"id": 1}]))
    expected = BULGE.degrade(torch.from_numpy(flipped.copy()), seed=0, keys=[key_of("1")])
    assert np.array_equal(images[1], expected.image.numpy())
    boxes, keep = tr.warp_boxes(
        torch.from_numpy(BOXES) - 0.5, BULGE.degrade(torch.from_numpy(image), seed=0, keys=[key_of("0")]).flow
    )
    assert np.allclose(moved.boxes, (boxes + 0.5)[keep], atol=1e-5)  # not rounded
    assert moved.labels.tolist() == [3, 5, 6]


@pytest.mark.parametrize("shape", [(0, 4), (0,)])
def test_a_picture_without_boxes_keeps_none(shape):
    empty = Detections(np.zeros(shape), np.zeros(0, int), np.zeros(0))
    _, (moved,), _ = MaiteAugmentation(LENS)((pictures(1), [empty], [{"id": 0}]))
    assert (moved.boxes.shape, moved.labels.shape, moved.scores.shape) == ((0, 4), (0,), (0,))


def test_targets_of_classification_and_of_effects_without_a_flow_stay():
    classes = [np.array([0.0, 1, 0]), torch.tensor([1.0, 0, 0]), [0, 1]]
    images, targets, _ = MaiteAugmentation(LENS)((pictures(), classes, [{"id": i} for i in range(3)]))
    assert not np.array_equal(images, pictures())
    assert all(target is given for target, given in zip(targets, classes, strict=True))
    given = batch()
    images, targets, _ = MaiteAugmentation(tr.UniformFog())(given)
    assert not np.array_equal(images, pictures())
    assert all(target is before for target, before in zip(targets, given[1], strict=True))


def test_a_draw_that_is_off_keeps_the_boxes_bit_for_bit():
    _, (target,), _ = MaiteAugmentation(tr.LensDistortion(p=0.0))((pictures(1), [detections()], [{"id": 0}]))
    assert np.array_equal(target.boxes, BOXES)
    assert target.labels.tolist() == [0, 1, 2, 3]


def test_images_that_need_gradients_get_them():
    image = torch.rand(3, H, W, generator=torch.Generator().manual_seed(0)).requires_grad_()
    (out,), (moved,), _ = MaiteAugmentation(LENS)(([image], [detections()], [{"id": 0}]))
    out.sum().backward()
    assert isinstance(image.grad, Tensor)
    assert image.grad.abs().sum() > 0
    assert type(moved.boxes) is np.ndarray


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"image": np.zeros((2, 3, H, W), np.uint8)}, r"datum 'a': image must have shape \(C, H, W\), got \(2, 3, 96"),
        ({"image": np.full((3, H, W), 200.0)}, r"datum 'a': image must lie in .* got values from 200"),
        ({"target": np.zeros((5, H, W))}, "datum 'a': target must have boxes, labels and scores, or be scores of"),
        ({"target": {"boxes": BOXES}}, "datum 'a': target must have boxes, labels and scores, or be scores of .* dict"),
        ({"target": SimpleNamespace(boxes=BOXES, labels=np.ones(4), scores=np.ones(3))}, "scores must have a row for"),
        ({"target": SimpleNamespace(boxes=BOXES[:, [2, 1, 0, 3]], labels=BOXES, scores=BOXES)}, "x1 <= x2"),
        ({"target": SimpleNamespace(boxes=XYWH, labels=BOXES, scores=BOXES)}, "datum 'a': boxes must be x1, .* XYWH"),
        ({"target": SimpleNamespace(boxes=BOXES[:, :3], labels=BOXES, scores=BOXES)}, r"boxes must have shape \(N, 4"),
        ({"metadata": {"name": "a"}}, "metadata must have an id, got .*name"),
        ({"metadata": {"id": "a", "torchrefract.LensDistortion": 1}}, "metadata must not have torchrefract.LensDis"),
    ],
)
def test_invalid_data_raise_with_their_id(change, message):
    image, target, metadata = (
        {"image": pictures(1)[0], "target": detections(), "metadata": {"id": "a"}} | change
    ).values()
    with pytest.raises((ValueError, TypeError), match=message):
        MaiteAugmentation(tr.LensDistortion())(([image], [target], [metadata]))  # anew: it checks the first image


def test_a_batch_of_other_lengths_and_other_arguments_raise():
    images, targets, metadata = batch()
    with pytest.raises(ValueError, match=r"batch must have as many .* got 3, 2 and 3"):
        MaiteAugmentation(LENS)((images, targets[:2], metadata))
    not_an_effect: Any = torch.nn.Identity()
    with pytest.raises(TypeError, match="effect must be an effect of torchrefract, got Identity"):
        MaiteAugmentation(not_an_effect)
    seed: Any = 0.5
    with pytest.raises(TypeError, match="seed must be"):
        MaiteAugmentation(LENS, seed=seed)


class DataSet:
    """Detections or classes of a data set, as MAITE wants them."""

    def __init__(self, targets: list[Any]):
        self.metadata = {"id": "made up"}
        self.targets = targets

    def __len__(self) -> int:
        return len(self.targets)

    def __getitem__(self, index: int) -> tuple[Any, Any, Any]:
        return pictures()[index], self.targets[index], {"id": index}


@pytest.mark.parametrize("domain", ["object_detection", "image_classification"])
@pytest.mark.parametrize("effect", [LENS, tr.UniformFog()], ids=["lens", "fog"])
def test_maite_evaluates_a_model_on_degraded_data(domain: str, effect: Effect):
    pytest.importorskip("maite", reason="maite is in the extra test")
    protocols = __import__(f"maite.protocols.{domain}", fromlist=["Augmentation"])
    augmentation, tasks = MaiteAugmentation(effect), __import__("maite.tasks", fromlist=["evaluate"])
    assert isinstance(augmentation, protocols.Augmentation)
    assert not isinstance(effect, protocols.Augmentation)  # the check can fail
    is_detection = domain == "object_detection"
    targets = [detections() if is_detection else np.eye(3)[i] for i in range(3)]
    seen: list[np.ndarray] = []

    class Model:
        metadata = {"id": "none"}  # noqa: RUF012 - the form that MAITE shows

        def __call__(self, images: Any) -> Any:
            seen.extend(images)
            return targets[: len(images)]

    _, _, batches = tasks.evaluate(
        model=Model(), dataset=DataSet(targets), augmentation=augmentation, batch_size=2, return_augmented_data=True
    )
    assert [len(rows) for rows, _, _ in batches] == [2, 1]
    for i, image in enumerate(seen):
        native = effect.degrade(torch.from_numpy(pictures()[i]), seed=0, keys=[key_of(str(i))])
        assert np.array_equal(image, native.image.numpy())
    moved = [target for _, rows, _ in batches for target in rows]
    if is_detection:
        assert all(isinstance(target, protocols.ObjectDetectionTarget.__origin__) for target in moved)
        assert np.array_equal(moved[0].boxes, BOXES) is not effect.degrade(torch.zeros(3, H, W)).has("flow")
    else:
        assert np.array_equal(moved, np.eye(3))
