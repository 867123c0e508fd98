"""What the files of a pair on disk hold, and how they are written and read.

PNG files are read by every program: pictures of 8 bits, flows of 16 bits as the KITTI benchmark has them, light of 16
bits. npz and safetensors files hold the maps as they were computed, in float32.
"""

import io
import zipfile
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, TypeVar

import cv2
import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load, save

from torchrefract.data.images import png_fits

_T = TypeVar("_T")

FORMATS = ("png", "npz", "safetensors")
FLOWS = {"flow": "valid", "restore_flow": "restore_valid"}  # and the mask that tells where each holds
LIGHTS = {"transmission": 65535, "intensity": 32768}  # and the steps of a unit of each
MASKS = tuple(FLOWS.values())
PICTURES = ("clean", "corrupted")

_STEPS, _ZERO, _TOP = 64, 1 << 15, (1 << 16) - 1  # of a flow: steps of a px, the step of 0 px, the largest step
_PACKED = 1032  # bytes that zlib makes one of at best
_TOGETHER = "maps"  # what the one file of an npz or safetensors pair is called

# The fastest level of zlib. Differences to the row above pack pictures best, those to the left neighbor maps.
_FAST = [cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_DEFAULT]
_OF_PICTURES = [*_FAST, cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_UP]
_OF_MAPS = [*_FAST, cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_SUB]


# What readers of npz raise for damage depends on where it is; arrays larger than any memory are damage, too.
_DAMAGE = (ValueError, OSError, EOFError, LookupError, ArithmeticError, RuntimeError, MemoryError, SyntaxError)
_DAMAGE += (TypeError, zipfile.BadZipFile, SafetensorError, cv2.error)
_MOST_SAID = 500  # characters of their messages


class DamagedPairError(ValueError):
    """A file of a pair that does not hold what it should; the message says what."""


class PairArrays(NamedTuple):
    """A pair in memory; maps that its scene does not have are missing.

    clean, corrupted: (H, W, 3), uint8, RGB.
    maps: flow and restore_flow (2, H, W), float32, px; transmission and intensity (H, W), float32; valid and
        restore_valid (H, W), bool; each by its name.
    """

    clean: np.ndarray
    corrupted: np.ndarray
    maps: Mapping[str, np.ndarray]


def encode_pair(pair: PairArrays, form: str) -> dict[str, bytes]:
    """The files of a pair, by what follows the name of the pair in theirs: "clean.png", "flow.png".

    Args:
        pair: to write.
        form: of the maps, "png", "npz" or "safetensors".

    Raises:
        ValueError: light of 2 or above as a PNG.
    """
    files = {f"{name}.png": _png(getattr(pair, name)[..., ::-1], _OF_PICTURES) for name in PICTURES}
    if form != "png":
        # safetensors writes memory as it lies.
        arrays = {name: np.ascontiguousarray(pair.maps[name]) for name in sorted(pair.maps)}
        return files | {f"{_TOGETHER}.{form}": _npz(arrays) if form == "npz" else save(arrays)}
    for name, value in pair.maps.items():
        files[f"{name}.png"] = _map_png(name, value, pair.maps)
    return files


def decode_pair(files: Mapping[str, Callable[[], bytes]], names: tuple[str, ...] | None = None) -> PairArrays:
    """The pair whose files are called so, each read by a function; of maps as PNG those of some names alone.

    Raises:
        DamagedPairError: a file that is none of its kind.
    """
    maps: dict[str, np.ndarray] = {}
    for suffix, read in files.items():
        name, _, form = suffix.partition(".")
        if name == _TOGETHER:
            maps |= _decode(suffix, read(), _read_npz if form == "npz" else load)
        elif name not in PICTURES and (names is None or name in names):
            maps[name] = _decode(suffix, read(), _DECODERS[name])
    clean, corrupted = (_decode(f"{name}.png", files[f"{name}.png"](), decode_picture) for name in PICTURES)
    return PairArrays(clean, corrupted, maps)


def beyond(flow: np.ndarray, valid: np.ndarray) -> int:
    """How many valid pixels of a flow (2, H, W) a PNG cannot hold, of more than 512 px; it has them as not valid."""
    if _fits(np.array([[flow.min(), flow.max()]])).all():
        return 0
    return int((valid & ~_fits(flow)).sum())


def encode_flow(flow: np.ndarray, valid: np.ndarray) -> bytes:
    """A PNG of 16 bits and three channels: red and green round(64 u) + 2^15 and likewise v, blue 1 where valid.

    What is not valid keeps its flow, cut off at the ends of the range, -512 to 512 px less a step.

    Args:
        flow: (2, H, W), px.
        valid: (H, W), bool.

    Source: Menze and Geiger, "Object scene flow for autonomous vehicles", CVPR 2015, and the benchmark's kit.
    """
    steps = np.clip(np.rint(flow * _STEPS) + _ZERO, 0, _TOP).astype(np.uint16)
    return _png(np.dstack([(valid & _fits(flow)).astype(np.uint16), steps[1], steps[0]]), _OF_MAPS)


def decode_flow(data: bytes) -> tuple[np.ndarray, np.ndarray]:
    """The flow (2, H, W), px, float32, and where it is valid, (H, W), bool, of a PNG of `encode_flow`."""
    steps = _pixels(data, np.uint16, 3)
    flow = (steps[..., :0:-1].astype(np.float32) - _ZERO) / _STEPS
    return np.ascontiguousarray(flow.transpose(2, 0, 1)), steps[..., 0] > 0


def decode_picture(data: bytes) -> np.ndarray:
    """(H, W, 3), uint8, RGB, of a PNG."""
    return np.ascontiguousarray(_pixels(data, np.uint8, 3)[..., ::-1])


def _fits(flow: np.ndarray) -> np.ndarray:
    steps = np.rint(flow * _STEPS) + _ZERO
    return np.asarray(((steps >= 0) & (steps <= _TOP)).all(axis=0))


def _map_png(name: str, value: np.ndarray, maps: Mapping[str, np.ndarray]) -> bytes:
    if name in FLOWS:
        return encode_flow(value, maps[FLOWS[name]])
    if name in LIGHTS:
        return _png(_light_steps(name, value), _OF_MAPS)
    return _png(value.astype(np.uint8) * 255, _OF_MAPS)


def _light_steps(name: str, value: np.ndarray) -> np.ndarray:
    steps = np.rint(value * LIGHTS[name])
    if not ((steps >= 0) & (steps <= _TOP)).all():
        top = f"below {_TOP / LIGHTS[name]:.3g}"
        raise ValueError(f"maps must be npz or safetensors for {name} that is not {top}, got up to {value.max():.3g}")
    return steps.astype(np.uint16)


def _png(pixels: np.ndarray, options: list[int]) -> bytes:
    return cv2.imencode(".png", np.ascontiguousarray(pixels), options)[1].tobytes()


def _npz(arrays: dict[str, Any]) -> bytes:
    """Not compressed, which flows of full precision hardly are; the archive has no time of its own."""
    stream = io.BytesIO()
    np.savez(stream, **arrays)
    return stream.getvalue()


def _read_npz(data: bytes) -> dict[str, np.ndarray]:
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        if sum(member.file_size for member in archive.infolist()) > len(data):
            raise ValueError("it claims more bytes than it has, and is not compressed")
    with np.load(io.BytesIO(data), allow_pickle=False) as archive:
        return {name: archive[name] for name in archive.files}


def _decode(suffix: str, data: bytes, read: Callable[[bytes], _T]) -> _T:
    try:
        return read(data)
    except _DAMAGE as error:
        # What a file says of itself, as long as it likes, may be part of the message.
        raise DamagedPairError(f"{suffix} is damaged ({str(error)[:_MOST_SAID]})") from error


def _pixels(data: bytes, kind: type, channels: int) -> np.ndarray:
    height, width = (int.from_bytes(data[i : i + 4], "big") for i in (20, 16))
    if not png_fits(data) or height * width > _PACKED * len(data):
        raise DamagedPairError("it is no PNG, or claims more than its bytes can hold")
    pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if pixels is None or pixels.dtype != kind or pixels.ndim != (3 if channels == 3 else 2):
        raise DamagedPairError(f"it is no PNG of {channels} channels of {np.dtype(kind).itemsize * 8} bits")
    return pixels


def _light_of(name: str) -> Callable[[bytes], np.ndarray]:
    return lambda data: _pixels(data, np.uint16, 1).astype(np.float32) / LIGHTS[name]


_DECODERS: dict[str, Callable[[bytes], np.ndarray]] = {
    **{name: lambda data: decode_flow(data)[0] for name in FLOWS},
    **{name: _light_of(name) for name in LIGHTS},
    **{name: lambda data: _pixels(data, np.uint8, 1) > 0 for name in MASKS},
}
