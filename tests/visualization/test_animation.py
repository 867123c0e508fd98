import weakref
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor

import torchrefract as tr
from torchrefract._validation import UsageError
from torchrefract.effects.base import Effect
from torchrefract.visualization.animation import Film, Footage, formats, make_film, save_film
from torchrefract.visualization.color import flow_to_rgb, transmission_to_rgb

SIZE = (24, 40)  # drawn with 8 x 8 px for each
FAST: dict[str, Any] = {"wind_x_range": (2.0, 2.0), "decorrelation_range": (2.0, 4.0)}
AIR = tr.Turbulence(amplitude_range=(1.0, 1.0), length_range=(8.0, 8.0), **FAST)
SUN = tr.LensFlare(center_x_range=(0.3, 0.3), drift_x_range=(0.05, 0.05), strength_range=(0.4, 0.4))
FOG = tr.UniformFog(visibility_range=(100.0, 100.0))
LENS = tr.LensDistortion()
EFFECTS: dict[str, Effect] = {"air": AIR, "sun": SUN, "fog": FOG}
# How far a decoded image may be from the one that went in, in the mean, of 255.
LOSSES = {".apng": 0.0, ".gif": 5.0, ".webp": 5.0, ".mp4": 8.0}


@pytest.fixture
def frame() -> Tensor:
    """(1, 3, 24, 40): smooth and of few colors, so that no codec has an excuse."""
    y, x = torch.meshgrid(torch.linspace(0, 1, SIZE[0]), torch.linspace(0, 1, SIZE[1]), indexing="ij")
    return (0.4 + 0.3 * torch.sin(9 * x + 5 * y) + 0.1 * torch.stack([x, y, 1 - x]))[None]


def still(image: Tensor, total: int) -> Footage:
    return Footage(total, lambda times: ((t, image) for t in times))


def drawn(image: Tensor) -> np.ndarray:
    """(h, w, 3), whole numbers: an image (1, 3, 24, 40) as it is drawn."""
    large = image[0].clamp(0, 1).repeat_interleave(8, dim=1).repeat_interleave(8, dim=2)
    return (255 * large).round().byte().movedim(0, -1).numpy()


def decoded(path: Path) -> np.ndarray:
    """(T, height, width, 3), by readers that share nothing with the writers but the libraries."""
    if path.suffix == ".mp4":
        video, frames = cv2.VideoCapture(str(path)), []
        while (found := video.read())[0]:
            frames.append(found[1][..., ::-1])
        return np.stack(frames)
    with Image.open(path) as image:
        frames = []
        for t in range(getattr(image, "n_frames", 1)):
            image.seek(t)
            frames.append(np.asarray(image.convert("RGB")))
        return np.stack(frames)


def part(pages: np.ndarray, film: Film, i: int, column: int) -> np.ndarray:
    """What a place of the pages shows."""
    x, y = film.place(i, column)
    return pages[..., y : y + 8 * SIZE[0], x : x + 8 * SIZE[1], :].astype(int)


@pytest.mark.parametrize("suffix", LOSSES)
def test_a_decoded_frame_is_that_of_its_time(tmp_path, frame, suffix):
    film = make_film(EFFECTS, still(frame, 7), seed=3)
    save_film(film, tmp_path / f"film{suffix}", fps=12, name="film")
    pages = decoded(tmp_path / f"film{suffix}")
    assert pages.shape == (7, *film.backdrop.shape)
    for i, effect in enumerate(EFFECTS.values()):
        expected = np.stack([drawn(effect.degrade(frame, seed=3, frame=t).image) for t in range(7)]).astype(int)
        shown = part(pages, film, i, 0)
        assert np.abs(shown - expected).mean() <= LOSSES[suffix]
        if effect is not FOG:
            far = np.abs(shown[:, None] - expected).mean(axis=(2, 3, 4))
            assert far.argmin(axis=1).tolist() == list(range(7))


@pytest.mark.parametrize("suffix", [".apng", ".gif"])
def test_what_stands_still_does_not_flicker_and_what_evolves_moves(tmp_path, frame, suffix):
    effects = {"lens": LENS, "air": AIR, "fog": FOG, "sun": SUN}
    film = make_film(effects, still(frame, 5), seed=3)
    save_film(film, tmp_path / f"film{suffix}", fps=12, name="film")
    pages = decoded(tmp_path / f"film{suffix}")
    for i, name in enumerate(effects):
        for column in (0, 1):
            changes = [
                (a != b).any() for a, b in zip(*(part(p, film, i, column) for p in (pages, pages[1:])), strict=False)
            ]
            assert changes == [name in ("air", "sun")] * 4
    outside = np.ones(pages.shape[1:3], dtype=bool)
    for i in range(4):
        for column in (0, 1):
            part(outside[..., None], film, i, column)  # checks the place
            x, y = film.place(i, column)
            outside[y : y + 8 * SIZE[0], x : x + 8 * SIZE[1]] = False
    assert (pages[:, outside] == pages[0, outside]).all()
    difference = np.abs(pages[0, outside].astype(int) - film.backdrop[outside])
    assert difference.max() <= (0 if suffix == ".apng" else 64)
    assert (difference[film.backdrop[outside] == 255] == 0).mean() > 0.99  # white stays white


def test_maps_have_one_scale_for_all_of_the_film(frame):
    film = make_film(EFFECTS, still(frame, 9), seed=3)
    tops = [row.scales[0].top for row in film.rows]
    assert [row.scales[0].name for row in film.rows] == ["flow", "intensity", "transmission"]
    for t, page in enumerate(film.pages(range(9))):
        air, sun, fog = (effect.degrade(frame, seed=3, frame=t) for effect in EFFECTS.values())
        flow, valid = drawn(flow_to_rgb(air.flow, max_px=tops[0])), drawn(air.valid.float().expand(-1, 3, -1, -1)) > 0
        assert np.array_equal(part(page, film, 0, 1)[valid], flow[valid])
        assert np.array_equal(part(page, film, 1, 1), drawn(transmission_to_rgb(sun.intensity / tops[1])))
        assert np.array_equal(part(page, film, 2, 1), drawn(transmission_to_rgb(fog.transmission)))
        if t in (0, 2, 4, 6, 8):
            assert air.flow.norm(dim=1)[air.valid[:, 0]].max() <= tops[0]
            assert sun.intensity.max() <= tops[1]


def test_each_frame_of_footage_is_degraded_in_its_turn(frame):
    pictures = [(frame + t / 10) % 1 for t in range(4)]
    asked: list[int] = []

    def frames(times: Iterable[int]) -> Iterator[tuple[int, Tensor]]:
        for t in times:
            asked.append(t)
            yield t, pictures[t]

    film = make_film({"sun": SUN}, Footage(4, frames), seed=1)
    assert asked == [0, 1, 2, 3]
    pages = film.pages(range(4))
    for t in range(4):
        asked.clear()
        page = next(pages)
        assert asked == [t]
        assert np.array_equal(part(page, film, 0, 0), drawn(SUN.degrade(pictures[t], seed=1, frame=t).image))


def test_depth_is_handed_over(frame):
    depth = torch.full((1, 1, *SIZE), 30.0)
    film = make_film({"fog": FOG}, still(frame, 1), seed=1, depth=depth)
    (page,) = film.pages([0])
    assert np.array_equal(part(page, film, 0, 0), drawn(FOG.degrade(frame, seed=1, depth=depth).image))


@pytest.mark.parametrize("suffix", LOSSES)
def test_few_pages_are_in_memory_at_a_time(tmp_path, frame, monkeypatch, suffix):
    alive: weakref.WeakSet[Any] = weakref.WeakSet()
    most, original = [0], Film.pages

    class Page(np.ndarray):
        """An array that a set of weak references takes."""

        __hash__ = object.__hash__  # pyright: ignore[reportAssignmentType]  # a class with __eq__ has none of its own

    def pages(self: Film, times: Iterable[int]) -> Iterator[np.ndarray]:
        for page in original(self, times):
            counted = page.view(Page)
            del page
            alive.add(counted)
            most[0] = max(most[0], len(alive))
            yield counted
            del counted

    film = make_film({"sun": SUN}, still(frame, 24), seed=1)
    monkeypatch.setattr(Film, "pages", pages)
    save_film(film, tmp_path / f"film{suffix}", fps=12, name="film")
    assert 1 <= most[0] <= 6
    assert len(decoded(tmp_path / f"film{suffix}")) == 24


def shown_ms(path: Path) -> list[float]:
    with Image.open(path) as image:
        times = []
        for t in range(getattr(image, "n_frames", 1)):
            image.seek(t)
            image.load()  # WebP knows a frame's time when it is decoded
            times.append(image.info["duration"])
        return times


@pytest.mark.parametrize("fps", [0.5, 12.0, 29.97, 50.0])
def test_frames_are_shown_for_their_time(tmp_path, frame, fps):
    film = make_film({"sun": SUN}, still(frame, 6), seed=1)
    for suffix, error in ((".gif", 10.0), (".webp", 1.0), (".apng", 0.01 * 1000 / fps)):
        save_film(film, tmp_path / f"film{suffix}", fps=fps, name="film")
        times = shown_ms(tmp_path / f"film{suffix}")
        assert np.abs(np.cumsum(times) - 1000 / fps * np.arange(1, 7)).max() <= error, suffix
        with Image.open(tmp_path / f"film{suffix}") as image:
            assert image.info["loop"] == 0
    save_film(film, tmp_path / "film.mp4", fps=fps, name="film")
    assert cv2.VideoCapture(str(tmp_path / "film.mp4")).get(cv2.CAP_PROP_FPS) == pytest.approx(fps, rel=1e-3)


@pytest.mark.parametrize("suffix", LOSSES)
def test_one_frame_is_a_film_too(tmp_path, frame, suffix):
    film = make_film({"sun": SUN}, still(frame, 1), seed=1)
    save_film(film, tmp_path / f"film{suffix.upper()}", fps=12, name="film")
    (tmp_path / f"film{suffix.upper()}").rename(tmp_path / f"film{suffix}")
    pages = decoded(tmp_path / f"film{suffix}")
    assert np.abs(part(pages, film, 0, 0) - drawn(SUN.degrade(frame, seed=1).image)).mean() <= LOSSES[suffix]


@pytest.mark.parametrize("size", [(24, 40), (281, 501), (90, 30), (12, 241), (1, 1)])
@pytest.mark.parametrize("count", [1, 5])
def test_a_film_of_any_size_has_even_sides_and_all_of_its_text_on_the_page(size, count):
    effects: dict[str, Effect] = dict(
        list(({"drifts": tr.HeterogeneousFog()} | EFFECTS | {"lens": LENS}).items())[:count]
    )
    film = make_film(effects, still(torch.rand(1, 3, *size), 2), seed=1)
    (page,) = film.pages([1])
    height, width = film.backdrop.shape[:2]
    assert (height % 2, width % 2) == (0, 0)
    for edge in (page[:2], page[-2:], page[:, :2], page[:, -2:]):
        assert (edge == 255).all()
    side = 480 if count == 1 else 320
    assert max(film.page.height, film.page.width) <= side
    # No image covers a word.
    for i in range(count):
        for column in (0, 1):
            x, y = film.place(i, column)
            assert (film.backdrop[y : y + film.page.height, x : x + film.page.width] == 255).all()


def test_a_caption_says_what_was_drawn(frame):
    film = make_film({"mist": FOG}, still(frame, 3), seed=1)
    assert film.rows[0].caption == "mist: visibility 100 m"
    other = make_film({"rain": FOG}, still(frame, 3), seed=1)
    assert not np.array_equal(film.backdrop, other.backdrop)


def test_an_effect_that_refuses_the_frame_is_named(frame):
    strict = tr.LensDistortion(k1_range=(-3.0, -3.0), strict=True)
    with pytest.raises(UsageError, match=r"^lens: "):
        make_film({"lens": strict}, still(frame, 3), seed=1)


def test_a_video_that_is_not_whole_is_an_error(tmp_path, frame, monkeypatch):
    class Full:
        """Writes two frames, and no more, and says nothing."""

        fourcc = cv2.VideoWriter.fourcc

        def __init__(self, *arguments: Any):
            self.writer, self.left = original(*arguments), 2

        def write(self, image: np.ndarray) -> None:
            self.left -= 1
            if self.left >= 0:
                self.writer.write(image)

        def release(self) -> None:
            self.writer.release()

    original = cv2.VideoWriter
    film = make_film({"sun": SUN}, still(frame, 5), seed=1)
    monkeypatch.setattr(cv2, "VideoWriter", Full)
    with pytest.raises(OSError, match="the video is not whole, as on a full disk"):
        save_film(film, tmp_path / "film.mp4", fps=12, name="film")


def test_the_formats_are_those_that_the_libraries_can_write(monkeypatch):
    assert formats() == [".gif", ".webp", ".apng", ".mp4"]
    monkeypatch.setattr("PIL.features.check", lambda name: False)
    monkeypatch.setattr("cv2.videoio_registry.hasBackend", lambda backend: False)
    assert formats() == [".gif", ".apng"]
