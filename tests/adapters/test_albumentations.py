"""Effects inside pipelines of Albumentations."""

import importlib
import json
import sys
from typing import Any, cast

import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader

import torchrefract as tr
from torchrefract import presets
from torchrefract.effects.base import Effect

A = pytest.importorskip("albumentations", reason="albumentations is in the extra albumentations")
tv_tensors = pytest.importorskip("torchvision.tv_tensors", reason="native labels need torchvision")
adapter = pytest.importorskip("torchrefract.adapters.albumentations", reason="albumentations is in its own extra")

H, W = 96, 128
STRONG = tr.LensDistortion(k1_range=(-0.35, -0.35), k2_range=(0.12, 0.12), focal_range=(0.65, 0.65), padding="border")
BULGE = tr.LensDistortion(k1_range=(0.4, 0.4), k2_range=(0, 0), focal_range=(0.7, 0.7), frame="pad")
CHAIN = tr.Compose([tr.ThinPlateSpline(), tr.UniformFog(), STRONG, tr.Turbulence(amplitude_range=(2, 2))])
EFFECTS = {"lens": STRONG, "bulge": BULGE, "chain": CHAIN, "haze": presets.highveld_heat_haze(5, width=W)}
# Of pixel edges in px; the second one leaves the frame of `BULGE`.
BOXES = np.array([[30.0, 20, 60, 50], [0, 0, 4, 4], [60, 40, 128, 96], [5, 60, 40, 90]], np.float32)
POINTS = np.array([[40.0, 30], [2, 1], [90, 70.5], [64, 48], [120, 10]], np.float32)

CONVERSIONS: dict[str, Any] = {
    "pascal_voc": lambda b: b,
    "albumentations": lambda b: b / [W, H, W, H],
    "coco": lambda b: np.concatenate([b[:, :2], b[:, 2:] - b[:, :2]], axis=1),
    "yolo": lambda b: np.concatenate([(b[:, :2] + b[:, 2:]) / 2, b[:, 2:] - b[:, :2]], axis=1) / [W, H, W, H],
}


def picture(channels: int = 3, dtype: Any = np.uint8) -> np.ndarray:
    pixels = np.random.default_rng(0).integers(0, 256, (H, W, channels), np.uint8)
    pixels = pixels if dtype is np.uint8 else (pixels / 255).astype(dtype)
    return pixels if channels > 1 else pixels[..., 0]


def pipeline(effect: Effect, form: str = "pascal_voc", **arguments: Any) -> Any:
    boxes = A.BboxParams(form, label_fields=["names"], **arguments.pop("boxes", {}))
    points = A.KeypointParams("xyas", label_fields=["ids"], angle_in_degrees=False, **arguments.pop("points", {}))
    transforms = [adapter.AlbumentationsEffect(effect)]
    return A.Compose(transforms, boxes, points, save_applied_params=True, **{"seed": 1, **arguments})


def labels(form: str = "pascal_voc") -> dict[str, Any]:
    extra = np.tile(np.array([[0.5, 3.0]], np.float32), (len(POINTS), 1))
    return {
        "bboxes": CONVERSIONS[form](BOXES),
        "names": list("abcd"),
        "keypoints": np.concatenate([POINTS, extra], axis=1),
        "ids": list(range(len(POINTS))),
        "mask": np.random.default_rng(1).integers(0, 9, (H, W), np.uint8),
    }


def native(effect: Any, image: np.ndarray, out: dict[str, Any]) -> tuple[Any, dict[str, Any]]:
    """Return the degradation and the labels of this library for the draw of a pipeline."""
    degraded = effect.degrade(
        torch.from_numpy(np.atleast_3d(image)).movedim(-1, 0), seed=out["applied_transforms"][0][1]["seed"]
    )
    size: dict[str, Any] = {"canvas_size": (H, W)}
    target = {
        "boxes": tv_tensors.BoundingBoxes(torch.from_numpy(BOXES), format="XYXY", **size),
        "labels": torch.arange(4),
        "keypoints": tv_tensors.KeyPoints(torch.from_numpy(POINTS), **size),
        "mask": tv_tensors.Mask(torch.from_numpy(labels()["mask"])),
    }
    return degraded, tr.warp_labels(target, degraded.flow) if degraded.has("flow") else target


@pytest.mark.quick
@pytest.mark.parametrize(("name", "form"), [*zip(EFFECTS, CONVERSIONS, strict=True)])
@pytest.mark.filterwarnings("ignore:depth is that of a road")  # scenes assume a depth; the test is of others
def test_labels_agree_with_the_native_ones_to_a_twentieth_of_a_pixel(name, form):
    effect, image = EFFECTS[name], picture()
    out = pipeline(effect, form, points={"remove_invisible": False})(image=image, **labels(form))
    degraded, target = native(effect, image, out)
    assert np.array_equal(out["image"], degraded.image.movedim(0, -1).numpy())
    assert not np.array_equal(out["image"], image)
    assert np.array_equal(out["mask"], target["mask"].numpy())
    scale = np.array([W, H, W, H]) if form in ("yolo", "albumentations") else 1
    moved = CONVERSIONS[form](target["boxes"].numpy())
    assert out["names"] == ["abcd"[i] for i in target["labels"]]
    assert np.abs((out["bboxes"] - moved) * scale).max() < 0.05
    shown = (target["keypoints"] >= 0).all(dim=1).numpy()  # the others are left out by the native labels
    assert shown.sum() >= 4
    assert np.abs(out["keypoints"][shown, :2] - target["keypoints"].numpy()[shown]).max() < 0.05


@pytest.mark.parametrize("min_visibility", [0.0, 0.7])
def test_boxes_that_leave_the_frame_go_with_their_labels_and_so_do_mostly_hidden_ones(min_visibility):
    out = pipeline(BULGE, boxes={"min_visibility": min_visibility})(image=picture(), **labels())
    degraded, _ = native(BULGE, picture(), out)
    _, keep = tr.warp_boxes(torch.from_numpy(BOXES) - 0.5, degraded.flow, min_visibility=min_visibility)
    assert out["names"] == [name for name, kept in zip("abcd", keep, strict=True) if kept]
    assert out["names"] == (list("acd") if min_visibility == 0 else list("ad"))
    assert len(out["bboxes"]) == len(out["names"])


def test_a_picture_without_labels_or_with_none_left_keeps_empty_lists():
    empty = {"bboxes": np.zeros((0, 4)), "names": [], "keypoints": np.zeros((0, 4)), "ids": []}
    out = pipeline(STRONG)(image=picture(), **empty)
    assert [len(out[key]) for key in empty] == [0, 0, 0, 0]
    corner = {"bboxes": [[0, 0, 2, 2]], "names": ["a"], "keypoints": [[1, 1, 0, 1]], "ids": [0]}
    out = pipeline(BULGE)(image=picture(), **corner)
    assert [len(out[key]) for key in corner] == [0, 0, 0, 0]


@pytest.mark.filterwarnings("ignore:the lens must not fold", "ignore:Turbulence this strong folds")  # both on purpose
def test_keypoints_that_a_fold_hides_go_with_their_labels_and_others_stay_outside():
    folds = tr.LensDistortion(k1_range=(-1.5, -1.5), focal_range=(0.6, 0.6), frame="pad")
    # It shows some points mirrored.
    waves = tr.Turbulence(amplitude_range=(12, 12), length_range=(12, 12), covariance="gaussian")
    grid = np.stack(np.meshgrid(np.arange(4, W, 8), np.arange(4, H, 8)), axis=-1).reshape(-1, 2).astype(np.float32)
    for effect, names in ((folds, ["ids"]), (folds, None), (waves, ["ids"]), (BULGE, ["ids"])):
        points = A.KeypointParams("xy", label_fields=names, remove_invisible=False)
        chain = A.Compose([adapter.AlbumentationsEffect(effect)], None, points, seed=1, save_applied_params=True)
        out = chain(image=picture(), keypoints=grid, **({} if names is None else {"ids": list(range(len(grid)))}))
        degraded, _ = native(effect, picture(), out)
        keypoints = tv_tensors.KeyPoints(torch.from_numpy(grid), canvas_size=(H, W))
        expected = tr.warp_labels({"keypoints": keypoints}, degraded.flow)["keypoints"].numpy()
        is_hidden = (expected == -1).all(axis=1)
        if effect is BULGE:
            assert not is_hidden.any()
            assert len(out["keypoints"]) == len(grid)
        elif names is None:
            assert np.array_equal((out["keypoints"] == -1).all(axis=1), is_hidden)
        else:
            assert 0 < is_hidden.sum() < len(grid)
            assert np.array_equal(np.array(out["ids"], int), np.flatnonzero(~is_hidden))


@pytest.mark.parametrize("degrees", [False, True])
@pytest.mark.parametrize("name", ["lens", "chain"])
def test_angles_and_scales_of_keypoints_follow_the_local_jacobian(name, degrees):
    angles = np.array([0.0, 0.5, 2.0, 4.0, 6.2])
    points = np.concatenate(
        [POINTS, (np.degrees(angles) if degrees else angles)[:, None], np.full((5, 1), 3.0)], axis=1
    )
    params = A.KeypointParams("xyas", remove_invisible=False, angle_in_degrees=degrees)
    transform = [adapter.AlbumentationsEffect(EFFECTS[name])]
    out = A.Compose(transform, keypoint_params=params, save_applied_params=True, seed=2)(
        image=picture(), keypoints=points
    )
    flow = native(EFFECTS[name], picture(), out)[0].flow.double()
    center = torch.from_numpy(POINTS).double()
    steps = torch.tensor([[np.cos(a), np.sin(a)] for a in angles])
    moved, across, start = (
        tr.warp_points(center + 1e-3 * step, flow, tolerance_px=1e-9)[0]
        for step in (steps, torch.stack([-steps[:, 1], steps[:, 0]], dim=1), 0)
    )
    (u, v), (s, t) = (1e3 * (moved - start)).T, (1e3 * (across - start)).T
    turned = np.radians(out["keypoints"][:, 2]) if degrees else out["keypoints"][:, 2]
    miss = (torch.from_numpy(turned) - torch.atan2(v, u) + np.pi) % (2 * np.pi) - np.pi
    assert miss.abs().max() < 2e-3
    assert np.abs(turned - angles).max() > 0.01  # the scene turns them
    assert np.allclose(out["keypoints"][:, 3], 3 * (u * t - v * s).abs().sqrt(), rtol=2e-3)


@pytest.mark.parametrize(("channels", "dtype"), [(1, np.float32), (3, np.uint8)])
@pytest.mark.parametrize("effect", [STRONG, tr.UniformFog()])
def test_pictures_keep_their_kind_and_equal_the_native_ones(effect, channels, dtype):
    image = picture(channels, dtype)
    for given in (image, image[:, ::-1]):
        out = A.Compose([adapter.AlbumentationsEffect(effect)], save_applied_params=True, seed=3)(image=given)
        degraded, _ = native(effect, np.ascontiguousarray(given), out)
        assert (out["image"].shape, out["image"].dtype) == (image.shape, image.dtype)
        assert np.array_equal(out["image"], degraded.image.movedim(0, -1).numpy().reshape(image.shape))


def test_pictures_of_opencv_are_degraded_as_rgb():
    orange = tr.UniformFog(visibility_range=(30, 30), airlight=(0.9, 0.6, 0.2))
    rgb, bgr = (A.Compose([adapter.AlbumentationsEffect(orange, channels=c)], seed=8) for c in ("rgb", "bgr"))
    assert np.array_equal(bgr(image=picture()[..., ::-1])["image"], rgb(image=picture())["image"][..., ::-1])
    with pytest.raises(ValueError, match="channels must be one of"):
        adapter.AlbumentationsEffect(orange, channels="grb")


def test_masks_of_any_type_follow_and_are_interpolated_on_request():
    ids = np.random.default_rng(2).integers(0, 2**31 - 1, (2, H, W), np.int32)
    soft = np.random.default_rng(3).random((H, W, 2), np.float32)
    draw = {"save_applied_params": True, "seed": 4}
    transform = [adapter.AlbumentationsEffect(CHAIN)]
    nearest = A.Compose(transform, **draw)(image=picture(), masks=[*ids], mask=soft)
    flow = native(CHAIN, picture(), nearest)[0].flow
    assert np.array_equal(nearest["masks"], tr.warp_mask(torch.from_numpy(ids), flow).numpy())
    linear = A.Compose(transform, mask_interpolation=1, **draw)(image=picture(), mask=soft, masks=ids)
    assert np.array_equal(linear["masks"], nearest["masks"])
    channels = torch.from_numpy(soft).movedim(-1, 0)
    for out, is_soft in ((nearest, False), (linear, True)):
        assert np.array_equal(out["mask"], tr.warp_mask(channels, flow, soft=is_soft).movedim(0, -1).numpy())


def test_an_effect_that_is_off_or_only_changes_light_keeps_all_labels():
    for effect in (tr.UniformFog(), tr.LensDistortion(p=0.0)):
        out = pipeline(effect, points={"remove_invisible": False})(image=picture(), **labels())
        assert np.allclose(out["bboxes"], BOXES, atol=1e-4)
        assert np.array_equal(out["keypoints"][:, :2], POINTS)
        assert np.array_equal(out["mask"], labels()["mask"])
    off = A.Compose([adapter.AlbumentationsEffect(STRONG, p=0.0)])
    assert np.array_equal(off(image=picture())["image"], picture())


def test_all_images_of_a_call_share_a_draw():
    transform = [adapter.AlbumentationsEffect(CHAIN)]
    pair = A.Compose(transform, additional_targets={"right": "image"})(image=picture(), right=picture())
    assert np.array_equal(pair["image"], pair["right"])
    images = np.stack([picture(), picture()])
    for key in ("images", "volume"):
        out = A.Compose(transform)(**{key: images})[key]
        assert np.array_equal(out[0], out[1])
        assert not np.array_equal(out[0], images[0])


def test_images_whose_depths_give_them_other_flows_raise():
    haze = tr.Turbulence(depth=lambda image: 50 + 400 * image[:, :1].float())
    chain = A.Compose([adapter.AlbumentationsEffect(haze)], additional_targets={"right": "image"})
    with pytest.raises(ValueError, match="images of one call must have one flow"):
        chain(image=picture(), right=255 - picture())


@pytest.mark.parametrize("key", ["image", "images"])
def test_a_tensor_raises_as_its_channels_are_not_last(key):
    image = torch.from_numpy(picture()).movedim(-1, 0)
    with pytest.raises(TypeError, match=f"{key} must be an array .* got Tensor; place effects before ToTensorV2"):
        adapter.AlbumentationsEffect(STRONG)(**{key: image if key == "image" else [image]})


def test_the_seed_of_a_pipeline_and_replay_repeat_the_draws():
    one, two = pipeline(STRONG, seed=5), pipeline(STRONG, seed=5)
    first = [one(image=picture(), **labels()) for _ in range(2)]
    again = [two(image=picture(), **labels()) for _ in range(2)]
    for a, b in zip(first, again, strict=True):
        assert np.array_equal(a["image"], b["image"])
        assert np.array_equal(a["bboxes"], b["bboxes"])
    assert not np.array_equal(first[0]["image"], first[1]["image"])
    recorded = A.ReplayCompose([adapter.AlbumentationsEffect(STRONG, p=0.9), A.HorizontalFlip()])(image=picture())
    for image in (picture(), picture(1)):
        replayed = A.ReplayCompose.replay(json.loads(json.dumps(recorded["replay"])), image=image)["image"]
        assert image.ndim == 2 or np.array_equal(replayed, recorded["image"])
    assert replayed.shape == (H, W)


def pictures_of_workers(seed: int | None) -> list[bytes]:
    transform = A.Compose([adapter.AlbumentationsEffect(STRONG)], seed=seed)
    loader = DataLoader(
        cast(Any, [picture()] * 4), num_workers=2, collate_fn=lambda rows: transform(image=rows[0])["image"]
    )
    return [image.tobytes() for _ in range(2) for image in loader]


def test_workers_and_epochs_draw_anew_without_a_seed_and_repeat_with_one():
    torch.manual_seed(0)
    drawn = pictures_of_workers(None)
    assert len(set(drawn)) == 8
    assert len(set(pictures_of_workers(9))) == 2


def test_without_albumentations_the_error_names_the_package(monkeypatch):
    monkeypatch.setitem(sys.modules, "albumentations.core.transforms_interface", None)
    monkeypatch.delitem(sys.modules, adapter.__name__)
    with pytest.raises(ImportError, match=r'needs Albumentations: pip install "torchrefract\[albumentations\]"'):
        importlib.import_module(adapter.__name__)


@pytest.mark.parametrize("name", ["chain", "haze"])
@pytest.mark.filterwarnings("ignore:depth is that of a road")  # scenes assume a depth; the test is of others
def test_a_saved_pipeline_gives_the_same_pictures(name, tmp_path):
    chain = A.Compose([adapter.AlbumentationsEffect(EFFECTS[name], p=0.99)], seed=6)
    for form in ("json", "yaml"):
        A.save(chain, tmp_path / form, data_format=form)
        again = A.load(tmp_path / form, data_format=form)
        again.set_random_seed(7)
        chain.set_random_seed(7)
        assert np.array_equal(chain(image=picture())["image"], again(image=picture())["image"])


def test_an_effect_that_text_cannot_describe_says_so_when_it_is_saved():
    transform = adapter.AlbumentationsEffect(tr.Compose([tr.Turbulence(depth=lambda image: image[:, :1])]))
    with pytest.raises(TypeError, match=r"effect.effects\[0\].depth must be .* to be written as text, got .*function"):
        A.to_dict(transform)
    assert "Turbulence" in repr(transform)
    with pytest.raises(ValueError, match="p must be"):
        adapter.AlbumentationsEffect(STRONG, p=1.5)
