"""Encoding and decoding of the files of a pair.

PNG files open in every program: images of 8 bits, flows of 16 bits in the form of the KITTI benchmark, transmission and
intensity of 16 bits. npz and safetensors files hold the maps in float32, as they were computed.
"""

import io
import zipfile
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, NamedTuple, TypeVar

import cv2
import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load, save

from torchrefract.data.depth_maps import depth_of_levels, map_levels
from torchrefract.data.images import has_complete_png_chunks

_T = TypeVar("_T")

FORMATS = ("png", "npz", "safetensors")
FLOWS = {"flow": "valid", "restore_flow": "restore_valid"}  # each with its validity mask
LIGHTS = {"transmission": 65535, "intensity": 32768}  # each with its number of PNG levels for a value of 1
DEPTH = "depth"  # of the clean frame, if a map was given; a level of its PNG is 1/256 m, the last one is infinite
MASKS = tuple(FLOWS.values())
IMAGES = ("clean", "corrupted")

_LEVELS_PER_PX, _ZERO_LEVEL, _LAST_LEVEL = 64, 1 << 15, (1 << 16) - 1  # of a flow in a PNG
_ZLIB_RATIO = 1032  # the largest ratio of compression that zlib reaches
_MAX_PIXELS = 2 * 89_478_485  # as of Pillow; a small file of zeros could fill the memory
_MAPS_STEM = "maps"  # name of the file that holds all maps of an npz or safetensors pair

# Level 1 of zlib is the fastest. The row above predicts photographs best, the left neighbor predicts maps best.
_FAST = [cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_DEFAULT]
_IMAGE_OPTIONS = [*_FAST, cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_UP]
_MAP_OPTIONS = [*_FAST, cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_SUB]

# The error that a reader raises for a damaged file depends on the place of the damage.
_DECODING_ERRORS = (ValueError, OSError, EOFError, LookupError, ArithmeticError, RuntimeError, MemoryError, SyntaxError)
_DECODING_ERRORS += (TypeError, zipfile.BadZipFile, SafetensorError, cv2.error)
_LONGEST_MESSAGE = 500  # characters


class DamagedPairError(ValueError):
    """Raised for a file of a pair that is missing, truncated or invalid."""


class PairArrays(NamedTuple):
    """A pair in memory. Maps that the scene does not have are missing.

    Args:
        clean, corrupted: (H, W, 3), uint8, RGB.
        maps: by name: flow and restore_flow (2, H, W), float32, px; transmission and intensity (H, W), float32; valid
            and restore_valid (H, W), bool; depth (H, W), float32, m, may be inf.
    """

    clean: np.ndarray
    corrupted: np.ndarray
    maps: Mapping[str, np.ndarray]


def encode_pair(pair: PairArrays, file_format: str) -> dict[str, bytes]:
    """Encode a pair with its maps in one of `FORMATS`.

    Returns:
        the content of each file by the suffix of its name, as "clean.png" and "flow.png".

    Raises:
        ValueError: an intensity is 2 or more and the format is "png".
    """
    files = {f"{name}.png": _encode_png(getattr(pair, name)[..., ::-1], _IMAGE_OPTIONS) for name in IMAGES}
    return files | encode_maps(pair.maps, file_format)


def encode_maps(maps: Mapping[str, np.ndarray], file_format: str) -> dict[str, bytes]:
    """Encode the maps of `PairArrays` as `encode_pair` does."""
    if file_format == "png":
        return {f"{name}.png": _encode_map(name, value, maps) for name, value in maps.items()}
    # safetensors writes memory in its order, so arrays must be contiguous.
    arrays: dict[str, Any] = {name: np.ascontiguousarray(maps[name]) for name in sorted(maps)}
    stream = io.BytesIO()
    if file_format == "npz":
        np.savez(stream, **arrays)  # compression gains little on flows in float32
    else:
        stream.write(save(arrays))
    return {f"{_MAPS_STEM}.{file_format}": stream.getvalue()}


def decode_pair(
    files: Mapping[str, Callable[[], bytes]],
    names: tuple[str, ...] | None = None,
    *,
    size: tuple[int, int] | None = None,
) -> PairArrays:
    """Decode a pair.

    Args:
        files: a function that reads the content of each file, by the suffix of its name.
        names: maps to decode; None for all. A mask excludes what the PNG of its flow clips.
        size: (height, width) of all images and maps, px; None for that of the clean image.

    Raises:
        DamagedPairError: a file is invalid or of another size, or a map has NaN or another type.
    """
    size = size or _png_size(files["clean.png"]())
    maps: dict[str, np.ndarray] = {}
    in_range: dict[str, np.ndarray] = {}
    for suffix, read in files.items():
        name, _, file_format = suffix.partition(".")
        if name == _MAPS_STEM:
            maps |= _decode(suffix, read(), partial(_decode_maps, size, file_format, names))
        elif name in FLOWS and (names is None or name in names):
            maps[name], in_range[FLOWS[name]] = _decode(suffix, read(), partial(decode_flow, size=size))
        elif name not in IMAGES and (names is None or name in names):
            maps[name] = _decode(suffix, read(), partial(_decode_map, name, size))
    # The PNG of a flow clips what exceeds its range, and marks it alone: the PNG of the mask does not know.
    maps |= {name: maps[name] & in_range[name] for name in in_range.keys() & maps.keys()}
    clean, corrupted = (_decode(f"{name}.png", files[f"{name}.png"](), partial(_decode_image, size)) for name in IMAGES)
    return PairArrays(clean, corrupted, maps)


def count_out_of_range(maps: Mapping[str, np.ndarray]) -> dict[str, int]:
    """Count the valid pixels that a PNG cannot hold, by flow; `encode_flow` marks them as not valid."""
    counts = {name: int((maps[mask] & ~_in_range(maps[name])).sum()) for name, mask in FLOWS.items() if name in maps}
    return {name: count for name, count in counts.items() if count}


def encode_flow(flow: np.ndarray, valid: np.ndarray) -> bytes:
    """Encode a flow as a PNG of 16 bits.

    Red is round(64 u) + 2^15, green is round(64 v) + 2^15, blue is 1 where valid and 0 elsewhere. Flows are clipped to
    [-512, 512 - 1/64] px; clipped pixels are not valid.

    Args:
        flow: (2, H, W), px.
        valid: (H, W), bool.

    Source: Menze and Geiger, "Object scene flow for autonomous vehicles", CVPR 2015, and the benchmark's development
    kit.
    """
    levels = np.clip(np.rint(flow * _LEVELS_PER_PX) + _ZERO_LEVEL, 0, _LAST_LEVEL).astype(np.uint16)
    return _encode_png(np.dstack([(valid & _in_range(flow)).astype(np.uint16), levels[1], levels[0]]), _MAP_OPTIONS)


def decode_flow(data: bytes, size: tuple[int, int] | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Decode a PNG of `encode_flow` into a flow (2, H, W), float32, px, and a validity mask (H, W), bool."""
    levels = _decode_png(data, np.uint16, 3, size)
    flow = (levels[..., :0:-1].astype(np.float32) - _ZERO_LEVEL) / _LEVELS_PER_PX
    return np.ascontiguousarray(flow.transpose(2, 0, 1)), levels[..., 0] > 0


def _decode_image(size: tuple[int, int], data: bytes) -> np.ndarray:
    return np.ascontiguousarray(_decode_png(data, np.uint8, 3, size)[..., ::-1])


def _in_range(flow: np.ndarray) -> np.ndarray:
    levels = np.rint(flow * _LEVELS_PER_PX) + _ZERO_LEVEL
    return np.asarray(((levels >= 0) & (levels <= _LAST_LEVEL)).all(axis=0))


def _encode_map(name: str, value: np.ndarray, maps: Mapping[str, np.ndarray]) -> bytes:
    if name in FLOWS:
        return encode_flow(value, maps[FLOWS[name]])
    if name in MASKS:
        return _encode_png(value.astype(np.uint8) * 255, _MAP_OPTIONS)
    if name == DEPTH:
        return _encode_png(map_levels(value, lowest=1), _MAP_OPTIONS)
    levels = np.rint(value * LIGHTS[name])
    if not ((levels >= 0) & (levels <= _LAST_LEVEL)).all():
        limit = f"{_LAST_LEVEL / LIGHTS[name]:.3g}"
        raise ValueError(f"maps must be npz or safetensors for {name} above {limit}, got up to {value.max():.3g}")
    return _encode_png(levels.astype(np.uint16), _MAP_OPTIONS)


def _decode_map(name: str, size: tuple[int, int], data: bytes) -> np.ndarray:
    if name in MASKS:
        return _decode_png(data, np.uint8, 1, size) > 0
    if name == DEPTH:
        return depth_of_levels(_decode_png(data, np.uint16, 1, size))
    return _decode_png(data, np.uint16, 1, size).astype(np.float32) / LIGHTS[name]


def _encode_png(pixels: np.ndarray, options: list[int]) -> bytes:
    return cv2.imencode(".png", np.ascontiguousarray(pixels), options)[1].tobytes()


def _decode_maps(
    size: tuple[int, int], file_format: str, names: tuple[str, ...] | None, data: bytes
) -> dict[str, np.ndarray]:
    maps = _decode_npz(data, names) if file_format == "npz" else load(data)
    maps = {name: value for name, value in maps.items() if names is None or name in names}
    for name in maps.keys() & {*FLOWS, *MASKS, *LIGHTS}:
        shape, kind = ((2, *size) if name in FLOWS else size), (np.bool_ if name in MASKS else np.float32)
        if maps[name].shape != shape or maps[name].dtype != kind:
            kinds = f"got {maps[name].dtype} of shape {maps[name].shape}"
            raise ValueError(f"{name} must be {kind.__name__} of shape {shape}, {kinds}")
        if not np.isfinite(maps[name]).all():
            raise ValueError(f"{name} must be finite, got NaN or infinity")
    return maps


def _decode_npz(data: bytes, names: tuple[str, ...] | None) -> dict[str, np.ndarray]:
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        if sum(member.file_size for member in archive.infolist()) > len(data):
            raise ValueError("it claims more bytes than it has, and is not compressed")
    with np.load(io.BytesIO(data), allow_pickle=False) as archive:
        return {name: archive[name] for name in archive.files if names is None or name in names}


def _decode(suffix: str, data: bytes, decoder: Callable[[bytes], _T]) -> _T:
    try:
        return decoder(data)
    except _DECODING_ERRORS as error:
        # The message may quote the file, which may be of any length.
        raise DamagedPairError(f"{suffix} is damaged ({str(error)[:_LONGEST_MESSAGE]})") from error


def _png_size(data: bytes) -> tuple[int, int]:
    """Return (height, width) from the header of a PNG."""
    return int.from_bytes(data[20:24], "big"), int.from_bytes(data[16:20], "big")


def _decode_png(data: bytes, dtype: type, channels: int, size: tuple[int, int] | None) -> np.ndarray:
    height, width = _png_size(data)
    if size not in (None, (height, width)):
        raise DamagedPairError(f"it must be of {size} px (height, width), got {(height, width)}")
    # OpenCV allocates the size that the header states before it reads a pixel.
    num_bytes = height * width * channels * np.dtype(dtype).itemsize
    if not has_complete_png_chunks(data) or num_bytes > _ZLIB_RATIO * len(data) or height * width > _MAX_PIXELS:
        raise DamagedPairError(
            f"it is not a complete PNG, states a larger size than its bytes can hold, or has over {_MAX_PIXELS} px"
        )
    pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if pixels is None or pixels.dtype != dtype or pixels.ndim != (3 if channels == 3 else 2):
        raise DamagedPairError(f"it is not a PNG of {channels} channels of {np.dtype(dtype).itemsize * 8} bits")
    return pixels
