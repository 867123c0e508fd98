"""Where people put effects: in the containers of others, in a Dataset and its workers, under torch.func."""

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
NEEDS: dict[str, Any] = {"Rectification": (CAMERA,)}
SINGLE: dict[str, Effect] = {
    name: kind(*NEEDS.get(name, ()))
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


def picture(*shape: int) -> Tensor:
    return torch.rand(*shape, *SIZE, generator=torch.Generator().manual_seed(0))


def row(params: Any, i: int) -> Any:
    """The parameters of one sample, as a batch of one."""
    return pytree.tree_map(lambda value: value[i : i + 1], params)


class Frames(Dataset):
    """Frames with a box in each, degraded where they are loaded."""

    def __init__(self, effect: Effect, images: Tensor, box: Any):
        self.effect, self.images, self.box = effect, images, box

    def __len__(self) -> int:
        return len(self.images)

    def __getitem__(self, i: int) -> tuple[Tensor, dict[str, Any]]:
        return self.effect(self.images[i], {"boxes": self.box, "id": i})


def test_every_public_effect_is_tried():
    assert len(EFFECTS) >= 7
    shown = picture(4, 3)
    for name, effect in EFFECTS.items():
        assert type(effect) is getattr(tr, name)
        assert not torch.equal(effect(shown), shown), name


def test_a_compose_of_torchvision_takes_an_effect_between_its_transforms(effect, transforms):
    bytes_ = (255 * picture(3)).byte()
    frame = transforms.functional.to_pil_image(bytes_)
    pipeline = transforms.Compose([transforms.ToTensor(), effect, transforms.Normalize([0.5] * 3, [0.5] * 3)])
    torch.manual_seed(3)
    found = pipeline(frame)
    torch.manual_seed(3)
    assert torch.equal(found, (effect(bytes_.float() / 255) - 0.5) / 0.5)


def test_a_compose_of_torchvision_v2_hands_the_target_on(effect, v2, tv_tensors):
    image = tv_tensors.Image((255 * picture(3)).byte())
    target = {
        "boxes": tv_tensors.BoundingBoxes(torch.tensor([[9.0, 8.0, 30.0, 25.0]]), format="XYXY", canvas_size=SIZE),
        "masks": tv_tensors.Mask(picture(1) > 0.5),
        "labels": torch.tensor([4]),
    }
    before, after = v2.RandomHorizontalFlip(p=1.0), v2.ToDtype(torch.float32, scale=True)
    torch.manual_seed(3)
    found, moved = v2.Compose([before, effect, after])(image, target)
    torch.manual_seed(3)
    expected, boxes = after(*effect(*before(image, target)))
    assert type(found) is tv_tensors.Image
    assert torch.equal(found, expected)
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


def test_an_effect_is_a_layer_among_layers(effect):
    image = picture(3, 3)
    blur, mix = nn.AvgPool2d(3, stride=1, padding=1), nn.Conv2d(3, 2, 1)
    torch.manual_seed(3)
    found = nn.Sequential(blur, effect, mix)(image)
    torch.manual_seed(3)
    assert torch.equal(found, mix(effect(blur(image))))


@pytest.mark.parametrize("name", ["ImageSequential", "AugmentationSequential"])
def test_a_container_of_kornia_takes_an_effect_between_its_augmentations(effect, name):
    augmentation = pytest.importorskip("kornia.augmentation", reason="kornia is in the extra train")
    options = {} if name == "ImageSequential" else {"data_keys": ["input"]}
    flip, scale = augmentation.RandomHorizontalFlip(p=1.0), augmentation.Normalize(0.5, 0.5)
    pipeline = getattr(augmentation.container, name)(flip, effect, scale, **options)
    image = picture(3, 3)
    torch.manual_seed(3)
    found = pipeline(image)
    torch.manual_seed(3)
    flipped = flip(image)
    assert torch.equal(flipped, image.flip(-1))
    assert torch.equal(found, scale(effect(flipped)))


def test_a_loader_gives_what_the_effect_gives_frame_by_frame(effect, tv_tensors):
    images = picture(4, 3)
    box = tv_tensors.BoundingBoxes(torch.tensor([[9.0, 8.0, 30.0, 25.0]]), format="XYXY", canvas_size=SIZE)
    # With a generator of its own the loader leaves the global one to the effect.
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


# A script of its own: spawned workers import the class of a dataset from the file where it stands.
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
                found = torch.stack([getattr(degraded, field) for degraded, _ in rows])
                assert torch.equal(found, expected), (name, field)
        # Without a seed no two draws are the same, whoever makes them. A rectification draws nothing, and a choice
        # among effects one of which is a rectification may fall on it twice.
        drawn = torch.stack([image for _, image in rows]).flatten(1).unique(dim=0)
        if name != "OneOf":
            assert len(drawn) == (1 if name == "Rectification" else len(rows)), name
    print("same")
"""


def test_spawned_workers_give_by_key_what_this_process_gives(spawn, tmp_path: Path):
    drawing = tr.OneOf([effect for name, effect in SINGLE.items() if name != "Rectification"])
    effects = {**EFFECTS, "OneOf of those that draw": drawing}
    (tmp_path / "frames.pkl").write_bytes(pickle.dumps((effects, picture(3, 3))))
    (tmp_path / "load.py").write_text(SPAWNED)
    done = spawn("load.py", "frames.pkl", cwd=tmp_path)
    assert (done.code, done.out) == (0, "same\n"), done.err


def test_vmap_over_params_is_one_image_through_each_of_them(effect):
    image = picture(1, 3)
    params = effect.sample(image.expand(6, -1, -1, -1), seed=7)

    def through(params: Any) -> Tensor:
        return effect.apply(image, pytree.tree_map(lambda value: value[None], params)).image[0]

    expected = torch.cat([effect.apply(image, row(params, i)).image for i in range(6)])
    assert_close(torch.func.vmap(through)(params), expected, rtol=0, atol=2e-4)


def test_vmap_over_images_of_any_layout_is_each_of_them_alone(effect):
    images = torch.rand(6, 1, 3, SIZE[1], SIZE[0], generator=torch.Generator().manual_seed(0)).mT
    params = effect.sample(images[:, 0], seed=7)

    def alone(image: Tensor, params: Any) -> Tensor:
        return effect.apply(image, pytree.tree_map(lambda value: value[None], params)).image

    expected = torch.stack([effect.apply(image, row(params, i)).image for i, image in enumerate(images)])
    assert_close(torch.func.vmap(alone)(images, params), expected, rtol=0, atol=2e-4)


def test_autocast_changes_nothing(effect):
    image = picture(3, 3)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        result = effect.degrade(image, seed=7).image
    assert result.dtype == torch.float32
    assert_close(result, effect.degrade(image, seed=7).image, rtol=0, atol=2e-4)


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda value: pickle.loads(pickle.dumps(value))])
def test_a_copy_of_a_model_degrades_as_the_model_does(effect, copied):
    model, image = nn.Sequential(nn.Conv2d(3, 3, 1), effect), picture(3, 3)
    torch.manual_seed(3)
    expected = model(image)
    torch.manual_seed(3)
    assert torch.equal(copied(model)(image), expected)


def test_an_effect_adds_nothing_to_the_state_of_a_model(effect):
    model = nn.Sequential(nn.Conv2d(3, 3, 1), effect)
    assert list(model.state_dict()) == ["0.weight", "0.bias"]
    other = nn.Sequential(nn.Conv2d(3, 3, 1), copy.deepcopy(effect))
    other.load_state_dict(model.state_dict(), strict=True)
    image = picture(3, 3)
    torch.manual_seed(3)
    expected = model(image)
    torch.manual_seed(3)
    assert torch.equal(other(image), expected)
