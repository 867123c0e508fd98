from typing import Any

import cv2
import numpy as np
import pytest
import torch

from torchrefract import LensDistortion
from torchrefract.data import drive_lenses
from torchrefract.data.drive_lenses import bent_drives
from torchrefract.data.frames import FrameFolder
from torchrefract.data.images import pixels_of

HEIGHT, WIDTH = 216, 384
NONE: dict[str, Any] = {f"{name}_range": (0.0, 0.0) for name in ("k2", "p1", "p2", "center_x", "center_y")}
LENS = LensDistortion(k1_range=(-0.25, -0.25), focal_range=(0.9, 0.9), **NONE)


def streets(seed: int) -> torch.Tensor:
    """Draw a picture (1, 3, H, W) of straight lines, at other places for each seed."""
    dice, picture = np.random.default_rng(seed), np.full((HEIGHT, WIDTH, 3), 90, np.uint8)
    for _ in range(14):
        start, end = dice.uniform(0, [WIDTH, HEIGHT], (2, 2)).astype(int).tolist()
        cv2.line(picture, start, end, dice.integers(0, 256, 3).tolist(), thickness=5, lineType=cv2.LINE_AA)
    return torch.from_numpy(picture).permute(2, 0, 1)[None] / 255


@pytest.fixture(scope="module")
def frames(tmp_path_factory) -> FrameFolder:
    """Return frames of a drive behind a lens, of one without, and of one that is too short."""
    root = tmp_path_factory.mktemp("drives")
    for drive, count in {"bent": 10, "straight": 10, "short": 3}.items():
        (root / drive).mkdir()
        for i in range(count):
            image = streets(100 * len(drive) + i)
            image = image if drive == "straight" else LENS.degrade(image, seed=0).image
            cv2.imwrite(str(root / drive / f"{i}.png"), pixels_of(image[0]))
    return FrameFolder(root, size=(64, 112))


def test_a_drive_behind_a_lens_is_told_from_one_without(frames):
    shifts = bent_drives(frames)
    assert list(shifts) == ["bent"]
    # The lens shifts the middle of the right edge by k1 r^3 focal lengths.
    edge = 0.5 / 0.9
    assert shifts["bent"] == pytest.approx(0.25 * edge**3 * 0.9, rel=0.25)


def test_at_most_so_many_drives_are_looked_at(frames, monkeypatch):
    monkeypatch.setattr(drive_lenses, "_MAX_DRIVES", 0)
    assert bent_drives(frames) == {}


def test_unreadable_frames_and_frames_of_another_size_are_left_out(frames, tmp_path):
    paths = frames.paths[:10]
    other = tmp_path / "other.png"
    cv2.imwrite(str(other), np.zeros((70, 120, 3), np.uint8))
    damaged = tmp_path / "damaged.png"
    damaged.write_bytes(paths[0].read_bytes()[:500])
    assert drive_lenses._edge_shift([*paths, other, damaged]) == drive_lenses._edge_shift(paths) > 0
