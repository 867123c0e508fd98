"""Sources of pairs: images and frames of videos, in any order."""

import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from torchrefract.data.frames import Source
from torchrefract.data.images import UnreadableImageError, fit, read_image
from torchrefract.data.pairs.dataset import PairedFolder
from torchrefract.data.pairs.generator import SourceReader
from torchrefract.data.pairs.sources import Sources, draw_of, find_sources, table_of
from torchrefract.data.video import read_video, write_video

OPTIONS = {"size": None, "every": 1, "drive_by": "auto", "val_share": 0.3, "seed": 0}
FRAMES = 9


@pytest.fixture(scope="module")
def videos(tmp_path_factory) -> Path:
    """Write three videos of nine frames each, of noise on a shade."""
    root, generator = tmp_path_factory.mktemp("videos"), np.random.default_rng(0)
    for name in ("a.mp4", "b.mp4", "c.mp4"):
        pages = [generator.integers(20 * i, 20 * i + 60, (32, 48, 3)).astype(np.uint8) for i in range(FRAMES)]
        assert write_video(pages, root / name, fps=10, size=(48, 32)) == FRAMES
    return root


def test_frames_of_videos_are_read_in_any_order(videos):
    plain = {name: [frame for _, frame in read_video(videos / name, range(FRAMES))] for name in ("a.mp4", "b.mp4")}
    reader = SourceReader(videos, None)
    for name, t in [("a.mp4", 0), ("a.mp4", 4), ("b.mp4", 4), ("b.mp4", 8), ("b.mp4", 2), ("a.mp4", 5), ("a.mp4", 5)]:
        assert torch.equal(reader.read(Source(name, name, "train", t)), plain[name][t][0])


def test_a_video_that_ends_early_raises(videos):
    reader = SourceReader(videos, None)
    with pytest.raises(UnreadableImageError, match=r"a\.mp4 ends before its frame 9"):
        reader.read(Source("a.mp4", "a", "train", FRAMES))
    assert reader.read(Source("a.mp4", "a", "train", 1)).shape == (3, 32, 48)


@pytest.mark.skipif(sys.platform != "linux", reason="counts the threads in /proc")
def test_a_list_is_read_without_threads_which_could_abort_a_process_that_ends(tmp_path):
    frames = [Source(f"{number}.png", ".", "train") for number in range(3)]
    Sources(tmp_path, table_of(frames, lambda _: 7)).write(tmp_path / "list.parquet", {"every": 1})
    code = (
        "import os, pathlib, sys; from torchrefract.data.pairs.sources import read_sources; "
        "before = len(os.listdir('/proc/self/task')); path = pathlib.Path(sys.argv[1]); "
        "frames = read_sources(path, path.parent, {'every': 1}); "
        "print(len(os.listdir('/proc/self/task')) - before, *frames.frames(), sep='|')"
    )
    command = [sys.executable, "-c", code, str(tmp_path / "list.parquet")]
    started, *read = subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip().split("|")
    assert (started, read) == ("0", [str(frame._replace(bytes=7)) for frame in frames])


@pytest.mark.parametrize("size", [None, (40, 60), (20, 30)])
def test_an_image_is_cropped_and_reduced_on_request(size, tmp_path):
    assert cv2.imwrite(str(tmp_path / "a.png"), np.random.default_rng(0).integers(0, 256, (40, 60, 3), np.uint8))
    image = SourceReader(tmp_path, size).read(Source("a.png", ".", "train"))
    assert torch.equal(image, fit(read_image(tmp_path / "a.png"), size or (40, 60)))
    assert image.is_contiguous()


def test_each_video_is_a_drive_in_one_split(videos):
    sources = find_sources(videos, **{**OPTIONS, "every": 2})
    assert [(frame.path, frame.frame) for frame in sources.frames()] == [
        (name, t) for name in ("a.mp4", "b.mp4", "c.mp4") for t in range(0, FRAMES, 2)
    ]
    splits = {
        drive: {frame.split for frame in sources.frames() if frame.drive == drive} for drive in ("a.mp4", "c.mp4")
    }
    assert all(len(names) == 1 for names in splits.values())
    assert {frame.split for frame in sources.frames()} == {"train", "val"}
    # Fewer frames are spread over the source.
    assert [frame.path for frame in sources.limited(6).frames()] == ["a.mp4"] * 2 + ["b.mp4"] * 2 + ["c.mp4"] * 2


def test_a_repeated_source_has_a_new_key(videos):
    sources = find_sources(videos, **OPTIONS)
    keys = [draw_of(frame, seed=3, repeat=repeat)[1] for repeat in range(3) for frame in sources.frames()]
    assert len(set(keys)) == 3 * 3 * FRAMES
    assert {draw_of(frame, seed=3, repeat=0)[0] for frame in sources.frames()} == {3 << 32, (3 << 32) + 1}


def test_pairs_of_a_video_hold_its_frames(call, videos, tmp_path):
    words = ("scene=limpopo_sun_glare", f"source={videos / 'b.mp4'}", "out=out", "license=CC0", "workers=0", "every=4")
    outcome = call("generate", *words, "count=5")
    assert "the source has a single drive" in outcome.out
    assert "5 pairs of 3 frames: each frame is used up to 2 times, with new keys" in outcome.out
    folder = PairedFolder(tmp_path / "out")
    times = [folder.row(i).frame for i in range(5)]
    assert times == [0, 4, 8, 0, 4]
    plain = [frame for _, frame in read_video(videos / "b.mp4", range(FRAMES))]
    for i, t in enumerate((0, 4, 8, 0, 4)):
        assert torch.equal(folder[i].clean, plain[t][0])
    assert not torch.equal(folder[0].degraded, folder[3].degraded)


def test_images_together_with_videos_raise(call, videos, frames, tmp_path):
    both = tmp_path / "both"
    both.mkdir()
    (both / "a.mp4").symlink_to(videos / "a.mp4")
    (both / "a.png").symlink_to(frames / "drive0" / "000.png")
    words = ("scene=limpopo_sun_glare", "source=both", "out=out", "license=CC0")
    message = "source must hold images or videos, got both in both, such as a.png and a.mp4"
    assert call("generate", *words).message == message


def test_unreadable_videos_are_reported_and_skipped(call, videos, tmp_path):
    shutil.copytree(videos, tmp_path / "videos")
    data = (videos / "a.mp4").read_bytes()
    (tmp_path / "videos" / "cut.mp4").write_bytes(data[: len(data) // 2])
    (tmp_path / "videos" / "empty.mp4").touch()
    assert find_sources(tmp_path / "videos", **OPTIONS).skipped == ["cut.mp4", "empty.mp4"]
    words = ("scene=limpopo_sun_glare", "source=videos", "out=out", "license=CC0", "workers=0", "count=2")
    assert "2 files of the source are unreadable: cut.mp4, empty.mp4\n" in call("generate", *words).out
