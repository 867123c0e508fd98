"""Effects inside other code: torchvision, kornia, nn.Sequential, a Dataset with workers, and torch.func."""

import copy
import pickle
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch.testing import assert_close
from torch.utils import _pytree as pytree
from torch.utils.data import DataLoader, Dataset

import torchrefract as tr
from torchrefract.effects.base import Effect

SIZE = (40, 56)
CAMERA = tr.Camera(width=56, height=40, fx=50.0, fy=50.0, cx=28.0, cy=19.0, coefficients=(-0.2, 0.05, 0.0, 0.0))
POSITIONAL: dict[str, Any] = {"Rectification": (CAMERA,)}
SINGLE: dict[str, Effect] = {
    name: kind(*POSITIONAL.get(name, ()))
    for name, kind in vars(tr).items()
    if isinstance(kind, type) and issubclass(kind, Effect) and not issubclass(kind, tr.Compose)
}
EFFECTS: dict[str, Effect] = {
    **SINGLE,
    "Compose": tr.Compose([*SINGLE.values(), tr.Compose([tr.ThinPlateSpline(p=0.5)])]),
    "OneOf": tr.OneOf(list(SINGLE.values())),
}


@pytest.fixture(params=EFFECTS)
def effect(request) -> Effect:
    return EFFECTS[request.param]


@pytest.fixture(scope="session")
def transforms() -> Any:
    return pytest.importorskip("torchvision.transforms", reason="torchvision is in the extra test")


@pytest.fixture(scope="session")
def v2() -> Any:
    return pytest.importorskip("torchvision.transforms.v2", reason="torchvision is in the extra test")


@pytest.fixture(scope="session")
def tv_tensors() -> Any:
    return pytest.importorskip("torchvision.tv_tensors", reason="torchvision is in the extra test")


def random_frames(*shape: int) -> Tensor:
    return torch.rand(*shape, *SIZE, generator=torch.Generator().manual_seed(0))


def select(params: Any, i: int) -> Any:
    """Return the parameters of sample i as a batch of one."""
    return pytree.tree_map(lambda value: value[i : i + 1], params)


class Frames(Dataset):
    """Frames, each with a box, that workers degrade."""

    def __init__(self, effect: Effect, images: Tensor, box: Any):
        self.effect, self.images, self.box = effect, images, box

    def __len__(self) -> int:
        return len(self.images)

    def __getitem__(self, i: int) -> tuple[Tensor, dict[str, Any]]:
        return self.effect(self.images[i], {"boxes": self.box, "id": i})


@pytest.mark.quick
def test_every_public_effect_changes_an_image():
    assert len(EFFECTS) >= 7
    image = random_frames(4, 3)
    for name, effect in EFFECTS.items():
        assert type(effect) is getattr(tr, name)
        assert not torch.equal(effect(image), image), name


def test_an_effect_works_between_transforms_of_torchvision(effect, transforms):
    bytes_ = (255 * random_frames(3)).byte()
    frame = transforms.functional.to_pil_image(bytes_)
    pipeline = transforms.Compose([transforms.ToTensor(), effect, transforms.Normalize([0.5] * 3, [0.5] * 3)])
    torch.manual_seed(3)
    result = pipeline(frame)
    torch.manual_seed(3)
    assert torch.equal(result, (effect(bytes_.float() / 255) - 0.5) / 0.5)


def test_an_effect_moves_the_target_between_transforms_of_torchvision_v2(effect, v2, tv_tensors):
    image = tv_tensors.Image((255 * random_frames(3)).byte())
    target = {
        "boxes": tv_tensors.BoundingBoxes(torch.tensor([[9.0, 8.0, 30.0, 25.0]]), format="XYXY", canvas_size=SIZE),
        "masks": tv_tensors.Mask(random_frames(1) > 0.5),
        "labels": torch.tensor([4]),
    }
    before, after = v2.RandomHorizontalFlip(p=1.0), v2.ToDtype(torch.float32, scale=True)
    torch.manual_seed(3)
    result, moved = v2.Compose([before, effect, after])(image, target)
    torch.manual_seed(3)
    expected, boxes = after(*effect(*before(image, target)))
    assert type(result) is tv_tensors.Image
    assert torch.equal(result, expected)
    assert moved.keys() == target.keys()
    for name, value in moved.items():
        assert type(value) is type(target[name])
        assert torch.equal(value, boxes[name]), name
    torch.manual_seed(3)
    before(image, target)
    flow = effect.degrade(image.flip(-1)).flow
    mirrored = torch.tensor([[SIZE[1] - 30.0, 8.0, SIZE[1] - 9.0, 25.0]])
    if flow is not None:
        mirrored = tr.warp_boxes(mirrored - 0.5, flow)[0] + 0.5
    assert_close(moved["boxes"].as_subclass(Tensor), mirrored, rtol=0, atol=1e-4)


@pytest.mark.quick
def test_an_effect_works_inside_a_sequential(effect):
    image = random_frames(3, 3)
    blur, mix = nn.AvgPool2d(3, stride=1, padding=1), nn.Conv2d(3, 2, 1)
    torch.manual_seed(3)
    result = nn.Sequential(blur, effect, mix)(image)
    torch.manual_seed(3)
    assert torch.equal(result, mix(effect(blur(image))))


@pytest.mark.parametrize("name", ["ImageSequential", "AugmentationSequential"])
def test_an_effect_works_between_augmentations_of_kornia(effect, name):
    augmentation = pytest.importorskip("kornia.augmentation", reason="kornia is in the extra train")
    options = {} if name == "ImageSequential" else {"data_keys": ["input"]}
    flip, scale = augmentation.RandomHorizontalFlip(p=1.0), augmentation.Normalize(0.5, 0.5)
    pipeline = getattr(augmentation.container, name)(flip, effect, scale, **options)
    image = random_frames(3, 3)
    torch.manual_seed(3)
    result = pipeline(image)
    torch.manual_seed(3)
    flipped = flip(image)
    assert torch.equal(flipped, image.flip(-1))
    assert torch.equal(result, scale(effect(flipped)))


def test_a_loader_gives_the_results_of_the_effect_frame_by_frame(effect, tv_tensors):
    images = random_frames(4, 3)
    box = tv_tensors.BoundingBoxes(torch.tensor([[9.0, 8.0, 30.0, 25.0]]), format="XYXY", canvas_size=SIZE)
    # The loader gets another generator, so that only the effect uses the global one.
    loader = DataLoader(Frames(effect, images, box), batch_size=2, collate_fn=list, generator=torch.Generator())
    torch.manual_seed(3)
    loaded = [sample for batch in loader for sample in batch]
    torch.manual_seed(3)
    assert len(loaded) == 4
    for i, (image, target) in enumerate(loaded):
        expected, moved = effect(images[i], {"boxes": box, "id": i})
        assert torch.equal(image, expected)
        assert torch.equal(target["boxes"], moved["boxes"])
        assert target["id"] == i


# A script, since spawned workers import the class of a dataset from its file.
SPAWNED = """
import pickle, sys
from pathlib import Path
import torch
from torch.utils.data import DataLoader, Dataset

class Frames(Dataset):
    def __init__(self, effects, images):
        self.effects, self.images = effects, images

    def __len__(self):
        return len(self.effects) * len(self.images)

    def __getitem__(self, i):
        effect, k = self.effects[i // len(self.images)], i % len(self.images)
        return effect.degrade(self.images[k], seed=7, keys=[2**40 + k]), effect(self.images[0])

if __name__ == "__main__":
    effects, images = pickle.loads(Path(sys.argv[1]).read_bytes())
    frames = Frames(list(effects.values()), images)
    samples = list(DataLoader(frames, batch_size=None, num_workers=2, multiprocessing_context="spawn"))
    keys = [2**40 + k for k in range(len(images))]
    for n, (name, effect) in enumerate(effects.items()):
        rows = samples[n * len(images) : (n + 1) * len(images)]
        together = effect.degrade(images, seed=7, keys=keys)
        for field in ("image", "flow", "valid", "restore_flow", "restore_valid", "transmission"):
            expected = getattr(together, field)
            if expected is not None:
                actual = torch.stack([getattr(degraded, field) for degraded, _ in rows])
                if expected.dtype is torch.bool:
                    assert (actual != expected).sum() <= expected.numel() // 500, (name, field)
                else:
                    torch.testing.assert_close(actual, expected, rtol=1e-5, atol=1e-4 if "flow" in field else 1e-5)
        # Without a seed all draws differ. A rectification draws nothing, and OneOf may choose it twice.
        drawn = torch.stack([image for _, image in rows]).flatten(1).unique(dim=0)
        if name != "OneOf":
            assert len(drawn) == (1 if name == "Rectification" else len(rows)), name
    print("same")
"""


def test_spawned_workers_give_the_samples_of_this_process(spawn, tmp_path: Path):
    drawing = tr.OneOf([effect for name, effect in SINGLE.items() if name != "Rectification"])
    effects = {**EFFECTS, "OneOf without Rectification": drawing}
    (tmp_path / "frames.pkl").write_bytes(pickle.dumps((effects, random_frames(3, 3))))
    (tmp_path / "load.py").write_text(SPAWNED)
    done = spawn("load.py", "frames.pkl", cwd=tmp_path)
    assert (done.code, done.out) == (0, "same\n"), done.err


def test_vmap_over_params_degrades_one_image_by_each_of_them(effect):
    image = random_frames(1, 3)
    params = effect.sample(image.expand(6, -1, -1, -1), seed=7)

    def degrade(params: Any) -> Tensor:
        return effect.apply(image, pytree.tree_map(lambda value: value[None], params)).image[0]

    expected = torch.cat([effect.apply(image, select(params, i)).image for i in range(6)])
    assert_close(torch.func.vmap(degrade)(params), expected, rtol=0, atol=2e-4)


def test_autocast_changes_nothing(effect):
    image = random_frames(3, 3)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        result = effect.degrade(image, seed=7).image
    assert result.dtype == torch.float32
    assert_close(result, effect.degrade(image, seed=7).image, rtol=0, atol=2e-4)


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda value: pickle.loads(pickle.dumps(value))])
def test_a_copy_of_a_model_degrades_like_the_model(effect, copied):
    model, image = nn.Sequential(nn.Conv2d(3, 3, 1), effect), random_frames(3, 3)
    torch.manual_seed(3)
    expected = model(image)
    torch.manual_seed(3)
    assert torch.equal(copied(model)(image), expected)


def test_an_effect_adds_nothing_to_the_state_of_a_model(effect):
    model = nn.Sequential(nn.Conv2d(3, 3, 1), effect)
    assert list(model.state_dict()) == ["0.weight", "0.bias"]
    other = nn.Sequential(nn.Conv2d(3, 3, 1), copy.deepcopy(effect))
    other.load_state_dict(model.state_dict(), strict=True)
    image = random_frames(3, 3)
    torch.manual_seed(3)
    expected = model(image)
    torch.manual_seed(3)
    assert torch.equal(other(image), expected)
