import math

import pytest
import torch
import torch.nn.functional as F
from torch.testing import assert_close
from torch.utils.data import DataLoader

from torchrefract.data.road_scenes import RoadScenes, draw_scene, render_road_scenes
from torchrefract.data.road_scenes.bodies import plain
from torchrefract.data.road_scenes.geometry import (
    Shape,
    View,
    ball_sides,
    box_sides,
    ground_depth,
    meet_ball,
    meet_box,
    noise,
    rays,
)
from torchrefract.data.road_scenes.paint import band, dashes
from torchrefract.data.road_scenes.visibility import NO_BODY, Group, shadows, visibility

CENTER = ((0.0, 0.0),)
SAMPLES = 5  # rays a pixel


def one(value):
    return torch.full((1, 1, 1), float(value))


def camera(height=1.5, pitch=0.0, focal=1.0):
    """A camera that looks down by `pitch`."""
    c, s = one(math.cos(pitch)), one(math.sin(pitch))
    zero = one(0)
    return View(zero, one(height), one(focal), (one(1), zero, zero, zero, -c, -s, zero, -s, c))


def boxes(z, half=1.0, x=0.0):
    """Cubes on the ground that face the camera."""
    z = torch.tensor([z])
    full = torch.ones_like(z)
    size, none = full * half, 0 * full
    shape = Shape(full * x, size, z, full, none, size, size, size, none, full, none)
    return Group(shape, full.expand(3, 1, -1), full > 0, plain)


def points(*rows):
    x, y, z = torch.tensor(rows).unbind(1)
    return x, y, z


@pytest.fixture(scope="module")
def frames():
    return render_road_scenes(torch.arange(12), 36, 64)


def test_a_frame_has_the_same_bits_in_every_batch_and_order(frames):
    order = torch.tensor([7, 2, 11])
    for keys in (order, torch.tensor([7, 2, 11, 0, 5])):
        image, depth = render_road_scenes(keys, 36, 64)
        assert torch.equal(image[:3], frames[0][order])
        assert torch.equal(depth[:3], frames[1][order])
    for key in (0, 11):
        image, depth = render_road_scenes(torch.tensor([key]), 36, 64)
        assert torch.equal(image[0], frames[0][key])
        assert torch.equal(depth[0], frames[1][key])


def test_a_frame_has_the_same_bits_with_any_thread_count(on_threads):
    results = []
    for count in (1, 2, 3):
        on_threads(count)
        results.append(render_road_scenes(torch.arange(3), 90, 161))
    for image, depth in results[1:]:
        assert torch.equal(image, results[0][0])
        assert torch.equal(depth, results[0][1])


def test_images_lie_in_the_unit_range_and_are_no_flat_color(frames):
    image = frames[0]
    assert image.dtype == torch.float32
    assert image.min() >= 0
    assert image.max() <= 1
    assert image.flatten(1).std(dim=1).min() > 0.05


def test_keys_and_seeds_make_different_scenes(frames):
    image = frames[0]
    gap = (image[:, None] - image[None]).abs().mean(dim=(2, 3, 4)) + torch.eye(12)
    assert gap.min() > 0.02
    other, _ = render_road_scenes(torch.arange(12), 36, 64, seed=1)
    assert (other - image).abs().mean(dim=(1, 2, 3)).min() > 0.02


@pytest.mark.parametrize("pitch", [0.0, 0.05, -0.04])
def test_the_ground_lies_at_its_closed_form_depth(pitch):
    # A ray (0, v, 1) of a camera pitched by p falls by sin p + v cos p for each meter of depth.
    ray = rays(camera(height=1.4, pitch=pitch, focal=0.8), 9, 17, CENTER)
    v = (torch.arange(9, dtype=torch.float64) - 4) / (0.8 * 17)
    fall = math.sin(pitch) + v * math.cos(pitch)
    expected = torch.where(fall > 0, 1.4 / fall, math.inf).float()
    depth = ground_depth(camera(height=1.4), ray)
    assert_close(depth[0, 0], expected[:, None].expand(9, 17), rtol=1e-4, atol=0)


def test_the_drawn_camera_keeps_lengths_and_angles():
    turn = torch.stack([t.flatten() for t in draw_scene(torch.arange(8)).view.turn], dim=1).view(8, 3, 3)
    assert_close(turn @ turn.mT, torch.eye(3).expand(8, 3, 3), rtol=0, atol=1e-6)


def test_depth_puts_every_pixel_on_the_ground_or_above_it(frames):
    depth = frames[1][:, 0]
    view, groups = (scene := draw_scene(torch.arange(12))).view, scene.groups
    ray = rays(view, 36, 64, CENTER)
    _, slot = visibility(groups, view, ray, ground_depth(view, ray))
    seen, bare = depth.isfinite(), slot[0] == NO_BODY
    up = (view.height + depth * ray[1][0])[seen]
    # Rounding of the ray, 1e-7, times the depth, up to 1e4 m.
    assert up.min() > -2e-3
    assert_close(up[bare[seen]], torch.zeros_like(up[bare[seen]]), rtol=0, atol=2e-3)
    assert bare[seen].float().mean() > 0.3
    assert depth.min() > 0.5


def test_depth_is_infinite_exactly_in_the_sky(frames):
    depth = frames[1][:, 0]
    scene = draw_scene(torch.arange(12))
    ray = rays(scene.view, 36, 64, CENTER)
    sky = visibility(scene.groups, scene.view, ray, torch.full_like(ray[0], math.inf))[1][0] == NO_BODY
    assert torch.equal(depth.isinf(), sky & (ray[1][0] >= 0))
    assert depth.isinf().flatten(1).any(1).all()
    assert not depth.isnan().any()


def test_a_frame_three_times_as_large_has_the_same_depth_at_the_shared_centers(frames):
    large = render_road_scenes(torch.arange(5), 108, 192)[1][..., 1::3, 1::3]
    same = torch.isclose(large, frames[1][:5], rtol=1e-3)  # inf equals inf
    assert same.float().mean() > 0.995  # a pixel whose center lies on an outline may fall to either side


def test_a_frame_four_times_as_large_shows_the_same_scene(frames):
    large, _ = render_road_scenes(torch.arange(5), 144, 256)
    reduced, small = F.avg_pool2d(large, 4), frames[0][:5]
    # The mean of n values within a range R has at most the standard deviation R / (2 sqrt n).
    spread = F.max_pool2d(large, 6, 4, 1) + F.max_pool2d(-large, 6, 4, 1)
    bound = spread.mean() / (2 * math.sqrt(SAMPLES))
    assert (reduced - small).abs().mean() < bound
    # The bound tells scenes apart.
    assert (reduced - small.roll(1, 0)).abs().mean() > 2 * bound


@pytest.mark.parametrize("size", [(8, 8), (8, 200), (150, 9)])
def test_any_aspect_gives_finite_images(size):
    image, depth = render_road_scenes(torch.arange(3), *size)
    assert image.shape == (3, 3, *size)
    assert depth.shape == (3, 1, *size)
    assert not image.isnan().any()
    assert depth.min() > 0


@pytest.mark.parametrize("distances", [(10.0, 20.0), (20.0, 10.0)])
def test_the_nearer_body_hides_the_farther(distances):
    view = camera()
    ray = rays(view, 33, 33, CENTER)
    groups = [boxes([z]) for z in distances]
    for arrangement in (groups, [boxes(list(distances))]):
        depth, slot = visibility(arrangement, view, ray, ground_depth(view, ray))
        assert slot[0, 0, 16, 16] == distances.index(10.0)
        assert depth[0, 0, 16, 16] == pytest.approx(9.0)  # the face one meter before the middle


def test_a_body_covers_the_pixels_that_its_projection_does():
    view = camera()
    ray = rays(view, 33, 33, CENTER)
    ground = ground_depth(view, ray)
    depth, slot = visibility([boxes([10.0])], view, ray, ground)
    # The front face, 9 m away, goes from 33 * 0.5 / 9 = 1.8 px above row 16 to 33 * 1.5 / 9 = 5.5 px below it, and
    # 33 * 1 / 9 = 3.7 px to either side of column 16.
    assert slot[0, 0, :, 16].tolist() == [NO_BODY] * 15 + [0] * 7 + [NO_BODY] * 11
    assert slot[0, 0, 16].tolist() == [NO_BODY] * 13 + [0] * 7 + [NO_BODY] * 13
    assert torch.equal(depth[slot == NO_BODY], ground[slot == NO_BODY])


def test_a_box_throws_its_shadow_away_from_the_sun():
    view = camera(height=10.0, pitch=0.7)
    ray = rays(view, 65, 65, CENTER)
    ground = ground_depth(view, ray)
    sun = (one(-math.sqrt(0.5)), one(math.sqrt(0.5)), one(0))
    dark = shadows([boxes([10.0])], view, ray, ground, sun)
    x, z = ground * ray[0], ground * ray[2]
    # From 45 degrees on the left, a cube of 2 m shades the ground under it and 2 m to its right.
    inside = (x > -1) & (x < 3) & ((z - 10).abs() < 1)
    near_edge = torch.minimum(((x - 1).abs() - 2).abs(), ((z - 10).abs() - 1).abs()) < 0.02
    assert torch.equal(dark | near_edge, inside | near_edge)
    assert dark.any()


def test_a_ray_meets_a_gable_roof_where_its_planes_are():
    value = torch.ones(1)
    # Apex 2 m up at the ridge z = 10, eaves 1 m up at z = 9 and 11: y + |z - 10| <= 2.
    house = Shape(0 * value, value, 10 * value, value, 0 * value, value, value, value, value, value, value)
    depth, chord = meet_box(house, points([0.0, 1.5, 0.0]), points([0.0, 0.0, 1.0]))
    assert_close(depth, torch.tensor([9.5]))
    assert_close(chord, torch.tensor([1.0]))
    _, missed = meet_box(house, points([0.0, 2.1, 0.0]), points([0.0, 0.0, 1.0]))
    assert missed.item() <= 0
    sides = box_sides(house, points([0.0, 1.5, -0.5]))
    assert sides.roof.item()
    assert_close(torch.cat(sides.normal), torch.tensor([0.0, math.sqrt(0.5), -math.sqrt(0.5)]))


def test_a_ray_meets_an_ellipsoid_at_its_surface():
    value = torch.ones(1)
    crown = Shape(0 * value, value, 10 * value, value, 0 * value, 2 * value, value, 3 * value, 0 * value, value, value)
    depth, chord = meet_ball(crown, points([0.0, 1.0, 0.0]), points([0.0, 0.0, 1.0]))
    assert_close(depth, torch.tensor([7.0]))
    assert_close(chord, torch.tensor([1.0]))
    # Off by 0.6 of its half height, the chord is 0.8 of the full one.
    depth, chord = meet_ball(crown, points([0.0, 1.6, 0.0]), points([0.0, 0.0, 1.0]))
    assert_close(depth, torch.tensor([10 - 0.8 * 3]))
    assert_close(chord, torch.tensor([0.8]))
    assert_close(torch.cat(ball_sides(crown, points([0.0, 2.0, 0.0])).normal), torch.tensor([0.0, 1.0, 0.0]))


def test_noise_is_bounded_continuous_and_periodic():
    x, y = torch.rand(2, 500) * 64
    value = noise(x, y)
    assert value.abs().max() <= 1
    assert_close(noise(x + 256, y - 256), value, rtol=0, atol=1e-3)
    # No slope exceeds 2 (the lattice's range) times 3/2 (of the smooth step) along either axis.
    assert (noise(x + 1e-3, y) - value).abs().max() < 3.1e-3
    assert (noise(x, y + 1e-3) - value).abs().max() < 3.1e-3


def test_road_paint_keeps_its_area_under_every_footprint():
    position = torch.arange(0, 9, 0.01)
    for footprint in (0.02, 0.7, 5.0, 9.0):
        share = dashes(position, 9.0, 4.0, torch.tensor(footprint))
        assert share.mean().item() == pytest.approx(4 / 9, abs=1e-3)
        line = band(position - 4.5, 0.14, torch.tensor(min(footprint, 5.0)))
        assert line.sum().item() * 0.01 == pytest.approx(0.14, abs=1e-2)


def test_the_data_set_renders_the_keys_it_was_given():
    scenes = RoadScenes(5, size=[16, 24], seed=3, first=100)
    image, depth = render_road_scenes(torch.arange(100, 105), 16, 24, seed=3)
    assert len(scenes) == 5
    for index in (0, 4, -1):
        frame = scenes[index]
        assert frame.key.item() == 100 + index % 5
        assert torch.equal(frame.image, image[index])
        assert torch.equal(frame.depth, depth[index])


def test_a_loader_gives_the_frames_of_the_data_set():
    scenes = RoadScenes(5, size=(16, 24))
    batch = list(DataLoader(scenes, batch_size=3))[1]
    assert batch.key.tolist() == [3, 4]
    assert torch.equal(batch.image, torch.stack([scenes[3].image, scenes[4].image]))
    assert torch.equal(batch.depth, torch.stack([scenes[3].depth, scenes[4].depth]))
    assert scenes.__getitems__([]) == []


@pytest.mark.parametrize("index", [5, -6])
def test_an_index_out_of_range_is_refused(index):
    with pytest.raises(IndexError, match=r"index must lie in \[-5, 4\]"):
        RoadScenes(5)[index]


@pytest.mark.parametrize(
    ("arguments", "error", "match"),
    [
        ({"count": 0}, ValueError, "count must be at least 1, got 0"),
        ({"count": 2.0}, TypeError, "count must be a whole number"),
        ({"count": 1, "size": (64,)}, ValueError, r"size must be \(height, width\)"),
        ({"count": 1, "size": "64"}, ValueError, r"size must be \(height, width\)"),
        ({"count": 1, "size": (7, 64)}, ValueError, "size must be at least 8, got 7"),
        ({"count": 1, "seed": 0.5}, TypeError, "seed must be a whole number"),
        ({"count": 1, "first": None}, TypeError, "first must be a whole number"),
    ],
)
def test_bad_settings_are_refused(arguments, error, match):
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
def test_bad_arguments_of_the_renderer_are_refused(keys, height, error, match):
    with pytest.raises(error, match=match):
        render_road_scenes(keys, height, 8)
