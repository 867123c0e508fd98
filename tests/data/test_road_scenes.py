import math
import pickle
from typing import NamedTuple

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from torch.testing import assert_close
from torch.utils.data import DataLoader

from torchrefract import LensDistortion
from torchrefract.cli import restoration
from torchrefract.data.module import road_scenes
from torchrefract.data.road_scenes import RoadScenes, render_road_scenes
from torchrefract.data.road_scenes.render import Camera, render
from torchrefract.data.road_scenes.scene import Body, Panel, Scene, View, draw_scene, noise, textured


class Frames(NamedTuple):
    image: torch.Tensor
    depth: torch.Tensor


@pytest.fixture(scope="module")
def frames() -> Frames:
    return Frames(*render_road_scenes(torch.arange(8), 36, 64))


def scene_with(
    panels: list[Panel], *, casters: list[Panel] | None = None, height: float = 1.5, pitch: float = 0
) -> Scene:
    """A scene of some panels, seen by a camera at x = z = 0 that looks down by `pitch`."""
    c, s = math.cos(pitch), math.sin(pitch)
    view = View(np.array([0, height, 0]), np.array([[1, 0, 0], [0, -c, -s], [0, -s, c]]), 1.0)
    drawn = draw_scene(np.random.default_rng(0))
    drawn.light.sun = np.array([-1, 1, 0]) / math.sqrt(2)
    return Scene(drawn.road, view, drawn.light, panels, casters or [])


def wall(z: float, color: tuple[float, float, float] = (0.5, 0.5, 0.5), half_width: float = 1.0) -> Panel:
    return Body(0.0, z).upright(half_width, 2.0, textured(color, 0.0, 0.0))


@pytest.mark.quick
def test_a_frame_depends_on_its_key_and_seed_alone(frames):
    image, depth = render_road_scenes(torch.tensor([7, 2]), 36, 64)
    assert torch.equal(image, frames.image[[7, 2]])
    assert torch.equal(depth, frames.depth[[7, 2]])


def test_keys_and_seeds_make_different_scenes_in_the_unit_range(frames):
    assert frames.image.dtype == torch.float32
    assert 0 <= frames.image.min() < frames.image.max() <= 1
    assert frames.image.flatten(1).std(dim=1).min() > 0.05
    gap = (frames.image[:, None] - frames.image[None]).abs().mean(dim=(2, 3, 4)) + torch.eye(8)
    assert gap.min() > 0.02
    other, _ = render_road_scenes(torch.arange(8), 36, 64, seed=-1)
    assert (other - frames.image).abs().mean(dim=(1, 2, 3)).min() > 0.02


@pytest.mark.parametrize("pitch", [0.0, 0.05, -0.04])
def test_the_depth_of_bare_ground_has_its_closed_form(pitch):
    _, depth = render(scene_with([], height=1.4, pitch=pitch), 9, 17)
    # A ray (0, v, 1) of a camera pitched by p falls by sin p + v cos p for each meter of depth.
    fall = math.sin(pitch) + (np.arange(9) - 4) / 17 * math.cos(pitch)
    expected = np.where(fall > 1e-9, 1.4 / np.where(fall > 1e-9, fall, 1), np.inf)
    np.testing.assert_allclose(depth, np.broadcast_to(expected[:, None], (9, 17)), rtol=1e-4)


def test_the_drawn_camera_keeps_lengths_and_angles():
    for seed in range(4):
        axes = draw_scene(np.random.default_rng(seed)).view.axes
        np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)


def test_depth_puts_every_pixel_on_the_ground_or_above_it(frames):
    for key in range(8):
        camera = Camera(draw_scene(np.random.default_rng((0, key))).view, 36, 64)
        rise = camera.dot(np.array([0.0, 1.0, 0.0]), camera.frame)[0]
        depth = frames.depth[key, 0].numpy()
        seen = np.isfinite(depth)
        height = camera.position[1] + depth[seen] * rise[seen]
        # Rounding of the ray, 1e-7, times the depth, up to 1e4 m.
        assert height.min() > -2e-3
        assert (np.abs(height) < 2e-3).mean() > 0.3
        assert depth.min() > 0.5
        assert (rise[~seen] >= 0).all()
        assert (~seen).any()


def test_a_frame_three_times_as_large_has_the_same_depth_at_shared_pixel_centers(frames):
    large = render_road_scenes(torch.arange(4), 108, 192)[1][..., 1::3, 1::3]
    same = torch.isclose(large, frames.depth[:4], rtol=1e-3)  # inf equals inf
    assert same.float().mean() > 0.995  # a pixel whose center lies on an outline may fall to either side


def test_a_frame_four_times_as_large_shows_the_same_scene(frames):
    large, _ = render_road_scenes(torch.arange(4), 144, 256)
    reduced, small = F.avg_pool2d(large, 4), frames.image[:4]
    # The mean of five values within a range R has at most the standard deviation R / (2 sqrt 5).
    spread = F.max_pool2d(large, 6, 4, 1) + F.max_pool2d(-large, 6, 4, 1)
    bound = spread.mean() / (2 * math.sqrt(5))
    assert (reduced - small).abs().mean() < bound
    assert (reduced - small.roll(1, 0)).abs().mean() > 2 * bound


@pytest.mark.parametrize("size", [(8, 8), (8, 200), (150, 9)])
def test_any_aspect_gives_finite_images(size):
    image, depth = render_road_scenes(torch.arange(2), *size)
    assert image.shape == (2, 3, *size)
    assert depth.shape == (2, 1, *size)
    assert not image.isnan().any()
    assert depth.min() > 0


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_the_nearer_panel_hides_the_farther_one(order):
    panels = [wall(10.0, (1.0, 0.0, 0.0)), wall(20.0, (0.0, 1.0, 0.0), half_width=3.0)]
    image, depth = render(scene_with([panels[i] for i in order]), 33, 33)
    assert depth[16, 16] == pytest.approx(10.0)
    assert image[16, 16].argmax() == 0
    assert depth[16, 19] == pytest.approx(10.0)  # the edge of the near panel lies 3.3 px from the middle
    assert depth[16, 20] == pytest.approx(20.0)
    assert image[16, 20].argmax() == 1


def test_a_panel_covers_the_pixels_of_its_projection():
    _, depth = render(scene_with([wall(10.0)]), 33, 33)
    # Its edges lie 33 * 0.5 / 10 = 1.65 px above row 16, 33 * 1.5 / 10 = 4.95 px below it, 3.3 px left and right.
    covered = np.isclose(depth, 10.0)
    rows, columns = np.flatnonzero(covered[:, 16]), np.flatnonzero(covered[16])
    assert (rows[0], rows[-1], columns[0], columns[-1]) == (15, 20, 13, 19)


def test_half_of_the_scenes_show_a_curved_bonnet_a_meter_or_two_ahead():
    scenes = [draw_scene(np.random.default_rng((0, key))) for key in range(60)]
    with_bonnet = [scene for scene in scenes if scene.panels[-1].center[2] < 2]
    assert 20 <= len(with_bonnet) <= 40
    for scene in with_bonnet[:6]:
        image, depth = render(scene, 90, 160)
        road, far = render(scene._replace(panels=scene.panels[:-1]), 90, 160)
        bonnet = depth < 2.1
        assert (bonnet == (depth != far)).all()
        assert far.min() > 2.1
        assert depth.min() > 0.7
        edges = np.abs(image - road).max(axis=2) > 0
        assert edges[bonnet].mean() > 0.99
        assert not edges[:71].any()
        height = bonnet.sum(axis=0)  # the outline falls to both sides
        assert 3 <= height.max() <= 18
        assert height[[0, -1]].max() < height[60:100].max()


def test_a_panel_throws_its_shadow_away_from_the_sun():
    panel = Body(0.0, 10.0).panel((0, 1, 0), (0, 0, 1), (0, 1, 0), textured((0.5,) * 3, 0.0, 0.0))
    scene = scene_with([], casters=[panel], height=10.0, pitch=0.7)
    shaded, depth = render(scene, 65, 65)
    lit, _ = render(scene._replace(casters=[]), 65, 65)
    camera = Camera(scene.view, 65, 65)
    x, z = (depth * camera.dot(axis, camera.frame)[0] for axis in (np.eye(3)[0], np.eye(3)[2]))
    # The sun stands at 45 degrees on the left. A wall along z at x = 0, 2 m high, shades 2 m to its right.
    distance = np.maximum(np.abs(x - 1) - 1, np.abs(z - 10) - 1)
    dark = (lit - shaded).max(axis=2) > 0
    assert dark[distance < -0.2].all()
    assert not dark[distance > 0.2].any()


def test_noise_is_bounded_continuous_and_periodic():
    x, y = np.random.default_rng(0).uniform(0, 64, (2, 500))
    value = noise(x, y)
    assert np.abs(value).max() <= 1
    np.testing.assert_allclose(noise(x + 256, y - 256), value, atol=1e-9)
    # No slope exceeds 2, the range of the lattice, times 3/2, of the smooth step, along either axis.
    assert np.abs(noise(x + 1e-3, y) - value).max() < 3.1e-3
    assert np.abs(noise(x, y + 1e-3) - value).max() < 3.1e-3


@pytest.mark.quick
def test_the_data_set_renders_its_keys():
    scenes = RoadScenes(5, size=[16, 24], seed=3, first=100)
    image, depth = render_road_scenes(torch.arange(100, 105), 16, 24, seed=3)
    image = (image * 255).round() / 255  # the levels of a camera
    assert len(scenes) == 5
    for index in (0, 4, -1):
        frame = scenes[index]
        assert frame.key.item() == 100 + index % 5
        assert_close((frame.image, frame.depth), (image[index], depth[index]), rtol=0, atol=0)
    batch = list(DataLoader(scenes, batch_size=3))[1]
    assert batch.key.tolist() == [103, 104]
    assert torch.equal(batch.image, image[3:])
    for index in (5, -6):
        with pytest.raises(IndexError, match=r"index must lie in \[-5, 4\]"):
            scenes[index]


def test_frames_that_several_processes_render_are_kept_and_leave_the_random_numbers_of_a_training(monkeypatch):
    expected, scenes = RoadScenes(5, size=(16, 24), first=7), RoadScenes(5, size=(16, 24), first=7)
    state = torch.get_rng_state()
    assert list(scenes.render(processes=2)) == list(range(5))
    assert torch.equal(torch.get_rng_state(), state)
    assert not pickle.loads(pickle.dumps(scenes))._frames
    frames = [expected[i] for i in range(5)]
    monkeypatch.setattr("torchrefract.data.road_scenes.render.render_road_scenes", None)  # no frame is rendered again
    for index, frame in enumerate(frames):
        assert_close(tuple(scenes[index]), tuple(frame), rtol=0, atol=0)


@pytest.mark.parametrize("method", ["fork", "spawn"])
def test_a_training_renders_many_scenes_in_advance_where_its_workers_are_forked(monkeypatch, method):
    monkeypatch.setattr(restoration, "_MANY_PIXELS", 4 * 16 * 24)
    monkeypatch.setattr(restoration, "start_method", lambda: method)
    data = road_scenes(effect=LensDistortion(), size=(16, 24), train_count=5, val_count=4, batch_size=2)
    restoration._render_scenes(data)
    counts = [len(scenes._frames) for scenes in (data.train, data.val) if isinstance(scenes, RoadScenes)]
    assert counts == ([5, 0] if method == "fork" else [0, 0])  # few scenes are left to the loader


def test_only_frames_that_fit_the_memory_are_rendered_in_advance(monkeypatch):
    monkeypatch.setattr("torchrefract.data.road_scenes.render._KEPT_BYTES", 3 * 7 * 16 * 24 - 1)
    scenes = RoadScenes(5, size=(16, 24))
    assert scenes.num_kept == 3
    assert list(scenes.render(processes=0)) == [0, 1, 2]
    assert scenes[4].key == 4
    assert len(scenes._frames) == 3


@pytest.mark.parametrize(
    ("arguments", "error", "match"),
    [
        ({"count": 0}, ValueError, "count must be at least 1, got 0"),
        ({"count": 1, "size": (64,)}, ValueError, r"size must be \(height, width\)"),
        ({"count": 1, "size": (7, 64)}, ValueError, "size must be at least 8, got 7"),
        ({"count": 1, "seed": 0.5}, TypeError, "seed must be a whole number"),
    ],
)
def test_invalid_settings_raise(arguments, error, match):
    with pytest.raises(error, match=match):
        RoadScenes(**arguments)


@pytest.mark.parametrize(
    ("keys", "height", "error", "match"),
    [
        (torch.zeros(2, 2, dtype=torch.int64), 8, ValueError, r"keys must have shape \(B,\)"),
        (torch.zeros(0, dtype=torch.int64), 8, ValueError, r"keys must have shape \(B,\)"),
        (torch.zeros(2), 8, TypeError, "keys must be int64"),
        ([1], 8, TypeError, "keys must be a tensor"),
        (torch.zeros(2, dtype=torch.int64), 4, ValueError, "height must be at least 8"),
    ],
)
def test_invalid_arguments_of_the_renderer_raise(keys, height, error, match):
    with pytest.raises(error, match=match):
        render_road_scenes(keys, height, 8)
