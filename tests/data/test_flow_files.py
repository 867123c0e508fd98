"""Optical flow in files, moved to degraded pictures."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from torchrefract import warp_optical_flow
from torchrefract._validation import UsageError
from torchrefract.data.flow_files import FlowFile, next_picture, read_flows

H, W = 24, 40


def motion() -> np.ndarray:
    """Return (H, W, 2), float32, px, of steps that a PNG holds exactly."""
    y, x = np.mgrid[:H, :W]
    return (np.round(np.stack([3 + x / 16, -2 + y / 8], axis=-1) * 64) / 64).astype(np.float32)


def write_kitti(path: Path, flow: np.ndarray, valid: np.ndarray) -> None:
    levels = (flow * 64 + 2**15).astype(np.uint16)
    pixels = np.dstack([valid.astype(np.uint16), levels[..., 1], levels[..., 0]])  # B, G, R
    assert cv2.imwrite(str(path), pixels)


def read_kitti(data: bytes) -> tuple[np.ndarray, np.ndarray]:
    pixels = np.asarray(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)).astype(np.float64)
    return (pixels[..., :0:-1] - 2**15) / 64, pixels[..., 0] == 1


def degraded(flow: Any = None, *, size: tuple[int, int] = (H, W)) -> Any:
    """Return what a file needs of a degraded picture: its size, and flows that are a shift and its inverse."""
    maps = {}
    if flow is not None:
        shift = torch.tensor(flow).view(1, 2, 1, 1).expand(1, 2, *size)
        maps = {"flow": shift, "restore_flow": -shift, "restore_valid": torch.ones(1, 1, *size, dtype=torch.bool)}
    return SimpleNamespace(image=torch.zeros(1, 3, *size), has=maps.__contains__, **maps)


@pytest.mark.parametrize("kind", [".flo", ".png"])
def test_optical_flow_between_shifted_pictures_is_that_of_the_clean_ones_less_the_shifts(kind, tmp_path):
    path, valid = tmp_path / f"1{kind}", np.ones((H, W), bool)
    valid[10:14, 20:24] = False
    if kind == ".png":
        write_kitti(path, motion(), valid)
    else:
        assert cv2.writeOpticalFlow(str(path), np.where(valid[..., None], motion(), np.float32(1e10)))
    data = FlowFile(path, "2.jpg").move(degraded((2.0, 1.0)), degraded((5.0, -3.0)))
    if kind == ".png":
        moved, is_valid = read_kitti(data)
    else:
        (tmp_path / "out.flo").write_bytes(data)
        moved = cv2.readOpticalFlow(str(tmp_path / "out.flo"))
        is_valid = np.abs(moved).max(axis=-1) < 1e9
    # Pixel p shows p + (2, 1), which moves by the flow there, and is then shown 5 to the left and 3 below.
    expected, known = np.full((H, W, 2), np.nan), np.zeros((H, W), bool)
    expected[: H - 1, : W - 2], known[: H - 1, : W - 2] = motion()[1:, 2:] + [2 - 5, 1 + 3], valid[1:, 2:]
    y, x = np.mgrid[:H, :W]
    at = expected + np.stack([x + 5, y - 3], axis=-1)  # in the second clean picture, which ends at its edges
    known &= ((at >= 0) & (at <= [W - 1, H - 1])).all(axis=-1)
    assert 200 < known.sum() < valid.sum()
    assert np.array_equal(is_valid, known)
    assert np.abs(moved - expected)[known].max() < 1e-4


def test_the_flow_is_that_of_warp_optical_flow_with_the_validity_of_the_next_picture(tmp_path):
    path = tmp_path / "1.flo"
    assert cv2.writeOpticalFlow(str(path), motion())
    first, second = degraded((0.5, 0.25)), degraded((-1.5, 2.0))
    second.restore_valid[..., :12] = False
    moved = FlowFile(path, "2.png").move(first, second)
    flow = torch.from_numpy(motion()).permute(2, 0, 1)[None]
    expected, valid = warp_optical_flow(
        flow, first.flow, second.restore_flow, restore_valid=second.restore_valid, fill=1e10
    )
    (tmp_path / "out.flo").write_bytes(moved)
    assert np.array_equal(cv2.readOpticalFlow(str(tmp_path / "out.flo")), expected[0].permute(1, 2, 0).numpy())
    assert 0 < valid.sum() < H * W


def test_effects_without_a_flow_keep_the_bytes(tmp_path):
    (tmp_path / "1.flo").write_bytes(b"PIEH" + np.array([W, H], "<i4").tobytes() + motion().tobytes())
    assert FlowFile(tmp_path / "1.flo", "2.png").move(degraded(), degraded()) == (tmp_path / "1.flo").read_bytes()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"PIEH" + np.array([W, H], "<i4").tobytes() + motion().tobytes()[:-4], "is not a complete .flo file"),
        (b"HEIP" + np.array([W, H], "<i4").tobytes() + motion().tobytes(), "is not a complete .flo file"),
        (b"", "is not a complete .flo file"),
        (b"PIEH" + np.array([H, W], "<i4").tobytes() + motion().tobytes(), r"must be of \(24, 40\) px .*got \(40, 24"),
    ],
)
def test_a_damaged_file_and_one_of_another_size_are_named(content, message, tmp_path):
    path = tmp_path / "1.flo"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=f"1.flo {message}"):
        FlowFile(path, "2.png").move(degraded((1.0, 0.0)), degraded((1.0, 0.0)))


def test_a_damaged_png_and_a_next_picture_of_another_size_are_named(tmp_path):
    path = tmp_path / "1.png"
    write_kitti(path, motion(), np.ones((H, W), bool))
    with pytest.raises(ValueError, match=r"2.png must have the size of the picture before, \(24, 40\)"):
        FlowFile(path, "2.png").move(degraded((1.0, 0.0)), degraded((1.0, 0.0), size=(W, H)))
    path.write_bytes(path.read_bytes()[:-30])
    with pytest.raises(ValueError, match=r"1.png.* not a complete PNG"):
        FlowFile(path, "2.png").move(degraded((1.0, 0.0)), degraded((1.0, 0.0)))


@pytest.mark.parametrize(
    ("name", "following"),
    [
        ("one/frame_0009.png", "one/frame_0010.png"),
        ("000000_10.png", "000000_11.png"),
        ("9.jpg", "10.jpg"),
        ("0.5/cam2_frame7_left.png", "0.5/cam2_frame8_left.png"),
        ("frame.png", None),
    ],
)
def test_the_next_picture_has_the_next_number(name, following):
    assert next_picture(name) == following


def test_folders_of_flows_are_told_from_those_of_masks(tmp_path):
    for folder in ("kitti", "flo", "masks", "txt"):
        (tmp_path / folder / "one").mkdir(parents=True)
    write_kitti(tmp_path / "kitti" / "one" / "1.png", motion(), np.ones((H, W), bool))
    assert cv2.writeOpticalFlow(str(tmp_path / "flo" / "one" / "1.flo"), motion())
    for i, dtype in enumerate((np.uint8, np.uint16)):
        assert cv2.imwrite(str(tmp_path / "masks" / f"{i}.png"), np.zeros((H, W), dtype))
    assert cv2.imwrite(str(tmp_path / "masks" / "2.png"), np.zeros((H, W, 3), np.uint8))
    (tmp_path / "txt" / "1.txt").touch()
    assert [read_flows(tmp_path / name) for name in ("masks", "txt", "none")] == [None] * 3
    for name in ("kitti", "flo"):
        flows: Any = read_flows(tmp_path / name)
        assert flows.of("one/1.jpg").following == "one/2.jpg"
        assert flows.of("one/2.jpg") is None
        flows.check(["one/1.jpg", "one/2.jpg", "one/3.jpg"])
        with pytest.raises(UsageError, match=r"labels must name pictures of source, got one/1\.(png|flo) in"):
            flows.check(["one/2.jpg"])
        with pytest.raises(UsageError, match=r"the picture after each.*got none after one/1.jpg; .* consecutive"):
            flows.check(["one/1.jpg", "one/3.jpg"])
    (tmp_path / "flo" / "2.txt").touch()
    with pytest.raises(UsageError, match=r"labels must be a folder of one kind, got .flo and .txt in "):
        read_flows(tmp_path / "flo")
