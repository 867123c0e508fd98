"""Depth from networks: they are tiny, with random weights, but of the classes that users load."""

import json
import math
import os
import re
import sys
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import transformers
from pictures import save_media, save_picture
from stores import digests, failing_writes
from torch import Tensor
from torch.testing import assert_close

import torchrefract as tr
from torchrefract._validation import UsageError
from torchrefract.data.depth_maps import DepthFolder, read_depth, write_depth
from torchrefract.data.frames import FrameFolder
from torchrefract.data.images import pixels_of, read_image
from torchrefract.data.module import fingerprint, make_pair
from torchrefract.data.road_scenes import render_road_scenes
from torchrefract.data.road_scenes.scene import draw_scene
from torchrefract.depth import RoadSpreadError, TransformersDepth, from_transformers, road_scale
from torchrefract.fields.corridor import CorridorDepth
from torchrefract.fields.depth import GroundPlaneDepth, LinearDepth
from torchrefract.fields.sky import sky_mask
from torchrefract.types import Frame

# Nobody may reach the hub in a test.
pytestmark = pytest.mark.usefixtures("without_hub")


@pytest.fixture
def without_hub(monkeypatch) -> None:
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)


@pytest.fixture(scope="session")
def network(tmp_path_factory) -> Callable[[str], Path]:
    """Return a function that writes a tiny depth network of a type to a folder."""

    def write(kind: str) -> Path:
        folder = tmp_path_factory.mktemp(kind)
        torch.manual_seed(0)
        encoder: dict[str, Any] = {"hidden_size": 12, "num_hidden_layers": 2, "num_attention_heads": 2}
        encoder |= {"image_size": 28, "patch_size": 14}
        if kind == "dpt":
            neck = {"backbone_out_indices": [0, 0, 1, 1], "neck_hidden_sizes": [8] * 4, "fusion_hidden_size": 8}
            model = transformers.DPTForDepthEstimation(transformers.DPTConfig(**encoder, **neck, intermediate_size=16))
        else:
            stages: dict[str, Any] = {"out_features": ["stage1", "stage2"], "reshape_hidden_states": False}
            options = {"backbone_config": transformers.Dinov2Config(**encoder, **stages), "patch_size": 14}
            options |= {"reassemble_hidden_size": 12, "reassemble_factors": [2, 1], "neck_hidden_sizes": [8, 8]}
            options |= {"fusion_hidden_size": 8, "head_hidden_size": 8}
            options |= {"depth_estimation_type": kind, "max_depth": 80} if kind == "metric" else {}
            model = transformers.DepthAnythingForDepthEstimation(transformers.DepthAnythingConfig(**options))
        model.save_pretrained(folder)
        size = {"height": 28, "width": 28}
        processor = transformers.DPTImageProcessor(size=size, keep_aspect_ratio=True, ensure_multiple_of=14)
        processor.save_pretrained(folder)
        return folder

    return write


class ConstantDepth(TransformersDepth):
    """A provider whose network predicts a given depth (B, 1, H, W)."""

    depth: Tensor

    def _predict(self, image: Tensor) -> Tensor:
        return self.depth


def constant_network(depth: Tensor, **options) -> TransformersDepth:
    settings = {"scale": "road", "road": GroundPlaneDepth(), "max_spread": 0.3} | options
    provider = ConstantDepth(torch.nn.Identity(), None, **settings)
    provider.depth = depth
    return provider


@lru_cache
def roads(count: int, height: int, width: int) -> list[tuple[Tensor, Tensor, GroundPlaneDepth]]:
    """Return rendered roads with their true depth, and the flat road that their camera sees."""
    result = []
    for key in range(count):
        image, depth = render_road_scenes(torch.tensor([key]), height, width)
        view = draw_scene(np.random.default_rng((0, key))).view
        focal = view.focal * max(height, width)
        right_up, down_up, ahead_up = view.axes[:, 1]
        middle = height / 2 - 0.5 + focal * ahead_up / -down_up
        horizon = float((middle + 0.5) / height)
        camera_height = float(view.position[1])
        road = GroundPlaneDepth(camera_height=camera_height, focal=focal / width, horizon=horizon, far=math.inf)
        assert abs(right_up) < 0.2
        result.append((image, depth, road))
    return result


@pytest.mark.parametrize("factor", [0.5, 1.0, 2.0])
def test_the_scale_of_a_depth_is_recovered_from_the_road(factor):
    errors = []
    for _, depth, road in roads(12, 90, 160):
        result = road_scale(depth * factor, road)
        assert result.spread.item() < 0.3
        errors.append(abs(result.scale.item() * factor - 1))
    assert max(errors) < 0.1


def test_the_scale_makes_a_network_agree_with_the_road_and_the_sky_infinite():
    image, depth, road = roads(1, 90, 160)[0]
    wrong = torch.where(depth.isfinite(), 2 * depth, 500.0)
    result = constant_network(wrong, road=road)(image)
    assert result[sky_mask(image)].isinf().all()
    known = depth.isfinite() & result.isfinite()
    assert ((result / depth)[known].log10().abs() < math.log10(1.1)).float().mean() > 0.95
    trusted = constant_network(wrong, road=road, scale="model")(image)
    assert_close(trusted[known], 2 * depth[known])


def test_an_image_of_uint8_has_the_depth_of_a_floating_one(network):
    provider = from_transformers(network("metric"), scale="model")
    image = roads(1, 90, 160)[0][0]
    pixels = (image * 255).round().byte()
    assert sky_mask(pixels).any()
    assert_close(provider(pixels), provider(pixels / 255))


def test_a_scale_that_the_road_contradicts_raises_with_the_remedy():
    image = torch.rand(2, 3, 40, 60)
    noise = torch.exp(torch.randn(2, 1, 40, 60, generator=torch.Generator().manual_seed(0))) * 10
    provider = constant_network(noise)
    with pytest.raises(RoadSpreadError, match=r"spread of 0\.3.*scale=\"model\""):
        provider(image)
    assert all(isinstance(result, RoadSpreadError) for result in provider.each(image))


def test_maps_that_are_not_in_meters_are_refused():
    for image, depth, road in roads(12, 90, 160):
        inverse = 1 / torch.where(depth.isfinite(), depth, 1000.0)
        disparity, normalized = 500 * inverse, (inverse - inverse.amin()) / inverse.amax()
        for values in (disparity, normalized):
            with pytest.raises(ValueError, match="must be in m"):
                constant_network(values, road=road)(image)


def test_a_metric_network_serves_as_the_depth_of_fog(network):
    provider = from_transformers(network("metric"), scale="model")
    image = torch.rand(2, 3, 30, 44)
    depth = provider(image)
    assert depth.shape == (2, 1, 30, 44)
    assert depth.min() >= 0
    assert depth[depth.isfinite()].max() <= 80
    expected = tr.UniformFog().degrade(image, depth=depth, seed=0).image
    assert_close(tr.UniformFog(depth=provider).degrade(image, seed=0).image, expected)
    assert_close(tr.UniformFog().degrade(image, depth=provider, seed=0).image, expected)


def test_the_network_predicts_as_the_library_s_own_pipeline_does(network):
    folder = network("metric")
    image = torch.rand(1, 3, 42, 56)
    ours = from_transformers(folder, scale="model")._predict(image)
    processor = transformers.AutoImageProcessor.from_pretrained(folder)
    model = transformers.AutoModelForDepthEstimation.from_pretrained(folder).eval()
    picture = (image[0].permute(1, 2, 0) * 255).round().byte().numpy()
    with torch.no_grad():
        output = model(**processor(images=picture, return_tensors="pt"))
    theirs = processor.post_process_depth_estimation(output, target_sizes=[(42, 56)])[0]["predicted_depth"]
    assert_close(ours[0, 0], theirs, rtol=0.02, atol=0.05)


@pytest.mark.parametrize("kind", ["relative", "dpt"])
def test_relative_networks_are_refused(network, kind):
    with pytest.raises(ValueError, match=r"predicts? meters.*relative depth"):
        from_transformers(network(kind))


def test_without_a_network_the_error_names_the_folder_option():
    with pytest.raises(ValueError, match=r"or a folder of one \(download it elsewhere"):
        from_transformers("someone/no-such-depth-model")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [({"scale": "metric"}, "scale must be"), ({"road": 3}, "road must be"), ({"max_spread": 0}, "max_spread must be")],
)
def test_invalid_arguments_raise(network, arguments, message):
    with pytest.raises((ValueError, TypeError), match=message):
        from_transformers(network("metric"), **arguments)


# --- functions of the image as depth


@pytest.mark.parametrize(
    ("function", "error", "message"),
    [
        (lambda x: x[:, :1, :-1] * 100, ValueError, r"depth\(image\) must have shape \(2, 1, 20, 30\)"),
        (lambda x: 1.0, TypeError, r"depth\(image\) must be a tensor"),
        (lambda x: -x[:, :1] * 100, ValueError, r"depth\(image\) must be at least 0"),
        (lambda x: x[:, :1], ValueError, "not normalized"),
    ],
)
def test_a_function_that_gives_no_depth_raises(function, error, message):
    image = torch.rand(2, 3, 20, 30)
    for degrade in (
        lambda: tr.UniformFog(depth=function).degrade(image),
        lambda: tr.UniformFog().degrade(image, depth=function),
    ):
        with pytest.raises(error, match=message):
            degrade()


def test_a_function_sees_the_frames_of_clips():
    clip = torch.rand(2, 3, 3, 20, 30)
    seen = []

    def depth(image: Tensor) -> Tensor:
        seen.append(image)
        return 10 + 100 * image[:, :1]

    moving = tr.UniformFog().degrade(clip, depth=depth, seed=0).image
    assert seen[0].equal(clip.flatten(0, 1))
    given = tr.UniformFog().degrade(clip, depth=10 + 100 * clip[:, :, :1], seed=0).image
    assert_close(moving, given)


# --- the corridor


def log_error(depth: Tensor, truth: Tensor) -> float:
    known = truth.isfinite()
    ratio = depth.expand_as(truth)[known].clamp(1, 250) / truth[known].clamp(1, 250)
    return ratio.log10().abs().mean().item()


@pytest.mark.parametrize("effect", [tr.Turbulence, tr.UniformFog])
def test_a_function_sees_uint8_frames_as_floats(effect):
    image, seen = torch.randint(0, 256, (1, 3, 16, 20), dtype=torch.uint8), []
    effect(depth=lambda frames: seen.append(frames) or 50 + frames[:, :1]).degrade(image)
    assert_close(seen[0], image / 255)


def test_the_corridor_is_nearer_to_rendered_depth_than_a_flat_road_and_the_ramp():
    image, depth = render_road_scenes(torch.arange(16), 90, 160)
    size = {"dtype": torch.float32, "device": torch.device("cpu")}
    errors = [
        log_error(d, depth)
        for d in (CorridorDepth()(image), GroundPlaneDepth()(90, 160, **size), LinearDepth()(90, 160, **size))
    ]
    assert errors[0] < 0.8 * errors[1] < 0.8 * errors[2]


def test_the_corridor_is_nearer_to_lidar_than_a_flat_road_and_the_ramp(shared_data):
    size = {"dtype": torch.float32, "device": torch.device("cpu")}
    for name in ("clear_road_lidar", "haze_road_lidar"):
        folder = shared_data / "references" / name
        image = read_image(folder / "image_640x360.jpg")[None]
        truth = read_depth(folder / "depth_dense_derived_640x360.png")[0][None, None]
        focal = json.loads((folder / "meta.json").read_text())["fx"] / 1920
        road = {"focal": focal, "horizon": 0.55, "spread": 0.1}
        corridor = CorridorDepth(**road)(image)
        errors = [
            log_error(d, truth)
            for d in (corridor, GroundPlaneDepth(**road)(360, 640, **size), LinearDepth()(360, 640, **size))
        ]
        assert errors[0] < 0.8 * errors[1] < 0.8 * errors[2]
        t, flat, exact = (
            torch.exp(-3 * d / 100) for d in (corridor, GroundPlaneDepth(**road)(360, 640, **size), truth)
        )
        assert (t - exact).square().mean() < 0.85 * (flat - exact).square().mean()


@pytest.mark.filterwarnings("ignore:depth is that of a road")  # the warning has a test of its own, below
def test_walls_are_as_far_away_as_the_sky_above_them_is_low():
    image = torch.full((2, 3, 120, 200), 0.2)
    image[:, :, :31, :] = 0.9  # a skyline 29 rows above the horizon, whose row is 59.5
    image[1, :, :40, 150:] = 0.9  # 20 rows above it on the right
    depth = CorridorDepth(side=3.0, focal=1.0, spread=0.0, height=6.0)(image)
    at_skyline = 200 * (6.0 - 1.3) / torch.tensor([59.5 - 30, 59.5 - 39])
    assert_close(depth[:, 0, 50, 190], at_skyline)
    assert_close(depth[1, 0, 50, 20], at_skyline[0])
    assert depth[1, 0, 35, 20] < torch.inf == depth[1, 0, 35, 190]
    assert_close(depth[0, 0, 110, 190], torch.tensor(1.3 * 200 / 51.0), rtol=0.02, atol=0)  # the road hides the wall


@pytest.mark.filterwarnings("ignore:depth is that of a road")  # the warning has a test of its own, below
def test_a_tree_that_hangs_over_the_sky_is_as_near_as_one_of_two_and_a_half_heights():
    image = torch.full((1, 3, 120, 200), 0.2)
    image[:, :, :51] = 0.9
    image[:, :, 3:30, 150:170] = 0.2  # a crown, with the sky above and below it
    depth = CorridorDepth(side=1.0, focal=1.0, spread=0.0, height=6.0)(image)
    assert_close(depth[0, 0, 10, 160], torch.tensor(200 * (2.5 * 6.0 - 1.3) / (59.5 - 10)))
    assert_close(depth[0, 0, 55, 160], torch.tensor(200 * (6.0 - 1.3) / (59.5 - 50)))


@pytest.mark.filterwarnings("ignore:depth is that of a road")  # the warning has a test of its own, below
def test_the_end_of_a_frame_without_sky_moves_slowly_as_its_top_darkens():
    image = 0.35 + 0.5 * torch.rand(21, 3, 120, 192, generator=torch.Generator().manual_seed(0))
    for i, frame in enumerate(image):
        frame[:, : i // 2] = 0.15  # smooth and dark: that of a night from 5 % on
    depth = CorridorDepth(side=1e4, horizon=0.9)(image)[:, 0, 60, 96]
    assert depth[0] == pytest.approx(30, rel=0.01)
    assert depth[-1] == pytest.approx(300, rel=0.01)
    assert (1 / depth[:-1] - 1 / depth[1:]).max() < 0.5 * (1 / depth[0] - 1 / depth[-1])


def test_the_walls_stand_where_they_should_and_the_depth_is_announced_as_assumed():
    with pytest.warns(UserWarning, match="pass depth="):
        depth = CorridorDepth(side=6.0, focal=1.0, spread=0.0, far=1e9)(torch.zeros(1, 3, 100, 200))
    # A wall 6 m to the side, seen 50.5 px from the middle with a focal length of 200 px, and 30.5 px above the horizon.
    assert_close(depth[0, 0, 50, 150], torch.tensor(6.0 * 200 / 50.5))
    assert_close(depth[0, 0, 19, 150], torch.tensor(6.0 * 200 / math.hypot(50.5, 30.5)))
    # The road 40.5 px below the horizon: 1.3 m below the camera.
    assert_close(depth[0, 0, 90, 100], torch.tensor(1.3 * 200 / 41.0), rtol=0.02, atol=0)


@pytest.mark.parametrize("shape", [(3, 100, 200), (1, 2, 3, 100, 200)])
def test_the_corridor_of_images_of_another_shape_raises(shape):
    with pytest.raises(ValueError, match=r"image must have shape \(B, C, H, W\), got"):
        CorridorDepth()(torch.zeros(shape))


@pytest.mark.filterwarnings("ignore:depth is that of a road")  # scenes assume a depth; the test is of others
def test_a_frame_by_day_that_shows_no_sky_ends_near_without_a_column():
    generator = torch.Generator().manual_seed(0)
    trees = 0.2 + 0.3 * torch.rand(1, 3, 90, 160, generator=generator)
    sky = trees.clone()
    sky[:, :, :45] = 0.9
    depth = CorridorDepth(far=300.0, closed=30.0)(torch.cat([trees, sky, 0.05 * trees]))
    assert depth[0].max() == pytest.approx(30, rel=0.01)
    assert depth[1].isinf().any()
    assert depth[2].max() > 200  # the end of a street at night is not seen
    in_fog = torch.exp(-3 * depth[0, 0] / 100)  # transmission at a visibility of 100 m
    assert in_fog.diff(dim=1).abs().max() < 0.02
    assert in_fog[:45].diff(dim=0).abs().max() < 0.02


# --- the command


def write_frames(folder: Path) -> list[Path]:
    images, _ = render_road_scenes(torch.arange(3), 56, 84)
    paths = [folder / "frames" / name for name in ("a.png", "b/c.jpg", "b/d.png")]
    for path, image in zip(paths, images, strict=True):
        save_picture(path, pixels_of(image))
    return paths


def test_the_command_writes_maps_that_fog_and_pairs_use_and_continues(call, network, tmp_path):
    write_frames(tmp_path)
    words = ("source=frames", "out=depth", f"network={network('metric')}", "scale_by=model", "batch=2")
    outcome = call("estimate_depth", *words)
    assert outcome.code == 0, outcome.err
    assert "3 depth maps written, 0 frames skipped" in outcome.out
    maps = [tmp_path / "depth" / name for name in ("a.png", "b/c.png", "b/d.png")]
    times = [path.stat().st_mtime_ns for path in maps]
    maps[1].unlink()
    assert "1 depth maps written" in call("estimate_depth", *words).out
    assert [path.stat().st_mtime_ns for path in maps][::2] == times[::2]
    for word in ("scale_by=road", "source=frames/b"):
        *_, message = call("estimate_depth", *words, word).err.splitlines()  # transformers prints its progress
        assert message.startswith("error: out must be a folder of the same configuration, got depth, where")
    folder = DepthFolder(tmp_path / "depth")
    depth = folder.read("b/c.jpg", frame_size=(56, 84), size=None)
    image = read_image(tmp_path / "frames" / "b" / "c.jpg")[None].contiguous()
    expected = from_transformers(network("metric"), scale="model")(image)[0]
    assert depth.isinf().equal(expected.isinf())
    assert (depth - expected)[expected.isfinite()].abs().max() <= 1 / 512 + 1e-4

    options = ("scene=cape_town_fog", "source=frames", "license=CC0", "workers=0", "depth=depth")
    outcome = call("generate", *options, "out=pairs")
    assert outcome.code == 0, outcome.err
    stored = sorted((tmp_path / "pairs").rglob("*.depth.png"))
    assert len(stored) == 3
    assert any(read_depth(path)[0].equal(read_depth(maps[1])[0]) for path in stored)
    maps[0].unlink()
    message = call("generate", *options, "out=other").message
    assert re.fullmatch(r"depth must be a folder with a map for each frame, got none for a\.png in depth .*", message)


def test_pairs_are_not_continued_with_other_depth_maps_of_the_same_size(call, tmp_path):
    write_frames(tmp_path)
    (tmp_path / "depth" / "b").mkdir(parents=True)
    for name in ("a", "b/c", "b/d"):
        np.save(tmp_path / "depth" / f"{name}.npy", np.full((56, 84), 20.0, np.float32))
    words = ("scene=cape_town_fog", "source=frames", "license=CC0", "workers=0", "depth=depth", "out=pairs")
    assert call("generate", *words).code == 0
    path = tmp_path / "pairs" / "config.json"
    config = json.loads(path.read_text())
    assert "3 pairs exist already" in call("generate", *words).out
    np.save(tmp_path / "depth" / "b/c.npy", np.full((56, 84), 30.0, np.float32))
    message = call("generate", *words).message
    assert message.startswith("out must be a folder of the same configuration, got pairs, where depth_content is ")
    del config["settings"]["depth_content"]  # as of an earlier version
    path.write_text(json.dumps(config))
    assert "3 pairs exist already" in call("generate", *words).out


def test_a_picture_that_changed_after_its_map_was_written_gets_another_one_but_not_beside_maps_of_others(
    call, network, tmp_path
):
    write_frames(tmp_path)
    words = ("source=frames", "out=depth", f"network={network('metric')}", "scale_by=model")
    assert call("estimate_depth", *words).code == 0
    os.utime(tmp_path / "frames" / "a.png")
    assert "1 depth maps written" in call("estimate_depth", *words).out
    assert "0 depth maps written" in call("estimate_depth", *words).out
    (tmp_path / "depth" / "config.json").unlink()  # as of maps of another program
    os.utime(tmp_path / "frames" / "a.png")
    assert "0 depth maps written" in call("estimate_depth", *words).out


def test_maps_in_a_store_are_those_on_disk_and_serve_as_depth(call, network, memory, tmp_path):
    write_frames(tmp_path)
    memory.put(str(tmp_path / "frames"), "/frames", recursive=True)
    words = (f"network={network('metric')}", "scale_by=model", "batch=1")
    stores = ("source=memory://frames", "out=memory://depth")
    with failing_writes(KeyboardInterrupt(), suffix="c.png"):
        assert call("estimate_depth", *words, *stores).code == 130
    assert "memory://depth: 2 depth maps written" in call("estimate_depth", *words, *stores).out
    assert "memory://depth: 0 depth maps written" in call("estimate_depth", *words, *stores).out
    assert call("estimate_depth", *words, "source=frames", "out=depth").code == 0
    on_disk, in_store = digests(tmp_path / "depth"), digests("memory://depth")
    assert all(on_disk[name] == data for name, data in in_store.items() if name.endswith(".png"))

    options = ("scene=cape_town_fog", "source=frames", "workers=0")
    for command, more in (("degrade", ()), ("generate", ("license=CC0",))):
        for out, depth in ((f"{command}1", "depth"), (f"{command}2", "memory://depth")):
            outcome = call(command, *options, *more, f"depth={depth}", f"out={out}")
            assert (outcome.code, "assumes" in outcome.err) == (0, False)
        first, second = ({p.name: p.read_bytes() for p in (tmp_path / f"{command}{k}").rglob("*.*g")} for k in (1, 2))
        assert first == second
        assert first
    on_disk, in_store = (
        FrameFolder(f"{root}frames", size=(28, 42), depth=f"{root}depth") for root in ("", "memory://")
    )
    assert len(on_disk) == len(in_store)
    assert all(on_disk[i].depth.equal(in_store[i].depth) for i in range(len(on_disk)))
    memory.rm("/depth/a.png")
    message = call("generate", *options, "license=CC0", "depth=memory://depth", "out=other").message
    assert message.startswith("depth must be a folder with a map for each frame, got none for a.png in memory://depth")


def test_a_run_without_a_map_leaves_no_folder_and_a_wrong_device_is_named(call, network, tmp_path):
    write_frames(tmp_path)
    words = ("source=frames", "out=depth", f"network={network('metric')}")
    error = call("estimate_depth", *words, "max_spread=1e-9").err
    assert error.splitlines()[-1].startswith("error: source must hold a frame whose depth can be estimated")
    assert error.count("skipped: ") == 3
    assert "spread of 1e-09" in error
    assert not (tmp_path / "depth").exists()
    assert call("estimate_depth", *words, "scale_by=model").code == 0
    message = call("estimate_depth", *words, "device=tpu").message
    assert message == "device must be auto, cpu or another device of this machine, got tpu"


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("network=someone/no-such-model", "network must be a depth model of the hub that can be reached, or a folder"),
        ("network=frames", "network: "),  # that of transformers
        ("scale_by=meters", "scale_by must be one of road, model, got 'meters'"),
        ("max_spread=-1", "max_spread must be above 0, got -1"),
        ("road.camera_height=-1", "road.camera_height must be above 0, got -1"),
        ("road.horizon=low", "road.horizon must be a real number, got 'low'"),
    ],
)
def test_an_invalid_option_of_the_command_is_named_as_the_command_has_it(call, tmp_path, word, message):
    write_frames(tmp_path)
    *_, line = call("estimate_depth", "source=frames", "out=depth", word).err.splitlines()
    assert line.startswith(f"error: {message}")


def test_two_pictures_that_would_share_a_map_raise(call, tmp_path):
    write_frames(tmp_path)
    (tmp_path / "frames" / "a.jpg").write_bytes((tmp_path / "frames" / "b" / "c.jpg").read_bytes())
    message = call("estimate_depth", "source=frames", "out=depth", "network=unused").message
    assert re.search(r"got one path, depth/a\.png, for a\.jpg and a\.png: give the frames names that differ", message)
    (tmp_path / "depth").mkdir(exist_ok=True)
    for name in ("a", "b/c", "b/d"):
        (tmp_path / "depth" / name).parent.mkdir(exist_ok=True)
        write_depth(tmp_path / "depth" / f"{name}.png", torch.full((56, 84), 20.0))
    with pytest.raises(UsageError, match=r"for a\.jpg and a\.png"):
        FrameFolder(tmp_path / "frames", size=(28, 42), depth=tmp_path / "depth")


def test_frames_for_training_carry_their_depth(tmp_path):
    write_frames(tmp_path)
    for k, name in enumerate(("a", "b/c", "b/d")):
        (tmp_path / "depth" / name).parent.mkdir(parents=True, exist_ok=True)
        depth = torch.full((56, 84), 20.0 + k)
        depth[:10] = math.inf
        write_depth(tmp_path / "depth" / f"{name}.png", depth)
    frames = FrameFolder(tmp_path / "frames", size=(28, 42), depth=tmp_path / "depth")
    samples = [frames[k] for k in range(3)]
    for k, frame in enumerate(samples):
        assert frame.depth.shape == (1, 28, 42)
        assert frame.depth[:, :5].isinf().all()
        assert_close(frame.depth[:, 5:], torch.full((1, 23, 42), 20.0 + k))
    assert fingerprint(frames)["depth"] == str(tmp_path / "depth")
    data = {name: torch.stack([getattr(frame, name) for frame in samples]) for name in ("image", "key", "depth")}
    pair = make_pair(Frame(**data), tr.UniformFog(visibility_range=(50, 50)), seed=0, transmission=True)
    assert pair.transmission[:, :, :5].max() == 0
    assert pair.transmission[0, 0, 10, 0] > pair.transmission[2, 0, 10, 0] > 0


@pytest.mark.parametrize("command", ["train", "degrade", "generate"])
def test_a_map_that_is_not_in_meters_is_named_in_one_line_of_error(call, small, tmp_path, command):
    for path in write_frames(tmp_path):
        target = tmp_path / "depth" / path.relative_to(tmp_path / "frames").with_suffix(".npy")
        target.parent.mkdir(parents=True, exist_ok=True)
        np.save(target, np.linspace(math.nan if path.stem == "a" else 50, 5, 56 * 84).reshape(56, 84))
    words = ["scene=cape_town_fog", "source=frames", "depth=depth", "workers=0", "out=out"]
    words += ["license=CC0"] if command == "generate" else []
    if command == "train":  # a worker reads the maps
        words = ["+task=deweather", *(word for word in small if "count" not in word), "data=frames", "data.root=frames"]
        words += ["data.depth=depth", "data.workers=1", "data.batch_size=1", "data.val_share=0.34"]
    message = call(command, *words).message
    assert message == "depth/a.npy: depth must be at least 0, in m, got nan"


def test_a_missing_library_is_named(call, tmp_path, monkeypatch):
    write_frames(tmp_path)
    monkeypatch.setitem(sys.modules, "transformers", None)
    message = call("estimate_depth", "source=frames", "out=depth", "network=anywhere").message
    assert message == 'network: depth networks need transformers: pip install "torchrefract[depth]"'


def test_the_frames_of_videos_have_maps_by_their_numbers(call, network, tmp_path):
    (tmp_path / "drives").mkdir()
    save_media(tmp_path / "drives" / "a.mp4", [np.full((56, 84, 3), 40 * k, np.uint8) for k in range(3)])
    words = ("source=drives", "out=depth", f"network={network('metric')}", "scale_by=model")
    assert call("estimate_depth", *words).code == 0
    assert sorted(path.name for path in (tmp_path / "depth" / "a.mp4").iterdir()) == [f"{k:06d}.png" for k in range(3)]
