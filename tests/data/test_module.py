from types import SimpleNamespace

import pytest
import torch
from PIL import Image
from pytorch_lightning import Trainer
from torch.testing import assert_close

from torchrefract import Frame, LensDistortion, Pair, UniformFog, presets
from torchrefract.data.module import PairData, frames, make_pair, road_scenes
from torchrefract.data.road_scenes import RoadScenes

SIZE = (12, 20)
COUNT = 10


def during(data: PairData, *, epoch: int = 0, training: bool = True, ranks: int = 1, rank: int = 0) -> PairData:
    """The data at a point of a run, as Lightning's trainer would tell it."""
    run = SimpleNamespace(training=training, current_epoch=epoch, world_size=ranks, global_rank=rank)
    data.trainer = run  # pyright: ignore[reportAttributeAccessIssue]  # what is read of a trainer, and no more
    return data


def scenes(*, workers: int = 0, batch_size: int = 4, seed: int = 0, effect: LensDistortion | UniformFog | None = None):
    effect = effect or LensDistortion()
    return road_scenes(
        effect=effect,
        size=SIZE,
        train_count=COUNT,
        val_count=5,
        batch_size=batch_size,
        workers=workers,
        seed=seed,
    )


def pairs(data: PairData) -> list[Pair]:
    """What a run would see: an epoch of training, or of validation where it validates."""
    assert data.trainer is not None
    loader = data.train_dataloader() if data.trainer.training else data.val_dataloader()
    if data.trainer.training:
        loader.sampler.set_epoch(data.trainer.current_epoch)  # pyright: ignore[reportAttributeAccessIssue]  # it is a DistributedSampler
    return [data.on_after_batch_transfer(Frame(*batch), 0) for batch in loader]


def by_key(batches: list[Pair]) -> dict[int, Pair]:
    samples = [Pair(*sample) for batch in batches for sample in zip(*batch, strict=True)]
    found = {int(sample.key): sample for sample in samples}
    assert len(found) == len(samples)
    return found


def test_keys_stay_where_draws_are_computed():
    frame = next(iter(during(scenes()).train_dataloader()))
    moved = scenes().transfer_batch_to_device(Frame(*frame), torch.device("meta"), 0)
    assert isinstance(moved, Frame)
    assert moved.image.is_meta
    assert moved.depth.is_meta
    assert torch.equal(moved.key, Frame(*frame).key)


def assert_same(found: dict[int, Pair], expected: dict[int, Pair]) -> None:
    for key in found.keys() & expected.keys():
        for name, a, b in zip(Pair._fields, found[key], expected[key], strict=True):
            assert torch.equal(a, b), f"{name} of frame {key}"


@pytest.fixture(scope="module")
def first_epoch():
    return by_key(pairs(during(scenes(batch_size=1))))


def test_a_pair_is_a_frame_and_what_the_effect_makes_of_it():
    image = torch.rand(2, 3, *SIZE)
    effect = LensDistortion()
    pair = make_pair(Frame(image, torch.tensor([5, 9]), torch.empty(2, 0)), effect, seed=3)
    expected = effect.degrade(image, seed=3, keys=[5, 9])
    assert expected.restore_flow is not None
    assert expected.restore_valid is not None
    key, none = torch.tensor([5, 9]), torch.empty(2, 0)
    made = Pair(expected.image, image, expected.restore_flow, expected.restore_valid, key, none)
    for name, found, value in zip(Pair._fields, pair, made, strict=True):
        assert torch.equal(found, value), name


@pytest.mark.parametrize(
    "scene", [UniformFog(), UniformFog(p=0.5), presets.paper_weather()], ids=["fog", "some", "any"]
)
def test_a_pair_has_the_transmission_that_it_is_asked_for(scene):
    image, keys = torch.rand(8, 3, *SIZE), torch.arange(8)
    pair = make_pair(Frame(image, keys, torch.empty(8, 0)), scene, seed=3, transmission=True)
    assert torch.equal(pair.transmission, scene.degrade(image, seed=3, keys=keys).transmission)
    untouched = (pair.degraded == image).flatten(1).all(dim=1)
    assert (pair.transmission[untouched] == 1).all()


def test_data_asked_for_a_transmission_has_it_in_training_and_validation():
    data = road_scenes(
        effect=UniformFog(), size=SIZE, train_count=4, val_count=4, batch_size=2, workers=0, transmission=True
    )
    for training in (True, False):
        for pair in pairs(during(data, training=training)):
            assert pair.transmission.shape == (2, 1, *SIZE)
            # More of the light comes through from the near road, at the bottom, than from the horizon.
            assert (pair.transmission[..., -1, :] > pair.transmission[..., 0, :]).all()


def test_an_effect_without_a_transmission_cannot_be_asked_for_it():
    frame = Frame(torch.rand(2, 3, *SIZE), torch.arange(2), torch.empty(2, 0))
    with pytest.raises(ValueError, match="effect must have a transmission, as fog has, got LensDistortion"):
        make_pair(frame, LensDistortion(), seed=0, transmission=True)


def test_an_effect_without_a_flow_cannot_be_asked_for_it():
    frame = Frame(torch.rand(2, 3, *SIZE), torch.arange(2), torch.empty(2, 0))
    with pytest.raises(ValueError, match="effect must have a flow, as a lens has, got UniformFog"):
        make_pair(frame, UniformFog(), seed=0, flow=True)
    # One that could move some sample has it, whatever was drawn.
    assert not make_pair(frame, LensDistortion(p=0.0), seed=0, flow=True).flow.any()


@pytest.mark.parametrize(
    ("effect", "asked", "message"),
    [
        (UniformFog(), {"flow": True}, "effect must have a flow, as a lens has, got UniformFog"),
        (LensDistortion(), {"transmission": True}, "effect must have a transmission, as fog has, got LensDistortion"),
    ],
)
def test_data_says_at_once_that_its_pairs_will_lack_a_map(effect, asked, message):
    data = road_scenes(effect=effect, size=SIZE, train_count=4, val_count=4, batch_size=2, workers=0, **asked)
    with pytest.raises(ValueError, match=message):
        data.check_pair()
    road_scenes(effect=effect, size=SIZE, train_count=4, val_count=4, batch_size=2, workers=0).check_pair()


def test_a_pair_in_fog_moves_nothing_and_is_valid_everywhere():
    pair = make_pair(Frame(torch.rand(2, 3, *SIZE), torch.arange(2), torch.empty(2, 0)), UniformFog(), seed=0)
    assert torch.equal(pair.flow, torch.zeros(2, 2, *SIZE))
    assert torch.equal(pair.valid, torch.ones(2, 1, *SIZE, dtype=torch.bool))


def test_a_pair_carries_no_gradient():
    effect = LensDistortion()
    image = torch.rand(1, 3, *SIZE, requires_grad=True)
    pair = make_pair(Frame(image, torch.zeros(1, dtype=torch.int64), torch.empty(1, 0)), effect, seed=0)
    assert not pair.degraded.requires_grad


def test_the_true_depth_of_a_scene_reaches_the_fog():
    # Fog of a known density over a frame: I = clean t + A (1 - t), t = exp(-k d), with the depth that was rendered.
    fog = UniformFog(visibility_range=(50.0, 50.0), deviation_range=(0.0, 0.0), airlight=0.8)
    batch = pairs(during(scenes(effect=fog), training=False))[0]
    rendered = [RoadScenes(5, size=SIZE, first=COUNT)[i] for i in range(len(batch.key))]
    k = -torch.tensor(0.05).log() / 50
    for i, frame in enumerate(rendered):
        t = torch.exp(-k * frame.depth)
        assert_close(batch.degraded[i], frame.image * t + 0.8 * (1 - t), rtol=0, atol=1e-5)
        assert frame.depth.isinf().any()


@pytest.mark.parametrize(("batch_size", "workers"), [(4, 0), (5, 0), (4, 2)])
def test_a_pair_depends_on_seed_epoch_and_key_alone(first_epoch, batch_size, workers):
    found = by_key(pairs(during(scenes(batch_size=batch_size, workers=workers))))
    assert len(found) == COUNT // batch_size * batch_size
    assert_same(found, first_epoch)


def test_each_epoch_of_training_has_draws_of_its_own(first_epoch):
    later = by_key(pairs(during(scenes(batch_size=1), epoch=1)))
    assert later.keys() == first_epoch.keys()
    for key, pair in later.items():
        assert torch.equal(pair.clean, first_epoch[key].clean)
        assert (pair.flow - first_epoch[key].flow).abs().max() > 1e-3


def test_validation_has_the_same_draws_in_every_epoch():
    first, later = (pairs(during(scenes(), training=False, epoch=epoch)) for epoch in (0, 7))
    assert [batch.key.tolist() for batch in first] == [batch.key.tolist() for batch in later]
    assert_same(by_key(later), by_key(first))


def test_validation_has_draws_that_no_epoch_of_training_has():
    frame = next(iter(scenes().val_dataloader()))
    seen = [during(scenes(), training=False).on_after_batch_transfer(Frame(*frame), 0).flow]
    seen += [during(scenes(), epoch=epoch).on_after_batch_transfer(Frame(*frame), 0).flow for epoch in range(20)]
    gaps = [(a - b).abs().amax(dim=(1, 2, 3)).min() for i, a in enumerate(seen) for b in seen[:i]]
    assert min(gaps) > 1e-6


def test_another_seed_shows_other_scenes_through_other_lenses(first_epoch):
    found = by_key(pairs(during(scenes(seed=1), epoch=0)))
    for key, pair in found.items():
        assert not torch.equal(pair.clean, first_epoch[key].clean)
        assert not torch.equal(pair.flow, first_epoch[key].flow)


def test_the_epochs_of_two_seeds_are_different_draws():
    frame = Frame(*next(iter(scenes().train_dataloader())))
    epochs = [
        during(scenes(seed=s), epoch=e).on_after_batch_transfer(frame, 0).flow for s in (0, 1, 2) for e in (0, 1, 2)
    ]
    gaps = [(a - b).abs().max() for i, a in enumerate(epochs) for b in epochs[:i]]
    assert min(gaps) > 1e-3


def test_the_order_of_training_changes_with_the_epoch_and_that_of_validation_does_not():
    first, later = ([batch.key.tolist() for batch in pairs(during(scenes(), epoch=epoch))] for epoch in (0, 1))
    assert first != later
    held = [key for batch in pairs(during(scenes(), training=False)) for key in batch.key.tolist()]
    assert held == list(range(COUNT, COUNT + 5))


def test_two_ranks_share_the_training_frames_and_each_has_its_own_draw(first_epoch):
    halves = [by_key(pairs(during(scenes(batch_size=1), ranks=2, rank=rank))) for rank in (0, 1)]
    assert not halves[0].keys() & halves[1].keys()
    assert halves[0].keys() | halves[1].keys() == first_epoch.keys()
    together = halves[0] | halves[1]
    assert_same(together, first_epoch)
    flows = [pair.flow for pair in together.values()]
    assert min((a - b).abs().max() for i, a in enumerate(flows) for b in flows[:i]) > 1e-3


def test_two_ranks_validate_every_frame():
    keys = [
        key
        for rank in (0, 1)
        for batch in pairs(during(scenes(), training=False, ranks=2, rank=rank))
        for key in batch.key.tolist()
    ]
    assert set(keys) == set(range(COUNT, COUNT + 5))


def test_training_and_validation_share_no_scene():
    data = scenes()
    assert not {int(f.key) for f in (data.train[i] for i in range(COUNT))} & {int(data.val[i].key) for i in range(5)}


def test_frames_of_a_folder_are_split_by_drive_and_have_no_depth(tmp_path):
    for drive in ("a", "b", "c"):
        for number in range(3):
            path = tmp_path / drive / f"{number}.png"
            path.parent.mkdir(exist_ok=True)
            Image.new("RGB", (40, 24), (80 * "abc".index(drive), 90 * number, 40)).save(path)
    data = frames(root=tmp_path, effect=UniformFog(), size=SIZE, val_share=0.3, batch_size=6, workers=0)
    trained, held = (pairs(during(data, training=training)) for training in (True, False))
    red = [
        {round(float(value) * 255) for batch in part for value in batch.clean[:, 0].flatten()}
        for part in (trained, held)
    ]
    assert not red[0] & red[1]
    assert red[0] | red[1] == {0, 80, 160}
    # Without a depth the fog takes a plane of its own: its veil is that of the rows, not of an empty tensor.
    assert (held[0].degraded - held[0].clean).abs().amax(dim=(1, 2, 3)).min() > 0.1


def test_lightning_itself_gets_the_same_pairs(first_epoch):
    data = scenes(workers=0)
    trainer = Trainer(
        logger=False,
        accelerator="cpu",
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
    )
    data.trainer = trainer
    trainer.state.fn, trainer.training = "fit", True  # pyright: ignore[reportAttributeAccessIssue]  # a word for an enum
    frame = Frame(*next(iter(data.train_dataloader())))
    assert_same(by_key([data.on_after_batch_transfer(frame, 0)]), first_epoch)


@pytest.mark.parametrize(
    ("words", "error", "message"),
    [
        ({"batch_size": 0}, ValueError, "batch_size must be at least 1, got 0"),
        ({"workers": -1}, ValueError, "workers must be at least 0, got -1"),
        ({"seed": -1}, ValueError, "seed must be at least 0, got -1"),
        ({"batch_size": 11}, ValueError, "batch_size must be at most the 10 training frames, got 11"),
        ({"batch_size": 2.5}, TypeError, "batch_size must be a whole number, got 2.5"),
    ],
)
def test_an_argument_out_of_range_is_refused(words, error, message):
    data = RoadScenes(COUNT, size=SIZE)
    with pytest.raises(error, match=message):
        PairData(data, data, effect=UniformFog(), **words)


def test_a_batch_that_no_rank_can_fill_is_refused_instead_of_training_on_nothing():
    data = during(scenes(batch_size=8), ranks=2, rank=0)
    with pytest.raises(ValueError, match="batch_size must be at most"):
        data.train_dataloader()
