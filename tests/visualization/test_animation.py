from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from pictures import load_clip, load_frames
from PIL import Image, ImageSequence
from torch import Tensor

import torchrefract as tr
from torchrefract._validation import UsageError
from torchrefract.effects.base import Effect
from torchrefract.visualization.animation import (
    Animation,
    FrameSequence,
    animation_formats,
    make_animation,
    save_animation,
)
from torchrefract.visualization.color import flow_to_rgb, transmission_to_rgb

SIZE = (24, 40)  # displayed with 8 x 8 px for each pixel
FAST: dict[str, Any] = {"wind_x_range": (2.0, 2.0), "decorrelation_range": (2.0, 4.0)}
TURBULENCE = tr.Turbulence(amplitude_range=(1.0, 1.0), length_range=(8.0, 8.0), **FAST)
FLARE = tr.LensFlare(center_x_range=(0.3, 0.3), drift_x_range=(0.05, 0.05), strength_range=(0.4, 0.4))
FOG = tr.UniformFog(visibility_range=(100.0, 100.0))
LENS = tr.LensDistortion()
EFFECTS: dict[str, Effect] = {"turbulence": TURBULENCE, "flare": FLARE, "fog": FOG}
# Largest mean difference of a decoded image, of 255.
LOSSES = {".apng": 0.0, ".gif": 5.0, ".webp": 5.0, ".mp4": 8.0}


@pytest.fixture
def frame() -> Tensor:
    """Return a smooth frame (1, 3, 24, 40), which every codec can hold."""
    y, x = torch.meshgrid(torch.linspace(0, 1, SIZE[0]), torch.linspace(0, 1, SIZE[1]), indexing="ij")
    return (0.4 + 0.3 * torch.sin(9 * x + 5 * y) + 0.1 * torch.stack([x, y, 1 - x]))[None]


def repeated(image: Tensor, num_frames: int) -> FrameSequence:
    return FrameSequence(num_frames, lambda times: ((t, image) for t in times))


def displayed(image: Tensor) -> np.ndarray:
    """Return an image (1, 3, 24, 40) as displayed, (h, w, 3), uint8."""
    large = image[0].clamp(0, 1).repeat_interleave(8, dim=1).repeat_interleave(8, dim=2)
    return (255 * large).round().byte().movedim(0, -1).numpy()


def decoded(path: Path) -> np.ndarray:
    """Return the pictures of a file, (T, height, width, 3)."""
    return np.stack(load_clip(path) if path.suffix == ".mp4" else load_frames(path))


def cell(pictures: np.ndarray, animation: Animation, i: int, column: int) -> np.ndarray:
    """Return the image (column 0) or map (column 1) of an effect in pictures."""
    x, y = animation.position(i, column)
    return pictures[..., y : y + 8 * SIZE[0], x : x + 8 * SIZE[1], :].astype(int)


@pytest.mark.parametrize("suffix", LOSSES)
def test_each_decoded_frame_is_that_of_its_time(tmp_path, frame, suffix):
    animation = make_animation(EFFECTS, repeated(frame, 5), seed=3)
    save_animation(animation, tmp_path / f"effects{suffix}", fps=12)
    pictures = decoded(tmp_path / f"effects{suffix}")
    assert pictures.shape == (5, *animation.background.shape)
    for i, effect in enumerate(EFFECTS.values()):
        expected = np.stack([displayed(effect.degrade(frame, seed=3, frame=t).image) for t in range(5)]).astype(int)
        shown = cell(pictures, animation, i, 0)
        assert np.abs(shown - expected).mean() <= LOSSES[suffix]
        if effect is not FOG:
            differences = np.abs(shown[:, None] - expected).mean(axis=(2, 3, 4))
            assert differences.argmin(axis=1).tolist() == list(range(5))


@pytest.mark.parametrize("suffix", [".apng", ".gif"])
def test_only_effects_that_evolve_change_from_frame_to_frame(tmp_path, frame, suffix):
    effects = {"lens": LENS, "turbulence": TURBULENCE, "fog": FOG, "flare": FLARE}
    animation = make_animation(effects, repeated(frame, 5), seed=3)
    save_animation(animation, tmp_path / f"effects{suffix}", fps=12)
    pictures = decoded(tmp_path / f"effects{suffix}")
    outside = np.ones(pictures.shape[1:3], dtype=bool)
    for i, name in enumerate(effects):
        for column in (0, 1):
            images = cell(pictures, animation, i, column)
            changes = (images[1:] != images[:-1]).any(axis=(1, 2, 3))
            assert changes.tolist() == [name in ("turbulence", "flare")] * 4
            x, y = animation.position(i, column)
            outside[y : y + 8 * SIZE[0], x : x + 8 * SIZE[1]] = False
    assert (pictures[:, outside] == pictures[0, outside]).all()
    difference = np.abs(pictures[0, outside].astype(int) - animation.background[outside])
    assert difference.max() <= (0 if suffix == ".apng" else 64)
    assert (difference[animation.background[outside] == 255] == 0).mean() > 0.99  # white stays white


def test_a_map_has_one_scale_in_all_frames(frame):
    animation = make_animation(EFFECTS, repeated(frame, 9), seed=3)
    assert [panel.scales[0].name for panel in animation.panels] == ["flow", "intensity", "transmission"]
    flow_top, intensity_top, _ = (panel.scales[0].top for panel in animation.panels)
    for t, picture in enumerate(animation.render(range(9))):
        warped, flare, fog = (effect.degrade(frame, seed=3, frame=t) for effect in EFFECTS.values())
        valid = displayed(warped.valid.float().expand(-1, 3, -1, -1)) > 0
        flow = displayed(flow_to_rgb(warped.flow, max_px=flow_top))
        assert np.array_equal(cell(picture, animation, 0, 1)[valid], flow[valid])
        for i, light in ((1, flare.intensity / intensity_top), (2, fog.transmission)):
            assert np.array_equal(cell(picture, animation, i, 1), displayed(transmission_to_rgb(light)))
        if t in (0, 2, 4, 6, 8):  # the frames that decide the scale
            assert warped.flow.norm(dim=1)[warped.valid[:, 0]].max() <= flow_top
            assert flare.intensity.max() <= intensity_top


@pytest.mark.quick
def test_frames_are_read_one_by_one_and_degraded_at_their_time(frame):
    images = [(frame + t / 10) % 1 for t in range(4)]
    read_times: list[int] = []

    def read(times: Iterable[int]) -> Iterator[tuple[int, Tensor]]:
        for t in times:
            read_times.append(t)
            yield t, images[t]

    animation = make_animation({"flare": FLARE}, FrameSequence(4, read), seed=1)
    assert read_times == [0, 1, 2, 3]
    pictures = animation.render(range(4))
    for t in range(4):
        read_times.clear()
        picture = next(pictures)
        assert read_times == [t]
        expected = displayed(FLARE.degrade(images[t], seed=1, frame=t).image)
        assert np.array_equal(cell(picture, animation, 0, 0), expected)


@pytest.mark.quick
def test_fog_takes_the_depth_of_the_frames(frame):
    depth = torch.full((1, 1, *SIZE), 30.0)
    animation = make_animation({"fog": FOG}, repeated(frame, 1)._replace(depth=lambda t: depth), seed=1)
    (picture,) = animation.render([0])
    assert np.array_equal(cell(picture, animation, 0, 0), displayed(FOG.degrade(frame, seed=1, depth=depth).image))


def durations_ms(path: Path) -> list[float]:
    with Image.open(path) as image:
        times = []
        for frame in ImageSequence.Iterator(image):
            frame.load()  # WebP knows the duration of a frame once it is decoded
            times.append(frame.info["duration"])
        assert image.info["loop"] == 0
        return times


@pytest.mark.parametrize("fps", [0.5, 12.0, 29.97, 50.0])
def test_each_frame_ends_at_its_time_within_the_unit_of_the_format(tmp_path, frame, fps):
    animation = make_animation({"flare": FLARE}, repeated(frame, 6), seed=1)
    for suffix, unit_ms in ((".gif", 10.0), (".webp", 1.0), (".apng", 1.0)):
        save_animation(animation, tmp_path / f"flare{suffix}", fps=fps)
        ends = np.cumsum(durations_ms(tmp_path / f"flare{suffix}"))
        assert np.abs(ends - 1000 / fps * np.arange(1, 7)).max() <= unit_ms / 2 + 1e-6, suffix
    save_animation(animation, tmp_path / "flare.mp4", fps=fps)
    assert cv2.VideoCapture(str(tmp_path / "flare.mp4")).get(cv2.CAP_PROP_FPS) == pytest.approx(fps, rel=1e-3)


@pytest.mark.parametrize("suffix", LOSSES)
def test_an_animation_may_have_one_frame_and_a_suffix_in_capitals(tmp_path, frame, suffix):
    animation = make_animation({"flare": FLARE}, repeated(frame, 1), seed=1)
    save_animation(animation, tmp_path / f"flare{suffix.upper()}", fps=12)
    (tmp_path / f"flare{suffix.upper()}").rename(tmp_path / f"flare{suffix}")
    shown = cell(decoded(tmp_path / f"flare{suffix}"), animation, 0, 0)
    assert np.abs(shown - displayed(FLARE.degrade(frame, seed=1).image)).mean() <= LOSSES[suffix]


@pytest.mark.parametrize(
    ("size", "count"), [((24, 40), 5), ((281, 501), 1), ((90, 30), 1), ((12, 241), 5), ((1, 1), 1), ((1, 1), 5)]
)
def test_a_background_has_even_sides_and_no_text_at_its_border_or_under_an_image(size, count):
    effects = dict(list(({"heterogeneous fog": tr.HeterogeneousFog()} | EFFECTS | {"lens": LENS}).items())[:count])
    animation = make_animation(effects, repeated(torch.rand(1, 3, *size), 2), seed=1)
    (picture,) = animation.render([1])
    layout, background = animation.layout, animation.background
    assert (background.shape[0] % 2, background.shape[1] % 2) == (0, 0)
    for border in (picture[:2], picture[-2:], picture[:, :2], picture[:, -2:]):
        assert (border == 255).all()
    assert max(layout.height, layout.width) <= (480 if count == 1 else 320)
    for i in range(count):
        for column in (0, 1):
            x, y = animation.position(i, column)
            assert (background[y : y + layout.height, x : x + layout.width] == 255).all()


@pytest.mark.quick
def test_a_caption_has_the_name_and_parameters_of_the_effect(frame):
    animation = make_animation({"mist": FOG}, repeated(frame, 3), seed=1)
    assert animation.panels[0].caption == "mist: visibility 100 m"
    other = make_animation({"rain": FOG}, repeated(frame, 3), seed=1)
    assert not np.array_equal(animation.background, other.background)


def test_the_error_of_an_effect_has_its_name(frame):
    strict = tr.LensDistortion(k1_range=(-3.0, -3.0), strict=True)
    with pytest.raises(UsageError, match=r"^lens: "):
        make_animation({"lens": strict}, repeated(frame, 3), seed=1)


@pytest.mark.quick
def test_formats_are_those_that_the_installed_libraries_can_write(monkeypatch):
    assert animation_formats() == [".gif", ".webp", ".apng", ".mp4"]
    monkeypatch.setattr("PIL.features.check", lambda name: False)
    monkeypatch.setattr("av.codecs_available", set())
    assert animation_formats() == [".gif", ".apng"]
