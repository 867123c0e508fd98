import io
import os

import cv2
import numpy as np
import pytest
import torch
from PIL import Image
from torch.testing import assert_close

from torchrefract.data.images import OPENCV_LOG, UnreadableImageError, files_in, fit, image_size, pixels_of, read_image

RNG = np.random.default_rng(0)
PIXELS = RNG.integers(0, 256, (36, 50, 3), dtype=np.uint8)
PIXELS_16 = RNG.integers(0, 65536, (36, 50, 3), dtype=np.uint16)
SMOOTH = cv2.GaussianBlur(PIXELS, (0, 0), 4)
FORMATS = {
    "jpg": {"format": "JPEG"},
    "progressive.jpg": {"format": "JPEG", "progressive": True},
    "png": {"format": "PNG"},
    "webp": {"format": "WEBP"},
    "lossless.webp": {"format": "WEBP", "lossless": True},
    "bmp": {"format": "BMP"},
}


def encode(pixels: np.ndarray, **options) -> bytes:
    stream = io.BytesIO()
    Image.fromarray(pixels).save(stream, **options)
    return stream.getvalue()


def as_tensor(pixels: np.ndarray) -> torch.Tensor:
    """Divide (H, W, 3) integers by the largest one of their type."""
    scale = np.float32(np.iinfo(pixels.dtype).max)
    return torch.from_numpy((pixels.astype(np.float32) / scale).transpose(2, 0, 1).copy())


@pytest.mark.quick
@pytest.mark.parametrize("suffix", ["png", "bmp", "lossless.webp"])
def test_eight_bit_pixels_come_back_exactly(tmp_path, suffix):
    path = tmp_path / f"frame.{suffix}"
    path.write_bytes(encode(PIXELS, **FORMATS[suffix]))
    assert_close(read_image(path), as_tensor(PIXELS), rtol=0, atol=0)
    assert_close(read_image(str(path)), read_image(path), rtol=0, atol=0)


def test_pixels_of_inverts_read_image_of_eight_bits(tmp_path):
    every = np.arange(3 * 256, dtype=np.uint8).reshape(3, 256).T.reshape(16, 16, 3).copy()
    cv2.imwrite(str(tmp_path / "all.png"), every[..., ::-1])
    image = read_image(tmp_path / "all.png")
    for same in (image, image.contiguous(), torch.cat([image, image], dim=2)[..., :16]):
        pixels = pixels_of(same)
        assert pixels.flags["C_CONTIGUOUS"]
        np.testing.assert_array_equal(pixels, every)


def test_pixels_of_rounds_to_the_nearest_level_and_clips():
    values = torch.tensor([-9.0, -0.1, 0.0, 0.49 / 255, 0.51 / 255, 254.4 / 255, 254.6 / 255, 1.0, 1.1, 300.0])
    image = values.expand(3, 2, -1).contiguous().requires_grad_()
    assert pixels_of(image)[1, :, 2].tolist() == [0, 0, 0, 0, 1, 254, 255, 255, 255, 255]


def test_sixteen_bit_pixels_come_back_exactly(tmp_path):
    assert cv2.imwrite(str(tmp_path / "color.png"), PIXELS_16[..., ::-1])
    assert_close(read_image(tmp_path / "color.png"), as_tensor(PIXELS_16), rtol=0, atol=0)
    Image.fromarray(PIXELS_16[..., 0]).save(tmp_path / "gray.png")
    expected = as_tensor(np.repeat(PIXELS_16[..., :1], 3, axis=2))
    assert_close(read_image(tmp_path / "gray.png"), expected, rtol=0, atol=0)


@pytest.mark.parametrize("suffix", ["png", "bmp", "webp"])
@pytest.mark.parametrize("mode", ["L", "RGBA", "P", "1"])
def test_images_of_any_mode_are_read_in_their_colors_without_alpha(tmp_path, suffix, mode):
    image = (
        Image.fromarray(np.dstack([PIXELS, PIXELS[..., :1]]))
        if mode == "RGBA"
        else Image.fromarray(PIXELS).convert(mode)
    )
    image.save(tmp_path / f"frame.{suffix}", lossless=True, exact=True)  # options of WebP alone
    expected = PIXELS if mode == "RGBA" else np.asarray(image.convert("RGB"))
    assert_close(read_image(tmp_path / f"frame.{suffix}"), as_tensor(expected), rtol=0, atol=0)


@pytest.mark.parametrize("suffix", ["jpg", "progressive.jpg", "webp"])
def test_lossy_images_agree_with_pillow(tmp_path, suffix):
    path = tmp_path / f"frame.{suffix}"
    path.write_bytes(encode(SMOOTH, quality=95, **FORMATS[suffix]))
    expected = as_tensor(np.asarray(Image.open(path).convert("RGB")))
    # Decoders may round and interpolate color differently, by a few of 255 levels.
    assert_close(read_image(path), expected, rtol=0, atol=4 / 255)


@pytest.mark.parametrize("suffix", ["jpg", "png", "webp"])
@pytest.mark.parametrize(("orientation", "quarter_turns"), [(1, 0), (3, 2), (6, 3), (8, 1)])
def test_the_exif_orientation_is_applied(tmp_path, suffix, orientation, quarter_turns):
    exif = Image.Exif()
    exif[0x0112] = orientation
    path = tmp_path / f"frame.{suffix}"
    path.write_bytes(encode(SMOOTH, exif=exif, quality=95, **FORMATS[suffix]))
    expected = as_tensor(np.rot90(SMOOTH, quarter_turns))
    assert (read_image(path) - expected).abs().mean() < 4 / 255
    assert image_size(path) == expected.shape[1:]


def test_the_format_follows_from_the_content_and_not_from_the_suffix(tmp_path):
    (tmp_path / "frame.jpg").write_bytes(encode(PIXELS, format="PNG"))
    assert_close(read_image(tmp_path / "frame.jpg"), as_tensor(PIXELS), rtol=0, atol=0)


@pytest.mark.parametrize("read", [read_image, image_size])
@pytest.mark.parametrize("suffix", FORMATS)
def test_a_truncated_image_raises_and_prints_nothing(tmp_path, capfd, read, suffix):
    data = encode(SMOOTH, **FORMATS[suffix])
    path = tmp_path / f"frame_12.{suffix}"
    half = data[: len(data) // 2]
    zeroed = [half + bytes(len(data) - len(half))] if suffix.endswith(("jpg", "png")) else []  # others have no end
    for content in (data[: max(16, int(0.3 * len(data)))], data[:-2], *zeroed):
        path.write_bytes(content)
        with pytest.raises(UnreadableImageError, match=rf"frame_12\.{suffix} is truncated \(\d+ bytes"):
            read(path)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("read", [read_image, image_size])
def test_the_end_of_a_thumbnail_is_not_the_end_of_the_image(tmp_path, read):
    data = encode(SMOOTH, format="JPEG")
    thumbnail = b"Exif\0\0" + encode(PIXELS[:8, :8], format="JPEG")
    segment = b"\xff\xe1" + (len(thumbnail) + 2).to_bytes(2, "big") + thumbnail
    (tmp_path / "frame.jpg").write_bytes((data[:2] + segment + data[2:])[:-200])
    with pytest.raises(UnreadableImageError, match="is truncated"):
        read(tmp_path / "frame.jpg")


@pytest.mark.parametrize("suffix", FORMATS)
def test_bytes_after_the_end_are_ignored(tmp_path, suffix):
    path = tmp_path / f"frame.{suffix}"
    path.write_bytes(encode(SMOOTH, **FORMATS[suffix]))
    expected = read_image(path)
    path.write_bytes(path.read_bytes() + bytes(10_000))
    assert_close(read_image(path), expected, rtol=0, atol=0)
    assert image_size(path) == (36, 50)


@pytest.mark.parametrize("read", [read_image, image_size])
def test_a_file_that_is_not_an_image_raises_with_the_reason(tmp_path, read):
    for data, reason in (
        (None, r"cannot be opened \(No such file"),
        (b"", r"is empty \(0 bytes\)"),
        (b"\xff\xd8", "is not a JPEG, PNG, WebP or BMP image"),
        (b"<html>404</html>", "is not a JPEG"),
        (b"RIFF\x04\0\0\0WAVE", "is not a JPEG"),
        (b"BM\x02\0\0\0", "is truncated"),
    ):
        if data is not None:
            (tmp_path / "frame_7.jpg").write_bytes(data)
        with pytest.raises(UnreadableImageError, match=rf"frame_7\.jpg {reason}"):
            read(tmp_path / "frame_7.jpg")


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes")
@pytest.mark.parametrize("read", [read_image, image_size])
def test_a_pipe_raises_instead_of_blocking(tmp_path, read):
    os.mkfifo(tmp_path / "frame.jpg")
    with pytest.raises(UnreadableImageError, match=r"frame\.jpg cannot be opened \(a pipe or a device\)"):
        read(tmp_path / "frame.jpg")


def test_files_in_lists_files_by_name_without_folders_and_hidden_files(tmp_path):
    for name in ("b.png", "a.JPG", "notes.txt", "._b.png", "dead.png"):
        (tmp_path / name).touch()
    (tmp_path / "folder.png").mkdir()
    (tmp_path / "dead.png").unlink()
    (tmp_path / "dead.png").symlink_to("gone.png")  # a broken link is listed, so that reading it raises
    assert [file.name for file in files_in(tmp_path)] == ["a.JPG", "b.png", "dead.png"]
    assert [file.name for file in files_in(tmp_path, (".txt",))] == ["notes.txt"]


def test_damage_between_header_and_end_raises_on_reading(tmp_path, capfd):
    data = bytearray(encode(PIXELS, format="PNG"))
    middle = len(data) // 2
    data[middle : middle + 200] = bytes(200)
    (tmp_path / "frame.png").write_bytes(data)
    assert image_size(tmp_path / "frame.png") == (36, 50)
    level = OPENCV_LOG.getLogLevel()
    with pytest.raises(UnreadableImageError, match=r"frame\.png is damaged"):
        read_image(tmp_path / "frame.png")
    assert OPENCV_LOG.getLogLevel() == level
    assert "WARN" not in capfd.readouterr().err


def test_an_invalid_header_raises(tmp_path):
    data = bytearray(encode(PIXELS, format="BMP"))
    data[14:18] = (9).to_bytes(4, "little")  # no BMP header has 9 bytes
    (tmp_path / "frame.bmp").write_bytes(data)
    with pytest.raises(UnreadableImageError, match=r"frame\.bmp has a damaged header"):
        image_size(tmp_path / "frame.bmp")


def box_weights(coarse: int, fine: int) -> torch.Tensor:
    """Return (coarse, fine), the overlap of each fine cell and each coarse one, in units of a coarse cell."""
    ends = torch.arange(coarse, dtype=torch.float64)[:, None] * fine / coarse
    cells = torch.arange(fine, dtype=torch.float64)
    overlap = torch.minimum(ends + fine / coarse, cells + 1) - torch.maximum(ends, cells)
    return overlap.clamp(min=0) * coarse / fine


@pytest.mark.parametrize(("size", "crop"), [((18, 25), (36, 50)), ((9, 16), (28, 50)), ((8, 8), (36, 36))])
def test_fit_is_the_area_average_of_the_center(size, crop):
    image = as_tensor(PIXELS)
    top, left = (36 - crop[0]) // 2, (50 - crop[1]) // 2
    center = image[:, top : top + crop[0], left : left + crop[1]].double()
    expected = box_weights(size[0], crop[0]) @ center @ box_weights(size[1], crop[1]).T
    result = fit(image, size)
    assert_close(result, expected.float(), rtol=0, atol=1e-6)
    assert result.is_contiguous()


def test_fit_copies_an_image_of_the_same_size_and_never_enlarges():
    image = as_tensor(PIXELS)
    fit(image, (36, 50)).zero_()
    assert_close(fit(image, [36, 50]), as_tensor(PIXELS), rtol=0, atol=0)
    for size in ((37, 50), (36, 51)):
        with pytest.raises(ValueError, match=r"image must be at least size = .* got 36x50"):
            fit(image, size)


@pytest.mark.parametrize(
    ("image", "size", "error", "message"),
    [
        (torch.zeros(3, 8, 8), (4,), ValueError, r"size must be \(height, width\), got \(4,\)"),
        (torch.zeros(1, 8, 8), (4, 4), ValueError, r"image must have shape \(3, H, W\), got \(1, 8, 8\)"),
        (torch.zeros(3, 8, 8).byte(), (4, 4), TypeError, "image must be float32 on the CPU, got torch.uint8"),
    ],
)
def test_fit_raises_for_an_invalid_argument(image, size, error, message):
    with pytest.raises(error, match=message):
        fit(image, size)
