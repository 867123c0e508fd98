import multiprocessing
import subprocess
import sys
from typing import Any

import pytest
import torch
from PIL import Image
from pytorch_lightning import LightningModule, Trainer
from torch.testing import assert_close

from torchrefract import Frame, LensDistortion, Pair, UniformFog, presets
from torchrefract.data.module import PairData, frames, make_pair, pairs, road_scenes
from torchrefract.data.road_scenes import RoadScenes

SIZE = (12, 20)
COUNT = 10
QUIET: dict[str, Any] = {
    **{"accelerator": "cpu", "logger": False, "enable_checkpointing": False},
    **{"enable_progress_bar": False, "enable_model_summary": False},
}

FAILS = """
import sys
from torch.utils.data import DataLoader
from torchrefract.data import workers

workers._PATIENCE = 0.5

if __name__ == "__main__":
    loader = DataLoader([0, 1, 2], num_workers=1, worker_init_fn=workers.ignore_sigterm, persistent_workers=True)
    sys.frames = iter(loader)  # as a traceback keeps it
    next(sys.frames)
    sys.exit(3)
"""


def scenes(*, effect: LensDistortion | UniformFog | None = None, batch_size: int = 4, workers: int = 0, seed: int = 0):
    return road_scenes(
        effect=effect or LensDistortion(),
        size=SIZE,
        train_count=COUNT,
        val_count=5,
        batch_size=batch_size,
        workers=workers,
        seed=seed,
    )


def random_frames(count: int = 2) -> Frame:
    return Frame(torch.rand(count, 3, *SIZE), torch.arange(count), torch.empty(count, 0))


def by_key(pairs: list[Pair]) -> dict[int, Pair]:
    samples = [Pair(*sample) for batch in pairs for sample in zip(*batch, strict=True)]
    result = {int(sample.key): sample for sample in samples}
    assert len(result) == len(samples)
    return result


def assert_same(pairs: dict[int, Pair], expected: dict[int, Pair]) -> None:
    for key in pairs.keys() & expected.keys():
        for name, a, b in zip(Pair._fields, pairs[key], expected[key], strict=True):
            assert torch.equal(a, b), f"{name} of frame {key}"


@pytest.fixture(scope="module")
def first_epoch(batches) -> dict[int, Pair]:
    return by_key(batches(scenes(batch_size=1)))


@pytest.mark.quick
def test_a_pair_holds_a_frame_and_its_degraded_copy_without_gradient():
    frame, effect = random_frames(), LensDistortion()
    expected = effect.degrade(frame.image, seed=3, keys=frame.key)
    frame.image.requires_grad_()
    pair = make_pair(frame, effect, seed=3)
    assert not pair.degraded.requires_grad
    assert torch.equal(pair.degraded, expected.image)
    assert torch.equal(pair.clean, frame.image)
    assert torch.equal(pair.flow, expected.restore_flow)
    assert torch.equal(pair.valid, expected.restore_valid)
    assert torch.equal(pair.key, frame.key)
    assert pair.transmission.shape == (2, 0)


def test_a_border_changes_only_what_a_padded_frame_would_lack():
    """A padded frame shows an unzoomed view, linear for a ramp; a mirrored border folds it at the edge of the frame."""
    size, keys = (48, 80), torch.arange(3)
    ramp = torch.linspace(0.2, 0.8, size[1]).expand(3, 3, *size).contiguous()
    lens, frame = presets.cheap_dashcam(5, tolerance_px=None), Frame(ramp, keys, torch.empty(0))
    filled, black, mirrored = (make_pair(frame, lens, seed=3, border=border) for border in (None, "black", "mirrored"))
    params = lens.degrade(ramp, seed=3, keys=keys).params
    padded = lens.apply(ramp, params._replace(zoom=None, shift=None))
    border = ~padded.valid.expand_as(ramp)
    assert 0.05 < border.float().mean() < 0.5
    for pair in (black, mirrored):
        assert torch.equal(pair.degraded[~border], filled.degraded[~border])
        for name in ("clean", "flow", "valid", "key"):
            assert torch.equal(getattr(pair, name), getattr(filled, name))
    assert (black.degraded[border] == 0).float().mean() > 0.8  # sampling mixes the edge with black
    assert (black.degraded <= filled.degraded + 1e-6).all()
    x = torch.arange(size[1]) + padded.flow[:, :1]  # in the unzoomed frame
    folded = (size[1] - 1) - ((size[1] - 1) - x.abs()).abs()
    view = torch.zeros_like(ramp[:, :1])
    for i in range(3):  # the ramp in the unzoomed frame, from the middle rows of the filled one
        inside = padded.valid[i, 0]
        slope = torch.linalg.lstsq(
            torch.stack([x[i, 0][inside], torch.ones_like(x[i, 0][inside])], dim=1),
            filled.degraded[i, 0][inside][:, None],
        ).solution.flatten()
        view[i, 0] = slope[0] * folded[i, 0] + slope[1]
    assert (mirrored.degraded - view)[border].abs().max() < 0.01


@pytest.mark.parametrize(
    "scene", [UniformFog(), UniformFog(p=0.5), presets.paper_weather()], ids=["always", "sometimes", "one of several"]
)
def test_a_pair_has_its_transmission_on_request(scene):
    frame = random_frames(8)
    pair = make_pair(frame, scene, seed=3, transmission=True)
    assert torch.equal(pair.transmission, scene.degrade(frame.image, seed=3, keys=frame.key).transmission)
    unchanged = (pair.degraded == frame.image).flatten(1).all(dim=1)
    assert (pair.transmission[unchanged] == 1).all()


@pytest.mark.parametrize(
    ("effect", "flow", "message"),
    [
        (UniformFog(), True, "effect must have a flow, as a lens has, got UniformFog"),
        (LensDistortion(), False, "effect must have a transmission, as fog has, got LensDistortion"),
    ],
)
def test_an_effect_without_a_required_map_raises(effect, flow, message):
    with pytest.raises(ValueError, match=message):
        make_pair(random_frames(), effect, seed=0, flow=flow, transmission=not flow)
    scenes = RoadScenes(4, size=SIZE)
    with pytest.raises(ValueError, match=message):
        PairData(scenes, scenes, effect=effect, batch_size=2, flow=flow, transmission=not flow).check_pair()
    PairData(scenes, scenes, effect=effect, batch_size=2).check_pair()


def test_a_pair_of_fog_or_of_a_warp_that_is_not_applied_has_a_flow_of_zeros():
    for effect, flow in ((UniformFog(), False), (LensDistortion(p=0.0), True)):
        pair = make_pair(random_frames(), effect, seed=0, flow=flow)
        assert torch.equal(pair.flow, torch.zeros(2, 2, *SIZE))
        assert torch.equal(pair.valid, torch.ones(2, 1, *SIZE, dtype=torch.bool))


def test_the_depth_of_a_road_scene_reaches_the_fog(batches):
    # Fog of a fixed density: I = clean t + A (1 - t), t = exp(-k d), where t = 0.05 at the visibility.
    fog = UniformFog(visibility_range=(50.0, 50.0), deviation_range=(0.0, 0.0), airlight=0.8)
    batch = batches(scenes(effect=fog), training=False)[0]
    k = -torch.tensor(0.05).log() / 50
    for i in range(len(batch.key)):
        frame = RoadScenes(5, size=SIZE, first=COUNT)[i]
        t = torch.exp(-k * frame.depth)
        assert_close(batch.degraded[i], frame.image * t + 0.8 * (1 - t), rtol=0, atol=1e-5)
        assert frame.depth.isinf().any()


@pytest.mark.parametrize(("batch_size", "workers"), [(5, 0), (4, 2)])
def test_a_pair_depends_on_seed_epoch_and_key_alone(first_epoch, batch_size, workers, batches):
    pairs = by_key(batches(scenes(batch_size=batch_size, workers=workers)))
    assert len(pairs) == COUNT // batch_size * batch_size
    assert_same(pairs, first_epoch)


class LauncherContext(type(multiprocessing.get_context("spawn"))):
    """A start method of a launcher of jobs, as joblib's, whose processes run its jobs only."""

    _name = "loky"
    Process: Any = None


def test_workers_start_in_a_job_of_a_launcher_with_its_own_start_method(first_epoch, batches, monkeypatch):
    default = multiprocessing.context._default_context  # pyright: ignore[reportAttributeAccessIssue]  # not in stubs
    monkeypatch.setattr(default, "_actual_context", LauncherContext())
    assert_same(by_key(batches(scenes(workers=1))), first_epoch)


def test_each_epoch_of_training_has_another_order_and_other_draws_of_the_same_frames(first_epoch, batches):
    later = by_key(batches(scenes(batch_size=1), epoch=1))
    assert later.keys() == first_epoch.keys()
    assert list(later) != list(first_epoch)
    for key, pair in later.items():
        assert torch.equal(pair.clean, first_epoch[key].clean)
        assert (pair.flow - first_epoch[key].flow).abs().max() > 1e-3


def test_validation_has_the_same_order_and_draws_in_every_epoch(batches):
    first, later = (batches(scenes(), training=False, epoch=epoch) for epoch in (0, 7))
    keys = [key for batch in first for key in batch.key.tolist()]
    assert keys == [key for batch in later for key in batch.key.tolist()] == list(range(COUNT, COUNT + 5))
    assert_same(by_key(later), by_key(first))


def test_a_validation_has_the_transmission_of_fog_and_a_training_only_on_request(during):
    frame = Frame(*next(iter(scenes().train_dataloader())))
    for effect, size in ((UniformFog(), (4, 1, *SIZE)), (LensDistortion(), (4, 0))):
        data = scenes(effect=effect)
        assert during(data, training=False).on_after_batch_transfer(frame, 0).transmission.shape == size
        assert during(data).on_after_batch_transfer(frame, 0).transmission.shape == (4, 0)


def test_validation_and_each_epoch_of_each_seed_have_different_draws(during):
    frame = Frame(*next(iter(scenes().train_dataloader())))
    flows = [during(scenes(), training=False).on_after_batch_transfer(frame, 0).flow]
    flows += [
        during(scenes(seed=s), epoch=e).on_after_batch_transfer(frame, 0).flow for s in (0, 1, 2) for e in (0, 1, 2)
    ]
    assert min((a - b).abs().amax(dim=(1, 2, 3)).min() for i, a in enumerate(flows) for b in flows[:i]) > 1e-6


def test_two_ranks_share_the_training_frames_and_validate_each_once(first_epoch, batches):
    with pytest.raises(
        ValueError, match="batch_size must be at most the 5 training frames that each of 2 processes has"
    ):
        batches(scenes(batch_size=8), ranks=2)
    halves = [by_key(batches(scenes(batch_size=1), ranks=2, rank=rank)) for rank in (0, 1)]
    assert not halves[0].keys() & halves[1].keys()
    assert (halves[0] | halves[1]).keys() == first_epoch.keys()
    assert_same(halves[0] | halves[1], first_epoch)
    validated = [batches(scenes(), training=False, ranks=2, rank=rank) for rank in (0, 1)]
    keys = [key for part in validated for batch in part for key in batch.key.tolist()]
    assert sorted(keys) == list(range(COUNT, COUNT + 5))
    with pytest.raises(ValueError, match="the validation must have a frame for each of 6 processes, got 5 frames"):
        scenes(batch_size=1).check_ranks(6)


@pytest.mark.filterwarnings("ignore:.*does not have many workers", "ignore:.*LeafSpec")  # of Lightning
def test_a_trainer_with_its_default_sampler_for_two_processes_validates_each_frame_once(tmp_path, monkeypatch):
    """Lightning replaces a sampler of another type by one that takes a share of the share of a process."""

    class Module(LightningModule):
        def validation_step(self, batch: Pair, _: int) -> None:
            with (tmp_path / f"{self.global_rank}.txt").open("a") as file:
                file.writelines(f"{key}\n" for key in batch.key.tolist())

    monkeypatch.setenv("GLOO_SOCKET_IFNAME", "lo")
    data = road_scenes(effect=LensDistortion(), size=(8, 14), train_count=4, val_count=7, batch_size=2, workers=0)
    Trainer(devices=2, strategy="ddp_fork", **QUIET).validate(Module(), datamodule=data, verbose=False)
    parts = [(tmp_path / f"{rank}.txt").read_text().split() for rank in range(2)]
    assert sorted(int(key) for part in parts for key in part) == list(range(4, 11))


@pytest.mark.filterwarnings("ignore:.*no `validation_step`", "ignore:.*returned `None`")  # the module only notes keys
@pytest.mark.filterwarnings("ignore:.*overfit", "ignore:.*does not have many workers")  # as the test asks for
@pytest.mark.filterwarnings("ignore:.*LeafSpec")  # Lightning's own code
def test_a_trainer_that_overfits_batches_gets_the_first_ones_in_each_epoch(tars):
    class Module(LightningModule):
        def __init__(self) -> None:
            super().__init__()
            self.keys = list[int]()

        def training_step(self, batch: Pair, _: int) -> None:
            self.keys += batch.key.tolist()

        def configure_optimizers(self) -> None: ...

    from_tars = pairs(root=tars, batch_size=4, workers=0, buffer=5)
    for data, expected in ((scenes(), list(range(8))), (from_tars, None)):
        module, trainer = Module(), Trainer(max_epochs=2, overfit_batches=2, **QUIET)
        trainer.fit(module, datamodule=data)
        assert len(module.keys) == 16
        assert module.keys[:8] == (expected or module.keys[8:])
        assert module.keys[:8] == module.keys[8:]


def test_keys_stay_on_the_cpu(during):
    frame = Frame(*next(iter(during(scenes()).train_dataloader())))
    moved = scenes().transfer_batch_to_device(frame, torch.device("meta"), 0)
    assert moved.image.is_meta  # pyright: ignore[reportAttributeAccessIssue]  # a Frame stays one
    assert torch.equal(moved.key, frame.key)


def test_frames_of_a_folder_are_split_by_drive_and_have_no_depth(tmp_path, batches):
    for drive in ("a", "b", "c"):
        for number in range(3):
            path = tmp_path / drive / f"{number}.png"
            path.parent.mkdir(exist_ok=True)
            Image.new("RGB", (40, 24), (80 * "abc".index(drive), 90 * number, 40)).save(path)
    data = frames(root=tmp_path, effect=UniformFog(), size=SIZE, val_share=0.3, batch_size=6, workers=0)
    splits = [batches(data, training=training) for training in (True, False)]
    red = [{round(float(x) * 255) for batch in split for x in batch.clean[:, 0].flatten()} for split in splits]
    assert not red[0] & red[1]
    assert red[0] | red[1] == {0, 80, 160}
    # Without a depth map, fog assumes a ground plane.
    assert (splits[1][0].degraded - splits[1][0].clean).abs().amax(dim=(1, 2, 3)).min() > 0.1


def test_lightning_gets_the_same_pairs(first_epoch):
    data = scenes()
    data.trainer = trainer = Trainer(**QUIET)
    trainer.state.fn, trainer.training = "fit", True  # pyright: ignore[reportAttributeAccessIssue]  # a word for an enum
    frame = Frame(*next(iter(data.train_dataloader())))
    assert_same(by_key([data.on_after_batch_transfer(frame, 0)]), first_epoch)


def test_a_program_that_fails_beside_workers_that_ignore_sigterm_ends(tmp_path):
    script = tmp_path / "fails.py"
    script.write_text(FAILS)
    outcome = subprocess.run([sys.executable, script], check=False, timeout=60, stderr=subprocess.PIPE)
    assert (outcome.returncode, outcome.stderr) == (3, b"")


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"batch_size": 0}, ValueError, "batch_size must be at least 1, got 0"),
        ({"workers": -1}, ValueError, "workers must be at least 0, got -1"),
        ({"seed": -1}, ValueError, "seed must be at least 0, got -1"),
        ({"batch_size": 11}, ValueError, "batch_size must be at most the 10 training frames, got 11"),
        ({"batch_size": 2.5}, TypeError, "batch_size must be a whole number, got 2.5"),
    ],
)
def test_an_invalid_option_raises(options, error, message):
    data = RoadScenes(COUNT, size=SIZE)
    with pytest.raises(error, match=message):
        PairData(data, data, effect=UniformFog(), **options)
