from functools import partial

import numpy as np
import pytest
import torch
from torch.nn.functional import avg_pool2d
from torch.testing import assert_close

from torchrefract import Frame, Pair, presets
from torchrefract.data.images import fit
from torchrefract.data.module import frames as frame_data
from torchrefract.data.module import make_pair, pairs
from torchrefract.data.pairs.dataset import PairedFolder
from torchrefract.data.pairs.files import (
    PairArrays,
    count_out_of_range,
    decode_flow,
    decode_pair,
    encode_flow,
    encode_pair,
)
from torchrefract.restoration.tasks import Undistort

SIZE = (32, 48)


@pytest.fixture(scope="module")
def sets(tmp_path_factory):
    return tmp_path_factory.mktemp("sets")


@pytest.fixture
def made(call, words, sets):
    """Return a function that gives pairs of the frames, which its first call for a scene and options writes."""

    def make(*more: str, scene: str = "paper_refractive"):
        out = sets / "_".join((scene, *more)).replace("=", "_")
        if not out.exists():
            assert call("generate", *words(out, *more, scene=scene)).code == 0
        return out

    return make


@pytest.mark.parametrize(
    ("scene", "maps"),
    [
        *(("paper_refractive", "png"), ("paper_refractive", "npz")),
        *(("paper_weather", "png"), ("paper_weather", "safetensors")),
    ],
)
def test_pairs_from_disk_equal_pairs_on_the_fly(made, frames, batches, scene, maps):
    has_light = scene == "paper_weather"
    options = {"batch_size": 4, "workers": 0, "transmission": has_light}
    effect = presets.paper_weather() if has_light else presets.paper_refractive(width=192)
    stored, live = (
        pairs(root=made(f"maps={maps}", scene=scene), **options),
        frame_data(root=frames, effect=effect, size=SIZE, **options),
    )
    for training in (True, False):
        for disk, fly in zip(batches(stored, training=training), batches(live, training=training), strict=True):
            assert torch.equal(disk.key, fly.key)
            assert torch.equal(disk.valid, fly.valid)
            assert torch.equal(disk.clean, fly.clean)
            assert (disk.degraded - fly.degraded).abs().max() <= 0.5 / 255 + 1e-6
            assert (disk.flow - fly.flow).abs().max() <= (0.5 / 64 if maps == "png" else 0)
            if has_light:
                assert not disk.flow.any()
                assert disk.valid.all()
                assert disk.transmission.shape == (4, 1, *SIZE)
                assert (disk.transmission - fly.transmission).abs().max() <= (0.51 / 65535 if maps == "png" else 0)


@pytest.mark.parametrize("scene", ["paper_refractive", "paper_weather"])
def test_reduced_pairs_are_means_of_the_center_in_px_of_the_new_size(made, scene):
    out, options = made(scene=scene), {"transmission": scene == "paper_weather"}
    full, small = PairedFolder(out, **options), PairedFolder(out, size=(8, 8), **options)
    for pair, reduced in ((full[i], small[i]) for i in range(len(full))):
        middle = slice((SIZE[1] - SIZE[0]) // 2, (SIZE[1] + SIZE[0]) // 2)
        for name in ("degraded", "clean", "transmission") if options["transmission"] else ("degraded", "clean"):
            expected = avg_pool2d(getattr(pair, name)[:, :, middle], 4)
            assert (getattr(reduced, name) - expected).abs().max() <= 1e-6
        flow = avg_pool2d(pair.flow[:, :, middle], 4) / 4
        assert (reduced.flow - flow).abs().max() <= 1e-6
        is_complete = avg_pool2d(pair.valid[:, :, middle].float(), 4) == 1
        x, y = torch.meshgrid(torch.arange(8), torch.arange(8), indexing="xy")
        ends = torch.stack([x, y]) + flow
        is_inside = ((ends > -1e-3) & (ends < 7 + 1e-3)).all(dim=0)
        assert torch.equal(reduced.valid, is_complete & is_inside)
        assert reduced.key == pair.key
    pair, uneven = full[0], PairedFolder(out, size=(10, 15))[0]  # 3.2 px
    assert torch.equal(uneven.clean, fit(pair.clean, (10, 15)))
    assert_close(uneven.flow.mean(dim=(1, 2)), pair.flow.mean(dim=(1, 2)) / 3.2, rtol=0, atol=1e-5)
    with pytest.raises(ValueError, match="image must be at least size = 8x49"):
        PairedFolder(out, size=(8, 49))[0]


def test_a_reduced_pair_is_the_pair_of_the_reduced_frame(made):
    """The lens of a key is the same at any size of the frame; the zoom that fills frames depends on its pixels."""
    out, effect = made("+scene.frame=pad", scene="cheap_dashcam"), presets.cheap_dashcam(frame="pad")
    small = PairedFolder(out, size=(16, 24), flow=True)
    for i in range(3):
        row, pair = small.row(i), small[i]
        frame = Frame(pair.clean[None], torch.tensor([row.key]), torch.empty(0))
        expected = make_pair(frame, effect, seed=row.seed)
        both = pair.valid & expected.valid[0]
        assert both.float().mean() > 0.7
        # A mean over 2 x 2 px is off by an eighth of the curvature; the file rounds to 1/128 px of the larger frame.
        assert (pair.flow - expected.flow[0]).abs()[both.expand(2, -1, -1)].max() < 0.02  # px
        assert expected.flow.abs().max() > 0.5


def test_pairs_without_a_required_map_raise(made):
    weather, moved = made(scene="paper_weather"), made()
    with pytest.raises(ValueError, match=r"as of fog, got pair 0 of the scene paper_refractive in .* without"):
        PairedFolder(moved, transmission=True)[0]
    with pytest.raises(ValueError, match=r"as of a lens, got pair \d+ of the scene paper_weather in .* without"):
        pairs(root=weather, batch_size=4, workers=0, flow=True).check_pair()
    pairs(root=moved, batch_size=4, workers=0, flow=True).check_pair()


def test_training_from_disk_has_the_losses_of_training_on_the_fly(made, frames, batches):
    stored = pairs(root=made(), batch_size=2, workers=0)
    live = frame_data(root=frames, effect=presets.paper_refractive(width=192), size=SIZE, batch_size=2, workers=0)
    losses = []
    for data in (stored, live):
        torch.manual_seed(0)
        task, network = Undistort(), torch.nn.Conv2d(3, 2, 5, padding=2)
        optimizer, values = torch.optim.SGD(network.parameters(), lr=0.003), []
        epoch = batches(data, training=True)
        for batch in (20 * epoch)[:20]:
            loss = task.loss(task.restore(network(batch.degraded), batch.degraded), batch)
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            values.append(loss.item())
        losses.append(torch.tensor(values))
    # 1/255 of an image rounded, on the average a quarter of it, and 1/64 px of a flow likewise, in halves of 48 px.
    assert (losses[0] - losses[1]).abs().max() <= 0.25 / 255 + 0.25 / 64 / 16
    assert losses[1][-1] < 0.6 * losses[1][0]


def test_files_and_tars_hold_the_same_pairs(made):
    folder, tars = PairedFolder(made()), PairedFolder(made("tar=5"))
    assert len(folder) == len(tars) == 12
    for i in range(12):
        for name, a, b in zip(Pair._fields, folder[i], tars[i], strict=True):
            assert torch.equal(a, b), name


def test_concatenated_manifests_of_shards_are_one_set(made, call, words, tmp_path):
    for shard in range(3):
        assert call("generate", *words("shards", "shards=3", f"shard={shard}")).code == 0
    out = tmp_path / "shards"
    texts = [path.read_text() for path in sorted(out.glob("manifest-*"), reverse=True)]
    for path in out.glob("manifest-*"):
        path.unlink()
    (out / "manifest.jsonl").write_text("".join(texts))
    one, several = PairedFolder(made(), split="val"), PairedFolder(out, split="val")
    assert [one.row(i) for i in range(len(one))] == [several.row(i) for i in range(len(several))]


def test_the_remedy_for_a_set_without_pairs_for_validation_is_named(made, tmp_path):
    lines = (made() / "manifest.jsonl").read_text().splitlines(keepends=True)
    (tmp_path / "manifest.jsonl").write_text("".join(line for line in lines if '"split":"train"' in line))
    assert len(PairedFolder(tmp_path, split="train")) == len(PairedFolder(made(), split="train"))
    with pytest.raises(ValueError, match=r"got none in .*; generate it from frames of two or more drives"):
        PairedFolder(tmp_path, split="val")


@pytest.mark.quick
def test_pixels_of_a_flow_beyond_512_px_are_marked_as_invalid():
    flow = np.zeros((2, 1, 5), np.float32)
    flow[0, 0], flow[1, 0] = [0, 511.98, 512, -512, -513], [0, 0, 0, 0, 0]
    valid = np.array([[True, True, True, True, True]])
    decoded, mask = decode_flow(encode_flow(flow, valid))
    assert mask.tolist() == [[True, True, False, True, False]]
    assert np.abs(decoded - flow)[:, mask].max() <= 1 / 128
    assert count_out_of_range({"flow": flow, "valid": valid}) == {"flow": 2}


@pytest.mark.quick
def test_pixels_that_the_png_of_a_flow_clips_are_not_valid_in_a_pair():
    flow, image = np.zeros((2, 1, 3), np.float32), np.zeros((1, 3, 3), np.uint8)
    flow[0, 0] = [0, 511, 600]
    valid = np.array([[False, True, True]])
    maps = {"flow": flow, "valid": valid, "restore_flow": flow, "restore_valid": valid}
    for form, expected in (("png", [False, True, False]), ("npz", [False, True, True])):
        files = encode_pair(PairArrays(image, image, maps), form)
        decoded = decode_pair({name: partial(bytes, data) for name, data in files.items()}).maps
        for name in ("valid", "restore_valid"):
            assert decoded[name][0].tolist() == expected
