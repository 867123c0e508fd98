import io

import numpy as np
import pytest
from PIL import Image

from torchrefract.data.images import UnreadableImageError, read_image

KINDS = {
    "baseline": {},
    "progressive": {"progressive": True},
    "full chroma": {"subsampling": 0},
    "restarts": {"restart_marker_rows": 1},
    "gray": {"mode": "L"},
    "turned": {"exif": b"Exif\0\0MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x06\0\0\0\0\0\0"},
}


def encode(pixels: np.ndarray, *, mode: str = "RGB", **options) -> bytes:
    stream = io.BytesIO()
    Image.fromarray(pixels).convert(mode).save(stream, "JPEG", quality=90, **options)
    return stream.getvalue()


@pytest.fixture(scope="module")
def pixels() -> np.ndarray:
    y, x = np.mgrid[:121, :163]
    waves = 127 + 60 * np.sin(x / 9) + 40 * np.cos(y / 7) + np.random.default_rng(0).normal(0, 8, (3, 121, 163))
    return waves.clip(0, 255).astype(np.uint8).transpose(1, 2, 0)


@pytest.mark.quick
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.filterwarnings("ignore:Corrupt EXIF")
def test_a_jpeg_without_a_part_of_its_rows_raises(tmp_path, pixels, kind, capfd):
    data, path = encode(pixels, **KINDS[kind]), tmp_path / "image.jpg"
    path.write_bytes(data + b"appended by a phone \xff\xd9")
    read_image(path)
    for start, end in ((0.5, 1), (0.75, 1), (0.95, 1), (0.4, 0.6))[: 3 if kind == "progressive" else 4]:
        cut = data[: int(start * len(data))] + (data[int(end * len(data)) :] or b"\xff\xd9")
        path.write_bytes(cut)
        with pytest.raises(UnreadableImageError, match=r"image\.jpg is damaged: a part of its pixels is missing"):
            read_image(path)


@pytest.mark.parametrize("size", [(16, 16), (1, 1), (3, 200), (64, 48)])
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.filterwarnings("ignore:Corrupt EXIF")
def test_a_complete_jpeg_that_is_gray_is_read(tmp_path, kind, size, capfd):
    path = tmp_path / "image.jpg"
    path.write_bytes(encode(np.full((*size, 3), 128, np.uint8), **KINDS[kind]))
    assert (read_image(path) == 128 / 255).all()
    assert capfd.readouterr().err == ""  # a decoder would say that the file is corrupt
