import itertools
import os
import pickle
import re
import shutil
import subprocess
from pathlib import Path

import pytest
import torch
from PIL import Image
from torch.testing import assert_close
from torch.utils.data import DataLoader

from torchrefract.data.frames import FrameFolder, evenly_spaced, name_prefix
from torchrefract.data.images import fit, read_image

SIZE = (4, 6)


def put(root: Path, *paths: str) -> Path:
    """Write frames of 8x12, each of its own gray."""
    for number, path in enumerate(paths):
        (root / path).parent.mkdir(parents=True, exist_ok=True)
        Image.new("RGB", (12, 8), (number % 256,) * 3).save(root / path)
    return root


def numbered(drive: str, count: int) -> list[str]:
    return [f"{drive}{number:04d}.png" for number in range(count)]


def names(folder: FrameFolder) -> list[str]:
    return [path.relative_to(folder.root).as_posix() for path in folder.paths]


@pytest.mark.quick
def test_frames_are_chosen_evenly():
    assert evenly_spaced(10, 10) == list(range(10))
    assert evenly_spaced(10, 3) == [0, 3, 6]
    assert evenly_spaced(2, 5) == [0, 1]


@pytest.mark.quick
def test_a_frame_has_an_image_a_key_and_no_depth(tmp_path):
    folder = FrameFolder(put(tmp_path, "a_1.png", "a_2.jpg"), size=SIZE)
    frame = folder[1]
    assert_close(frame.image, fit(read_image(tmp_path / "a_2.jpg"), SIZE), rtol=0, atol=0)
    assert frame.image.shape == (3, 4, 6)
    assert (frame.key.dtype, frame.key.shape) == (torch.int64, ())
    assert frame.depth.shape == (0,)
    assert len(folder) == 2


def test_files_of_all_folders_are_sorted_and_hidden_ones_ignored(tmp_path):
    put(tmp_path, "b/2.PNG", "b/deep/1.JpG", "a/3.webp", "a/1.bmp", "a/2.jpeg", ".hidden/1.png", "a/.2.png")
    (tmp_path / "a" / "notes.txt").write_text("no frame")
    (tmp_path / "a" / "folder.png").mkdir()
    expected = ["a/1.bmp", "a/2.jpeg", "a/3.webp", "b/2.PNG", "b/deep/1.JpG"]
    assert names(FrameFolder(tmp_path, size=SIZE)) == expected


def test_links_are_followed_and_each_folder_is_visited_once(tmp_path):
    outside = put(tmp_path / "outside", "1.png", "2.png")
    root = put(tmp_path / "root", "a/1.png")
    (root / "a" / "loop").symlink_to(root, target_is_directory=True)
    (root / "b").symlink_to(outside, target_is_directory=True)
    (root / "c").symlink_to(outside, target_is_directory=True)
    assert names(FrameFolder(root, size=SIZE)) == ["a/1.png", "b/1.png", "b/2.png"]


def test_frames_have_the_names_of_their_folder_beside_a_link_to_it(tmp_path):
    root = put(tmp_path, "drive_7/1.png", "drive_8/1.png")
    (root / "current").symlink_to("drive_7", target_is_directory=True)
    (root / "drive_7" / "next").symlink_to("../drive_8", target_is_directory=True)
    assert names(FrameFolder(root, size=SIZE)) == ["drive_7/1.png", "drive_8/1.png"]


@pytest.mark.parametrize(
    ("stem", "drive"),
    [
        ("ca280_0001", "ca280"),
        ("ca280_ti_straight_lines1", "ca280_ti_straight"),
        ("ca_p1_solidWhiteCurve", "ca_p1"),
        ("br_rs_290_290rs294095_13846", "br_rs_290_290rs294095"),
        ("us_atx_night_046860", "us_atx_night"),
        ("drive-07_000123", "drive-07"),
        ("drive-07-000123", "drive-07"),
        ("drive 07 frame 12", "drive 07 frame"),
        ("drive_07_frame123", "drive_07"),
        ("GH010123_000456", "GH010123"),
        ("2024-05-01_12-30-00_0001", "2024-05-01_12-30-00"),
        ("2024-05-01_12-30-00", "2024-05-01"),
        ("20240501123000", "20240501"),
        ("IMG_20240501_123000", "IMG_20240501"),
        ("2024_0501_123000_0012F", "2024_0501_123000"),
        ("20240501_123000_NF_0001", "20240501_123000_NF"),
        ("aachen_000000_000019_leftImg8bit", "aachen_000000"),
        ("n015-2018-07-18-11-07-57+0800__CAM_FRONT__1531883530412470", "n015-2018-07-18-11-07-57+0800__CAM_FRONT"),
        ("0000f77c-6257be58", "0000f77c"),
        ("highway_clear", "highway"),
        ("frame.0012", "frame"),
        ("frame12", "frame"),
        ("000123", "."),
        ("clear", "."),
        ("a1b2c3", "."),
    ],
)
def test_the_drive_of_a_file_name_ends_before_its_number(stem, drive):
    assert name_prefix(stem) == drive


@pytest.mark.parametrize(
    ("folders", "drives", "by_prefix"),
    [
        (["frames/x_", "frames/y_"], ["x", "y"], ["x", "y"]),
        (["set/d1/front/", "set/d1/rear/", "set/d2/front/"], ["set/d1", "set/d2"], ["."]),
        (["x_", "d1/"], [".", "d1"], [".", "x"]),
    ],
)
def test_drives_are_folders_or_prefixes_within_a_single_folder(tmp_path, folders, drives, by_prefix):
    put(tmp_path, *itertools.chain.from_iterable(numbered(folder, 2) for folder in folders))
    assert FrameFolder(tmp_path, size=SIZE).drives == drives
    assert FrameFolder(tmp_path, size=SIZE, drive_by="prefix").drives == by_prefix


@pytest.mark.parametrize("drive_by", ["auto", "folder", "prefix"])
def test_train_and_val_hold_all_frames_and_share_no_drive(tmp_path, drive_by):
    for drive, count in enumerate([7, 1, 12, 3, 9, 2, 6]):
        put(tmp_path, *numbered(f"d{drive}/d{drive}_", count))
    split = {name: FrameFolder(tmp_path, size=SIZE, split=name, drive_by=drive_by, seed=3) for name in ("train", "val")}
    assert not set(split["train"].drives) & set(split["val"].drives)
    everything = FrameFolder(tmp_path, size=SIZE, drive_by=drive_by)
    assert sorted(names(split["train"]) + names(split["val"])) == names(everything)
    assert sorted(split["train"].drives + split["val"].drives) == everything.drives
    # A drive that brings val no closer to its 8 of 40 frames is left out, so it misses them by less than 8.
    assert 0 < len(split["val"]) < 16


def test_val_has_its_share_of_equal_drives_which_the_seed_chooses(tmp_path):
    put(tmp_path, *itertools.chain.from_iterable(numbered(f"d{drive}/", 2) for drive in range(10)))
    for val_share in (0.1, 0.5, 0.9):
        assert len(FrameFolder(tmp_path, size=SIZE, split="val", val_share=val_share)) == 20 * val_share
    chosen = {tuple(FrameFolder(tmp_path, size=SIZE, split="val", seed=seed).drives) for seed in range(10)}
    assert len(chosen) > 3


@pytest.mark.parametrize(("val_share", "val"), [(0.01, "small"), (0.2, "small"), (0.99, "large")])
def test_of_two_drives_each_split_gets_one(tmp_path, val_share, val):
    put(tmp_path, *numbered("small_", 4), *numbered("large_", 16))
    split = {name: FrameFolder(tmp_path, size=SIZE, split=name, val_share=val_share) for name in ("train", "val")}
    assert len(split["train"].drives) == len(split["val"].drives) == 1
    if val_share < 0.5:
        assert split["val"].drives == [val]


def test_a_new_drive_moves_at_most_one_of_the_others(tmp_path):
    put(tmp_path, *itertools.chain.from_iterable(numbered(f"d{drive}_", 3) for drive in range(10)))
    before = set(FrameFolder(tmp_path, size=SIZE, split="val").drives)
    put(tmp_path, *numbered("new_", 3))
    after = set(FrameFolder(tmp_path, size=SIZE, split="val").drives)
    assert len((before ^ after) - {"new"}) <= 1


def test_a_single_drive_cannot_be_split(tmp_path):
    put(tmp_path, *numbered("x_", 5))
    assert len(FrameFolder(tmp_path, size=SIZE)) == 5
    with pytest.raises(ValueError, match=r"root must hold two or more drives .* got one, 'x'.* sub-folder of its own"):
        FrameFolder(tmp_path, size=SIZE, split="val")


def test_as_many_drives_as_frames_warn(tmp_path):
    put(tmp_path, *(f"frame{number}_left.png" for number in range(10)))
    with pytest.warns(UserWarning, match="10 frames in .* seem to come from 10 drives"):
        FrameFolder(tmp_path, size=SIZE, split="train")


@pytest.mark.parametrize(("train", "val"), [("train", "val"), ("Train", "VAL"), ("train", "validation")])
def test_folders_train_and_val_are_the_splits(tmp_path, train, val):
    put(tmp_path, *numbered(f"{train}/x_", 3), *numbered(f"{train}/y_", 1), *numbered(f"{val}/z_", 4), "test/w_1.png")
    assert FrameFolder(tmp_path, size=SIZE, split="train").drives == ["x", "y"]
    assert names(FrameFolder(tmp_path, size=SIZE, split="val")) == numbered(f"{val}/z_", 4)
    assert len(FrameFolder(tmp_path, size=SIZE)) == 9
    for path in (tmp_path / val).iterdir():
        path.unlink()
    with pytest.raises(ValueError, match="root must hold frames in its folder for val"):
        FrameFolder(tmp_path, size=SIZE, split="val")


def test_folders_train_and_val_may_hold_a_folder_for_each_drive(tmp_path):
    put(tmp_path, *numbered("train/d1/", 2), *numbered("train/d2/", 2), *numbered("val/0", 2))
    assert FrameFolder(tmp_path, size=SIZE, split="train").drives == ["d1", "d2"]
    assert FrameFolder(tmp_path, size=SIZE, split="val").drives == ["."]


@pytest.mark.parametrize("paths", [("train/x_1.png", "val/x_2.png"), ("train/x/1.png", "train/y/1.png", "val/x_2.png")])
def test_a_drive_in_both_folders_train_and_val_warns(tmp_path, paths):
    put(tmp_path, *paths)
    with pytest.warns(UserWarning, match="train and val in .* both hold frames of x, by name"):
        FrameFolder(tmp_path, size=SIZE, split="train")


def test_a_key_depends_on_the_path_in_the_root_alone(tmp_path):
    put(tmp_path / "one", "d/a_1.png", "d/a_2.png")
    put(tmp_path / "two", "c/a_0.png", "d/a_1.png", "d/a_1b.png", "d/a_2.png")
    one, two = FrameFolder(tmp_path / "one", size=SIZE), FrameFolder(tmp_path / "two", size=SIZE)
    assert [two[1].key, two[3].key] == [one[0].key, one[1].key]
    assert len({int(frame.key) for frame in two}) == 4


@pytest.mark.skipif(shutil.which("b2sum") is None, reason="needs another implementation of BLAKE2b")
def test_a_key_is_half_of_the_blake2b_digest_of_b2sum(tmp_path):
    folder = FrameFolder(put(tmp_path, "d/a_1.png"), size=SIZE)
    digest = subprocess.run(["b2sum", "-l", "64"], input=b"d/a_1.png", capture_output=True, check=True).stdout[:16]
    assert int(folder[0].key) == int(digest, 16) // 2


def test_unreadable_frames_are_skipped_with_one_warning(tmp_path):
    put(tmp_path, *numbered("x_", 20))
    (tmp_path / "x_0003.png").write_bytes((tmp_path / "x_0003.png").read_bytes()[:-4])
    (tmp_path / "x_0007.png").write_bytes(b"")
    with pytest.warns(UserWarning, match=r"2 of 20 .* skipped: x_0003\.png is truncated .*, x_0007\.png is empty") as w:
        folder = FrameFolder(tmp_path, size=SIZE)
    assert len(w) == 1
    assert w[0].filename == __file__
    assert [path.name for path, _ in folder.skipped] == ["x_0003.png", "x_0007.png"]
    assert folder.skipped[1][1] == "is empty (0 bytes)"
    assert len(folder) == 18
    assert not {"x_0003.png", "x_0007.png"} & set(names(folder))


def test_many_unreadable_frames_raise(tmp_path):
    put(tmp_path, *numbered("x_", 20))
    for number in (0, 1, 2, 3, 19):
        (tmp_path / f"x_{number:04d}.png").write_bytes(b"no picture")
    with pytest.raises(ValueError, match=r"got 5 of 20 in .* that are unreadable: x_0000\.png is not a .* and 2 more"):
        FrameFolder(tmp_path, size=SIZE)


@pytest.mark.parametrize("size", [(9, 6), (4, 13)])
def test_frames_smaller_than_the_size_raise(tmp_path, size):
    message = rf"size = {size[0]}x{size[1]} .* got x_0000\.png of 8x12 in .*; choose a smaller size"
    with pytest.raises(ValueError, match=message):
        FrameFolder(put(tmp_path, *numbered("x_", 1)), size=size)


def test_a_root_without_frames_raises(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"root must be a folder of frames, got .*gone, which does not exist"):
        FrameFolder(tmp_path / "gone")
    (tmp_path / "drive.mp4").write_bytes(b"")
    with pytest.raises(NotADirectoryError, match=r"root must be a folder of frames, got the file .*drive\.mp4; give"):
        FrameFolder(tmp_path / "drive.mp4")
    with pytest.raises(ValueError, match=r"root must hold \.jpg, .* files, got .* 1 other files; of a video, extract"):
        FrameFolder(tmp_path)


@pytest.mark.parametrize("place", [".", "b"])
def test_a_folder_without_permission_raises(tmp_path, place, monkeypatch):
    put(tmp_path, "a/1.png", "b/1.png")
    scandir = os.scandir

    def guarded(path):
        if Path(path) == tmp_path / place:
            raise PermissionError(13, "Permission denied", str(path))
        return scandir(path)

    monkeypatch.setattr(os, "scandir", guarded)  # the permission itself would not stop an administrator
    with pytest.raises(PermissionError, match=f"root must be readable .* {re.escape(str(tmp_path / place))}; change"):
        FrameFolder(tmp_path, size=SIZE)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"split": "test"}, "split must be one of all, train, val, got 'test'"),
        ({"drive_by": "name"}, "drive_by must be one of auto, folder, prefix, got 'name'"),
        ({"val_share": 0.0}, r"val_share must be a number between 0 and 1, got 0\.0"),
        ({"val_share": 1}, "val_share must be a number between 0 and 1, got 1"),
        ({"size": (64,)}, r"size must be \(height, width\), got \(64,\)"),
    ],
)
def test_an_invalid_argument_raises(tmp_path, options, message):
    with pytest.raises(ValueError, match=message):
        FrameFolder(tmp_path, **options)


def test_a_data_loader_reads_the_same_frames_in_another_process(tmp_path):
    folder = FrameFolder(put(tmp_path, *numbered("x_", 3)), size=SIZE)
    copy = pickle.loads(pickle.dumps(folder))
    assert_close([frame.image for frame in copy], [frame.image for frame in folder], rtol=0, atol=0)
    loader = DataLoader(folder, batch_size=3, num_workers=1)
    batch = next(iter(loader))
    assert_close(batch.image, torch.stack([frame.image for frame in folder]), rtol=0, atol=0)
    assert batch.key.tolist() == folder.keys
    assert batch.depth.shape == (3, 0)


def test_the_real_frames_come_in_the_splits_of_their_folders(shared_data):
    train = FrameFolder(shared_data / "frames", split="train")
    val = FrameFolder(shared_data / "frames", split="val")
    assert (len(train), len(val)) == (422, 115)
    assert not set(train.drives) & set(val.drives)
    assert train.skipped == val.skipped == []
    assert {"ca280_pv", "in_rdd_b", "us_atx_night"} <= set(train.drives)
    assert {"ca_p1_swr", "in_rdd_g"} <= set(val.drives)
