"""Damaged, hostile and oversized files are read or raise the error of their reader, in little time and memory."""

import io
import itertools
import json
import math
import pickle
import struct
import time
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from torch import nn

from torchrefract import Camera
from torchrefract.cameras import io as camera_io
from torchrefract.cameras.lens_database import COLUMNS, read_lenses
from torchrefract.data.frames import FrameFolder
from torchrefract.data.images import OPENCV_LOG, UnreadableImageError, image_size, read_image
from torchrefract.data.pairs import PairedFolder
from torchrefract.data.pairs.files import FORMATS, DamagedPairError, PairArrays, encode_pair
from torchrefract.data.pairs.manifest import PairRow, StoredFile, read_row
from torchrefract.restoration.checkpoints import CheckpointError, check_fits, read_checkpoint

MAX_SECONDS = 10.0  # for one small file on a busy machine
MAX_MB = 300
CAMERA = Camera(width=640, height=480, fx=500, fy=510, cx=320, cy=240, coefficients=(-0.3, 0.1, 0.001, 0.002))
TRAP = b'!!python/object/apply:pathlib.Path.touch [!!python/object/apply:pathlib.Path ["trapped"]]'
# Fragments that break parsers of numbers, texts and nested documents.
TOKENS = [
    *(b"", b"\0", b"\xff", b"\xff\xfe", b"\n", b"&a ", b"*a", b": ", b"- ", b"&a [*a]", b"<<: *a", b"? [a]\n: b\n"),
    *b"\" ' [ ] { } < > 0 -1 nan .nan NaN inf .inf 1e999 1e308 -0.0 null true 9999-99-99 0b_ 1:30".split(b" "),
    *(b"1" + b"0" * 400, b"9" * 5000, b"0x" + b"F" * 5000, b"[" * 600, b"{" * 600, b"<a>" * 600),
    *(b"!!bool x", b'!!int ""', b"!!timestamp a", b"!!float a", b"!!binary a", TRAP),
    *(struct.pack(">I", 2**32 - 1), struct.pack("<I", 2**31), struct.pack(">HH", 65500, 65500), b"\x80" * 9),
]


class Reader(NamedTuple):
    """An undamaged file, its reader, and the errors that the reader raises for invalid files."""

    path: Path
    data: bytes
    read: Callable[[Path], Any]
    errors: tuple[type[Exception], ...] = (ValueError,)


class Trap:
    """An object whose unpickling calls a function, as in a hostile file."""

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (Path("trapped"),)


@st.composite
def damage(draw: st.DrawFn, original: bytes) -> bytes:
    """Draw a file with changed, missing, repeated or replaced bytes."""
    data = bytearray(original)
    for _ in range(draw(st.integers(1, 3))):
        # Headers are small, and most errors happen in them.
        start = draw(st.integers(0, len(data)) | st.integers(0, min(64, len(data))))
        end = min(len(data), start + draw(st.sampled_from([0, 1, 4, 30])))
        kind = draw(st.sampled_from(["token", "bytes", "cut", "double", "bit"]))
        if kind == "token":
            data[start:end] = draw(st.sampled_from(TOKENS))
        elif kind == "bytes":
            data[start:end] = draw(st.binary(min_size=end - start, max_size=end - start))
        elif kind == "cut":
            del data[start:]
        elif kind == "double":
            data[end:end] = data[start:end] * draw(st.sampled_from([1, 50]))
        elif start < len(data):
            data[start] ^= 1 << draw(st.integers(0, 7))
    return bytes(data)


@contextmanager
def limited_time_and_memory() -> Iterator[None]:
    """Raise AssertionError if the block takes more than MAX_SECONDS or MAX_MB."""
    status, refs = Path("/proc/self/status"), Path("/proc/self/clear_refs")
    if status.is_file():
        refs.write_text("5")  # resets the peak
    before, start = _peak(status), time.monotonic()
    yield
    assert time.monotonic() - start < MAX_SECONDS
    assert _peak(status) - before < MAX_MB


def _peak(status: Path) -> float:
    """Return the peak memory of the process, MB; 0 without /proc."""
    lines = status.read_text().splitlines() if status.is_file() else []
    return next((int(line.split()[1]) / 1024 for line in lines if line.startswith("VmHWM")), 0.0)


def read_or_error(reader: Reader, data: bytes) -> Any:
    """Return the content of a file, or the error if it is one of the reader's; other errors propagate."""
    reader.path.write_bytes(data)
    with limited_time_and_memory():
        try:
            return reader.read(reader.path)
        except reader.errors as error:
            result = error
    assert 0 < len(str(result)) < 2000 + 4 * len(str(reader.path))
    return result


def fuzz(reader: Reader, *, full: bool) -> None:
    """Read many damaged versions of a file."""
    suppressed = [HealthCheck.too_slow, HealthCheck.data_too_large]
    options: Any = {"derandomize": True, "deadline": None, "database": None, "suppress_health_check": suppressed}

    @settings(max_examples=3000 if full else 40, **options)
    @given(damage(reader.data))
    def read_one(data: bytes) -> None:
        read_or_error(reader, data)

    read_one()


@pytest.fixture(autouse=True)
def no_code_runs(tmp_path, monkeypatch) -> Iterator[None]:
    """Check that reading runs no code from a file."""
    monkeypatch.chdir(tmp_path)
    yield
    assert not Path("trapped").exists()


def noise(height: int = 24, width: int = 32, kind: type = np.uint8) -> np.ndarray:
    """Return random pixels."""
    return np.random.default_rng(0).integers(0, np.iinfo(kind).max, (height, width, 3)).astype(kind)


PNG = cv2.imencode(".png", noise())[1].tobytes()


def images(folder: Path) -> Iterator[Reader]:
    """Yield image files of all formats, for `read_image` and `image_size`."""
    errors = (UnreadableImageError,)
    for kind, options in {".jpg": [], ".png": [], ".bmp": [], ".webp": [cv2.IMWRITE_WEBP_QUALITY, 101]}.items():
        data = cv2.imencode(kind, noise(), options)[1].tobytes()
        yield Reader(folder / "image", data, read_image, errors)
        yield Reader(folder / "image", data, image_size, errors)
    yield Reader(folder / "image", cv2.imencode(".png", noise(kind=np.uint16))[1].tobytes(), read_image, errors)


def frames(folder: Path) -> Iterator[Reader]:
    """Yield a frame among others of two drives."""
    paths = [folder / f"drive{i // 6}" / f"{i}.png" for i in range(12)]
    for path in paths:
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(PNG)

    def read(_: Path) -> list[Any]:
        folder_frames = FrameFolder(folder, size=(12, 16))
        assert len(folder_frames) + len(folder_frames.skipped) == 12
        return [folder_frames[i] for i in range(len(folder_frames))]

    yield Reader(paths[0], PNG, read, (ValueError, UserWarning))


TABLE = ",".join(COLUMNS) + '\na,b,c,opencv,640,480,500,500,320,240,"[-0.3, 0.1, 0, 0]",,0.1,1,s,l\n'
COLMAP_BINARY = struct.pack("<QiiQQ8d", 1, 1, 4, 640, 480, 500, 510, 320, 240, -0.3, 0.1, 0.001, 0.002)
LENSFUN = """<lensdatabase><lens><model>a</model><cropfactor>2</cropfactor><aspect-ratio>640:480</aspect-ratio>
<calibration><distortion model="poly3" focal="500" k1="-0.03"/></calibration></lens></lensdatabase>"""
NUMBERS = {"fx": 500, "fy": 510, "cx": 320, "cy": 240, "k1": -0.3, "k2": 0.1, "p1": 0.001, "p2": 0.002}
PROFILES = {
    "topic.yaml": "header:\n  seq: 1\nheight: 480\nwidth: 640\ndistortion_model: plumb_bob\nd: [-0.3, 0.1, 0, 0, 0]\n"
    "k: [500, 0, 320, 0, 510, 240, 0, 0, 1]\n---\n",
    "gyroflow.json": '{"calib_dimension": {"w": 640, "h": 480}, "fisheye_params": {"distortion_coeffs": [0.1, 0, 0, 0],'
    ' "camera_matrix": [[500, 0, 320], [0, 510, 240], [0, 0, 1]]}}',
    "metashape.xml": "<calibration><projection>frame</projection><width>640</width><height>480</height>"
    "<f>500</f><cx>1</cx><k1>-0.3</k1></calibration>",
    "orb_slam.yaml": "".join(f"Camera.{name}: {value}\n" for name, value in NUMBERS.items())
    + "Camera.width: 640\nCamera.height: 480\n",
    "vins.yaml": "%YAML:1.0\n---\nmodel_type: PINHOLE\nimage_width: 640\nimage_height: 480\nprojection_parameters:\n"
    + "".join(f"  {name}: {value}\n" for name, value in NUMBERS.items()),
}
WRITTEN: dict[str, tuple[Callable[..., Any], Callable[[Path], Any]]] = {  # writers and readers
    "opencv.yaml": (partial(camera_io.write_opencv, camera=CAMERA), camera_io.read_opencv),
    "opencv.xml": (partial(camera_io.write_opencv, camera=CAMERA), camera_io.read_opencv),
    "ros.yaml": (partial(camera_io.write_ros, camera=CAMERA), camera_io.read_ros),
    "kalibr.yaml": (partial(camera_io.write_kalibr, cameras={"cam0": CAMERA}), camera_io.read_kalibr),
    "cameras.txt": (partial(camera_io.write_colmap, cameras={1: CAMERA}), camera_io.read_colmap),
    "lenses.csv": (partial(Path.write_text, data=TABLE), read_lenses),
    "cameras.bin": (partial(Path.write_bytes, data=COLMAP_BINARY), camera_io.read_colmap),
    "lensfun.xml": (partial(Path.write_text, data=LENSFUN), partial(camera_io.read_camera, width=640, height=480)),
    **{name: (partial(Path.write_text, data=text), camera_io.read_camera) for name, text in PROFILES.items()},
}


def camera_files(folder: Path) -> Iterator[Reader]:
    """Yield camera files of all formats, and a lens database."""
    for name, (write, read) in WRITTEN.items():
        write(folder / name)
        yield Reader(folder / name, (folder / name).read_bytes(), read, (ValueError, UserWarning))


@pytest.fixture
def camera_file(tmp_path) -> Callable[[str], Reader]:
    """Return a camera file by its name."""
    readers = {reader.path.name: reader for reader in camera_files(tmp_path)}
    return readers.__getitem__


def jpeg(height: int, width: int) -> bytes:
    """Return a JPEG file of 24 x 32 pixels whose header claims another size."""
    data = bytearray(cv2.imencode(".jpg", noise())[1].tobytes())
    at = data.index(b"\xff\xc0") + 5
    data[at : at + 4] = struct.pack(">HH", height, width)
    return bytes(data)


def chunk(kind: bytes, data: bytes, *, length: int | None = None) -> bytes:
    """Return a chunk of a PNG, whose header may claim another length."""
    length = len(data) if length is None else length
    return struct.pack(">I", length) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def png(height: int, width: int, *, length: int | None = None) -> bytes:
    """Return a PNG whose header claims a size, with 1000 bytes of pixels."""
    head = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 16, 2, 0, 0, 0))
    body = chunk(b"IDAT", zlib.compress(bytes(1000)), length=length)
    return b"\x89PNG\r\n\x1a\n" + head + body + chunk(b"IEND", b"")


def bmp(height: int, width: int) -> bytes:
    """Return a BMP file of 24 x 32 pixels whose header claims another size."""
    data = cv2.imencode(".bmp", noise())[1].tobytes()
    return data[:18] + struct.pack("<ii", width, height) + data[26:]


CLAIMS = {
    "jpeg 30000": jpeg(30_000, 30_000),
    "jpeg 65500": jpeg(65_500, 65_500),
    "png 30000": png(30_000, 30_000),
    "png 100000": png(100_000, 100_000),
    "png 2^31": png(2**31 - 1, 2**31 - 1),
    "png with a chunk of 4 GB": png(24, 32, length=2**32 - 200),
    "bmp 100000": bmp(100_000, 100_000),
    "bmp -2^31": bmp(-(2**31), 2**31 - 1),
}


@pytest.mark.parametrize("claim", CLAIMS)
def test_an_image_that_claims_a_huge_size_takes_no_memory(claim, tmp_path):
    reader = Reader(tmp_path / "image", CLAIMS[claim], read_image, (UnreadableImageError,))
    assert isinstance(read_or_error(reader, reader.data), UnreadableImageError)


def test_threads_that_read_images_keep_the_log_level(tmp_path):
    path = tmp_path / "a.png"
    path.write_bytes(PNG)
    expected, before = read_image(path), OPENCV_LOG.getLogLevel()
    level = 3  # warnings
    OPENCV_LOG.setLogLevel(level)
    try:
        with ThreadPoolExecutor(8) as pool:
            results = list(pool.map(lambda _: read_image(path), range(400)))
        assert OPENCV_LOG.getLogLevel() == level
    finally:
        OPENCV_LOG.setLogLevel(before)
    assert all(torch.equal(image, expected) for image in results)


@pytest.mark.parametrize("name", WRITTEN)
def test_an_invalid_value_in_a_camera_file_names_the_file(name, camera_file):
    reader = camera_file(name)
    values = [value for value in (b"640", b"500", b"radtan", b"plumb_bob", b"opencv") if value in reader.data]
    for value, token in itertools.product(values, filter(None, TOKENS)):
        result = read_or_error(reader, reader.data.replace(value, token, 1))
        assert not isinstance(result, Exception) or str(reader.path) in str(result), (value, token)


def bomb(levels: int) -> bytes:
    """Return YAML whose aliases make each list ten times as long as the one before."""
    lists = [b"a0: &a0 [1, 1, 1, 1, 1, 1, 1, 1, 1, 1]"]
    lists += [b"a%d: &a%d [%s]" % (i, i, b", ".join([b"*a%d" % (i - 1)] * 10)) for i in range(1, levels)]
    return b"\n".join(lists) + b"\n"


def merge_bomb(levels: int) -> bytes:
    """Return YAML whose mappings each merge the one before ten times."""
    maps = [b"a0: &a0 {a: 1, b: 2, c: 3}"]
    maps += [b"a%d: &a%d {<<: [%s]}" % (i, i, b", ".join([b"*a%d" % (i - 1)] * 10)) for i in range(1, levels)]
    return b"\n".join(maps) + b"\n"


@pytest.mark.parametrize("field", [b"640", b"500.0", b"plumb_bob", b"radtan", b"pinhole"])
def test_yaml_aliases_fill_neither_the_memory_nor_the_message(field, camera_file):
    for reader in (camera_file("ros.yaml"), camera_file("kalibr.yaml")):
        if field in reader.data:
            result = read_or_error(reader, bomb(9) + reader.data.replace(field, b"*a8", 1))
            assert reader.path.name in str(result)


def test_yaml_merges_do_not_fill_the_memory(camera_file):
    reader = camera_file("ros.yaml")
    assert "merge key" in str(read_or_error(reader, merge_bomb(9) + reader.data))


@pytest.mark.parametrize("declared", ["entities", "external"])
def test_xml_entities_fill_no_memory_and_open_no_file(declared, tmp_path):
    entities = '<!ENTITY a0 "aaaaaaaaaa">'
    entities += "".join(f'<!ENTITY a{i} "{f"&a{i - 1};" * 10}">' for i in range(1, 10))
    if declared == "external":
        (tmp_path / "secret").write_text("640")
        entities = f'<!ENTITY a9 SYSTEM "file://{tmp_path}/secret">'
    body = "<opencv_storage><image_width>&a9;</image_width></opencv_storage>"
    text = f'<?xml version="1.0"?><!DOCTYPE a [{entities}]>{body}'
    reader = Reader(tmp_path / "a.xml", text.encode(), camera_io.read_opencv)
    assert isinstance(read_or_error(reader, reader.data), ValueError)


ROW = PairRow(
    *(3, "d/3.png", None, "d", "train", "scene", 1, 2, 16, 24),
    effects=[],
    beyond={"flow": 0},
    files={"clean.png": StoredFile("pairs/0/3.clean.png", 3, "ab")},
)


def manifest_row(folder: Path) -> Iterator[Reader]:
    """Yield a row of a manifest in a file of its own."""

    def read(path: Path) -> PairRow:
        row = read_row(path.read_bytes())
        assert row.as_line()
        assert all(file.bytes >= 0 and file.path.startswith(("pairs/", "tars/")) for file in row.files.values())
        return row

    yield Reader(folder / "row", ROW.as_line().encode(), read, (DamagedPairError,))


@pytest.mark.parametrize("value", [None, math.inf, 1.5, "x", [1], {}, True, -1, 2**63, 10**400])
def test_a_row_of_a_manifest_with_a_value_of_another_type_raises(value):
    for name in ("number", "height", "width"):
        with pytest.raises(DamagedPairError, match="a row must"):
            read_row(json.dumps(ROW._asdict() | {name: value, "files": {}}).encode())
    if value != -1:
        for name in ("seed", "key", "source", "drive", "split", "scene", "effects", "beyond"):
            if (name, value) not in (("source", "x"), ("drive", "x"), ("split", "x"), ("scene", "x"), ("beyond", {})):
                with pytest.raises(DamagedPairError, match="a row must"):
                    read_row(json.dumps(ROW._asdict() | {name: value, "files": {}}).encode())
    file = {"path": "pairs/0/3.clean.png", "bytes": 3, "sha256": "ab", "offset": 0}
    for name in ("bytes", "offset"):
        with pytest.raises(DamagedPairError, match="a row must"):
            read_row(json.dumps(ROW._asdict() | {"files": {"clean.png": file | {name: value}}}).encode())


def pair_set(folder: Path, form: str) -> dict[str, bytes]:
    """Write a pair and its manifest, and return the content of its files."""
    random, size = np.random.default_rng(1), (16, 24)
    maps: dict[str, np.ndarray] = {name: np.ones(size, bool) for name in ("valid", "restore_valid")}
    maps |= {name: random.normal(size=(2, *size)).astype(np.float32) for name in ("flow", "restore_flow")}
    files = encode_pair(PairArrays(noise(*size), noise(*size), maps), form)
    stored = {suffix: StoredFile(f"pairs/0/3.{suffix}", len(data), "ab") for suffix, data in files.items()}
    for suffix, file in stored.items():
        (folder / file.path).parent.mkdir(parents=True, exist_ok=True)
        (folder / file.path).write_bytes(files[suffix])
    (folder / "manifest.jsonl").write_text(ROW._replace(files=stored).as_line())
    return files


def first_pair(folder: Path, suffix: str, path: Path) -> Any:
    """Read the pair after one of its files, and its size in the manifest, changed."""
    manifest = folder / "manifest.jsonl"
    row = read_row(manifest.read_bytes())
    stored = row.files | {suffix: row.files[suffix]._replace(bytes=path.stat().st_size)}
    manifest.write_text(row._replace(files=stored).as_line())
    return PairedFolder(folder)[0]


def pair_files(folder: Path) -> Iterator[Reader]:
    """Yield the files of a pair in each format; the corrupted image has the format of the clean one."""
    for form in FORMATS:
        for suffix, data in pair_set(folder, form).items():
            if suffix != "corrupted.png":
                pair_set(folder, form)
                path = folder / "pairs" / "0" / f"3.{suffix}"
                yield Reader(path, data, partial(first_pair, folder, suffix), (DamagedPairError,))


def npz(shape: tuple[int, ...]) -> bytes:
    """Return an archive without data whose flow claims a shape."""
    head = repr({"descr": "<f4", "fortran_order": False, "shape": shape}).encode()
    head += b" " * (64 - (len(head) + 11) % 64) + b"\n"
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        archive.writestr("restore_flow.npy", b"\x93NUMPY\x01\x00" + struct.pack("<H", len(head)) + head)
    return stream.getvalue()


def compressed_zeros(count: int) -> bytes:
    """Return a compressed archive of zeros."""
    stream = io.BytesIO()
    np.savez_compressed(stream, restore_flow=np.zeros(count))
    return stream.getvalue()


@pytest.mark.parametrize("shape", [(2, 10**6, 10**6), (2, 30_000, 30_000), (2**62, 4), (-1, 3), (10**30,), "zeros"])
def test_an_array_that_claims_a_huge_shape_takes_no_memory(shape, tmp_path):
    pair_set(tmp_path, "npz")
    data = compressed_zeros(20_000_000) if shape == "zeros" else npz(shape)
    assert len(data) < 2**18
    read = partial(first_pair, tmp_path, "maps.npz")
    result = read_or_error(Reader(tmp_path / "pairs/0/3.maps.npz", data, read, (DamagedPairError,)), data)
    assert isinstance(result, DamagedPairError)
    assert shape != "zeros" or "claims more" in str(result)


def content(**more: Any) -> dict[str, Any]:
    """Return the content of a checkpoint."""
    return {"state_dict": nn.Linear(8, 8).state_dict(), "task": "undistort", "epoch": 3} | more


def read_weights(path: Path) -> dict[str, Any]:
    """Read a checkpoint and check it against its model."""
    checkpoint = read_checkpoint(path, task="undistort")
    check_fits(checkpoint, nn.Linear(8, 8), path)
    return checkpoint


def saved(value: Any) -> bytes:
    """Return the bytes of a saved value."""
    stream = io.BytesIO()
    torch.save(value, stream)
    return stream.getvalue()


def resealed(data: bytes, change: Callable[[bytes], bytes]) -> bytes:
    """Change the pickle in an archive, with valid checksums."""
    stream = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(data)) as old, zipfile.ZipFile(stream, "w") as new:
        for name in old.namelist():
            new.writestr(name, change(old.read(name)) if name.endswith("data.pkl") else old.read(name))
    return stream.getvalue()


def checkpoints(folder: Path) -> Iterator[Reader]:
    """Yield a checkpoint, and the pickle in its archive."""
    path, archived = folder / "last.ckpt", saved(content())
    yield Reader(path, archived, read_weights, (CheckpointError,))
    with zipfile.ZipFile(io.BytesIO(archived)) as archive:
        (name,) = (name for name in archive.namelist() if name.endswith("data.pkl"))
        inner = archive.read(name)

    def read(path: Path) -> Any:
        path.write_bytes(resealed(archived, lambda _: path.read_bytes()))
        return read_weights(path)

    yield Reader(path, inner, read, (CheckpointError,))


FILES = (images, frames, camera_files, manifest_row, pair_files, checkpoints)


@pytest.mark.filterwarnings("ignore:Detected pickle protocol:UserWarning")  # torch warns before it raises
@pytest.mark.parametrize("files", FILES)
def test_a_damaged_file_is_read_or_raises(files, tmp_path, full_extremes):
    for reader in files(tmp_path):
        assert not isinstance(read_or_error(reader, reader.data), Exception), reader.path
        fuzz(reader, full=full_extremes)
        reader.path.write_bytes(reader.data)


INVALID_CHECKPOINTS: Mapping[str, Any] = {
    "task of two values": content(task=torch.ones(2)),
    "no task": content(task=None),
    "list of weights": content(state_dict=[1, 2]),
    "numbers as weights": content(state_dict={"weight": 1.0, "bias": 2.0}),
    "numbers as names": content(state_dict={1: torch.ones(2), "bias": torch.ones(2)}),
    "nested lists": content(more=json.loads("[" * 60 + "]" * 60)),
    "huge weights": content(state_dict={"weight": torch.empty(1, 1).expand(10**6, 10**6), "bias": torch.ones(8)}),
}


@pytest.mark.parametrize("name", INVALID_CHECKPOINTS)
def test_an_invalid_checkpoint_raises(name, tmp_path):
    reader = Reader(tmp_path / "last.ckpt", saved(INVALID_CHECKPOINTS[name]), read_weights, (CheckpointError,))
    result = read_or_error(reader, reader.data)
    assert isinstance(result, CheckpointError) or name == "nested lists"


@pytest.mark.filterwarnings("ignore:Detected pickle protocol:UserWarning")  # torch warns before it raises
@pytest.mark.parametrize("container", ["pickle", "archive"])
def test_code_in_a_checkpoint_does_not_run(container, tmp_path):
    data = pickle.dumps(Trap())
    data = resealed(saved(content()), lambda _: data) if container == "archive" else data
    reader = Reader(tmp_path / "last.ckpt", data, read_weights, (CheckpointError,))
    assert isinstance(read_or_error(reader, data), CheckpointError)


@pytest.mark.parametrize("text", [TRAP, b"a: [", b"a: 'b", b"\0"])
def test_an_invalid_configuration_raises_an_error_of_one_line(text, call, tmp_path):
    (tmp_path / "configs" / "task").mkdir(parents=True)
    (tmp_path / "configs" / "task" / "mine.yaml").write_bytes(b"# @package _global_\n" + text + b"\n")
    outcome = call("train", "--config-dir", "configs", "+task=mine")
    assert "mine.yaml" in outcome.message
