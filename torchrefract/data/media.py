"""Picture and video files: find those of a folder, read videos frame by frame, write pictures and videos.

Stored pixels lie in the frame of the sensor, where the geometry of a camera holds. A tag of the file (EXIF orientation,
display matrix) turns them for display. Readers take `upright`: True for the displayed frame, False for that of the
sensor. Writers keep the tag of a frame of the sensor, so that viewers show every output upright.
"""

import contextlib
import io
import math
import warnings
from collections import defaultdict, deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from fractions import Fraction
from functools import lru_cache
from heapq import merge
from itertools import chain, count, repeat
from pathlib import Path
from typing import Any, cast

import av
import cv2
import numpy as np
import torch
from av.codec.context import Flags
from av.container import InputContainer, OutputContainer
from av.packet import Packet
from av.stream import Stream
from av.video.reformatter import ColorRange, Colorspace, Interpolation
from torch import Tensor

from torchrefract._tensor import to_float
from torchrefract._validation import UsageError
from torchrefract.data.frames import list_files
from torchrefract.data.images import (
    EXTENSIONS,
    UnreadableImageError,
    files_in,
    image_header,
    image_size,
    opened,
    pixels_of,
    upright_exif,
)

# OpenCV prints to the terminal; problems are raised as errors instead.
cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)

VIDEOS = (".mp4", ".avi", ".mov", ".mkv", ".gif")

_DEFAULT_RATE = Fraction(25)  # of a video whose header has no rate
_ENCODING = {".jpg": [cv2.IMWRITE_JPEG_QUALITY, 95], ".jpeg": [cv2.IMWRITE_JPEG_QUALITY, 95]}
_TAGGED = (".jpg", ".jpeg", ".png", ".webp")  # formats that hold EXIF data and color profiles
# Without frames that refer to later ones, the packets of a video are in the order of their times.
_VIDEO_OPTIONS = {"crf": "17", "preset": "veryfast", "bf": "0"}
# Without these options swscale darkens colors by more than one level.
_CONVERSION = Interpolation.BILINEAR | Interpolation.ACCURATE_RND | Interpolation.FULL_CHR_H_INT
_COLOR_MATRICES = {int(space) for space in Colorspace}  # those that can be converted
_UPRIGHT = np.eye(3, dtype=np.int32)
_MAX_NAMES = 3  # of files in a message


def find_media(source: Path, *, deep: bool = False, name: str = "input") -> Sequence[Path]:
    """Find the pictures and videos of a folder, or return the one file that `source` names.

    With `deep`, the folders below it are searched too. `name` is the option to blame.

    Raises:
        UsageError: if `source` does not exist or holds no picture or video, or if two videos would be written under one
            name.
    """
    if not source.exists():
        raise UsageError(f"{name} must be a folder, a picture or a video, got {source}, which does not exist")
    suffixes = (*EXTENSIONS, *VIDEOS)
    candidates = [source] if not source.is_dir() else sorted(list_files(source)) if deep else files_in(source, suffixes)
    files = [file for file in candidates if file.suffix.lower() in suffixes]
    if not files:
        raise UsageError(f"{name} must be, or hold, {', '.join(suffixes)}, got {source}")
    names = [output_name(file) for file in files]
    if repeated := {str(name) for name in names if names.count(name) > 1}:
        raise UsageError(f"{name} must not hold two videos of one name, got {', '.join(sorted(repeated))}")
    return files


def check_output_folder(out: Path, source: Path, *, deep: bool = False) -> None:
    """Raise UsageError if files in `out` would replace those of `source` or, if `deep`, be among them."""
    folder = (source if source.is_dir() else source.parent).resolve()
    if out.resolve() == folder:
        raise UsageError(f"out must be another folder than that of input, got {out}")
    if deep and source.is_dir() and out.resolve().is_relative_to(folder):
        raise UsageError(f"out must be a folder that does not lie in that of input, got {out}")


def is_video(file: Path) -> bool:
    """Return True if the suffix of a file is that of a video."""
    return file.suffix.lower() in VIDEOS


def output_name(file: Path) -> Path:
    """Return the name of the output for an input file: videos become .mp4."""
    return file.with_suffix(".mp4") if is_video(file) else file


def is_complete(file: Path, target: Path, *, num_columns: int = 1) -> bool:
    """Return True if the output of a file exists and has its number of frames (video) or its sides (picture).

    The output of a picture may hold several, side by side.
    """
    if not target.is_file():
        return False
    if is_video(file):
        # The header of a trimmed video counts frames that are not shown.
        return (num := video_info(target)[0]) > 0 and num in (video_info(file)[0], _count_packets(file))
    try:
        height, width = image_size(file)
        return image_size(target) == (height, num_columns * width)
    except UnreadableImageError:
        return False


def describe_losses(files: Sequence[Path], *, upright: bool) -> list[str]:
    """Describe what outputs of files will lack, one line for each kind of loss; unreadable files are ignored."""
    lossy = defaultdict[str, list[Path]](list)
    for file in files:
        try:
            losses = list(_video_losses(file) if is_video(file) else _picture_losses(file, upright=upright))
        except UnreadableImageError:
            continue
        for loss in dict.fromkeys(losses):
            lossy[loss].append(file)
    return [f"{loss}: {_names(affected)}" for loss, affected in lossy.items()]


def describe_turned(files: Sequence[Path]) -> str:
    """Describe the files whose tags turn the stored pixels for display; empty without such files."""
    turned = [file for file in files if _is_turned(file)]
    if not turned:
        return ""
    return (
        f"{len(turned)} of {len(files)} files have a tag that turns them for display (EXIF orientation, or rotation of "
        f"a video): {_names(turned)}. Their pixels are used as stored, since a camera's geometry holds in that frame"
    )


def write_picture(image: Tensor, path: Path, *, source: Path, upright: bool = True) -> None:
    """Write an image (3, H, W) in [0, 1], made from the picture `source`, in the format of the suffix.

    EXIF data and a color profile of `source` are kept, and 16 bits in PNG. Image and orientation are those of
    `read_image(source, upright=upright)`. Raises UsageError if the format cannot hold the picture.
    """
    header, suffix = image_header(source), path.suffix.lower()
    pixels = pixels_of(image, bits=header.bits if suffix == ".png" else 8)[..., ::-1]
    data = {cv2.IMAGE_METADATA_EXIF: upright_exif(header) if upright else header.exif}
    if header.profile[16:20] == b"RGB ":  # profiles of gray or CMYK do not hold for RGB
        data[cv2.IMAGE_METADATA_ICCP] = header.profile
    kept = {kind: np.frombuffer(value, np.uint8) for kind, value in data.items() if value and suffix in _TAGGED}
    options = _ENCODING.get(suffix, [])
    is_encoded, encoded = cv2.imencodeWithMetadata(path.suffix, pixels, [*kept], [*kept.values()], options)
    if not is_encoded and kept.pop(cv2.IMAGE_METADATA_ICCP, None) is not None:
        warnings.warn(f"{source} has an invalid color profile, which is not kept", stacklevel=2)
        is_encoded, encoded = cv2.imencodeWithMetadata(path.suffix, pixels, [*kept], [*kept.values()], options)
    if not is_encoded:
        raise UsageError(f"{path} could not be written as {path.suffix}")
    path.write_bytes(encoded.tobytes())


def read_video(path: Path, times: Iterable[int], *, upright: bool = True) -> Iterator[tuple[int, Tensor]]:
    """Read the frames of a video with rising numbers, until it ends.

    Args:
        path: of the video.
        times: frame numbers.
        upright: True turns frames as a player does; False keeps the frames of the sensor.

    Yields:
        the frame number, and the frame (1, 3, H, W), float32 in [0, 1], RGB.
    """
    frames, position = _decode(path), 0
    for t in times:
        for frame in frames:
            position += 1
            if position == t + 1:
                yield t, _tensor_of(frame, upright=upright)
                break
        else:
            return


def video_info(path: Path) -> tuple[int, float]:
    """Return the number of frames and the mean frames per second of a video; zeros if the file is not a video."""
    if (video := _open(path)) is None:
        return 0, 0.0
    with video.container:
        return video.frames or _count_packets(path), float(video.average_rate or 0)


def can_write_videos() -> bool:
    """Return True if the installed FFmpeg has the encoder of `write_video`."""
    return "libx264" in av.codecs_available


def write_video(pictures: Iterable[np.ndarray], path: Path, *, fps: float, size: tuple[int, int]) -> int:
    """Write pictures as an H.264 video, one by one; return their number.

    Args:
        pictures: (H, W, 3), uint8, RGB, all of one size.
        path: ending in .mp4.
        fps: frames per second.
        size: (width, height), px, both even.

    Raises:
        OSError: if the file cannot be written, as on a full disk.
    """
    rate = Fraction(fps).limit_denominator(10_000)
    with _create(path) as container:
        stream = _add_video(container, rate=rate, time_base=1 / rate, size=size)
        return _mux(container, stream, _encode(stream, pictures, zip(count(), repeat(1))))


def convert_video(
    source: Path, path: Path, *, change: Callable[[Iterator[Tensor]], Iterable[np.ndarray]], upright: bool = True
) -> int:
    """Write the changed frames of a video with their times and its sound; return their number.

    Args:
        source: the video.
        path: of the new video, ending in .mp4.
        change: takes frames (1, 3, H, W) in [0, 1], gives as many pictures (H, W, 3), uint8, RGB, all of one size.
        upright: as of `read_video`; a player shows the new video upright in both cases.

    Raises:
        UnreadableImageError: if no frame can be decoded, the frames change their size, or a side is odd.
        OSError: if the file cannot be written, as on a full disk.
    """
    frames = _decode(source)
    if (first := next(frames, None)) is None:
        raise UnreadableImageError(f"{source} is not a video with a frame that can be decoded")
    times = deque[tuple[int, int]]()  # of frames that are read and not written yet

    def read() -> Iterator[Tensor]:
        end = -math.inf
        for frame in chain([first], frames):
            if (frame.width, frame.height) != (first.width, first.height):
                raise UnreadableImageError(f"{source} changes the size of its frames")
            # Encoders need rising times, which damaged videos lack.
            pts = frame.pts if frame.pts is not None and frame.pts > end else max(0, end + 1)
            times.append((int(pts), frame.duration))
            end = pts
            yield _tensor_of(frame, upright=upright)

    pictures = iter(change(read()))
    picture = next(pictures)
    height, width = picture.shape[:2]
    if height % 2 or width % 2:
        raise UnreadableImageError(f"{source} would give frames of {width} x {height}, and videos take even sides only")
    with contextlib.ExitStack() as stack:
        video = cast(av.VideoStream, _open(source))
        original = stack.enter_context(cast(InputContainer, video.container))
        container = stack.enter_context(_create(path))
        rate, time_base = video.average_rate or _DEFAULT_RATE, cast(Fraction, first.time_base)
        stream = _add_video(container, rate=rate, time_base=time_base, size=(width, height))
        _copy_display(first, video, stream, upright=upright)
        container.metadata.update(original.metadata)
        copies: dict[Stream, Stream] = {
            sound: container.add_stream_from_template(sound)
            for sound in original.streams.audio
            if sound.codec_context.name in _sound_codecs()
        }
        encoded = _encode(stream, chain([picture], pictures), (times.popleft() for _ in count()))
        sounds = _copy_packets(copies)
        return _mux(container, stream, merge(encoded, sounds, key=lambda packet: (packet.dts or 0) * packet.time_base))


def _open(path: Path) -> av.VideoStream | None:
    """Open a file and return its video stream, whose container must be closed; None if the file is not a video."""
    with opened(path):
        pass
    try:
        # FFmpeg takes the part of a relative path before a colon for a protocol.
        container = av.open(str(path.resolve()), metadata_errors="replace")
    except av.FFmpegError:
        return None
    if isinstance(video := container.streams.best("video"), av.VideoStream):
        return video
    container.close()
    return None


def _decode(path: Path) -> Iterator[av.VideoFrame]:
    """Decode the frames of a video, in the order of their times; warn of damaged packets, which it leaves out."""
    if (video := _open(path)) is None:
        return
    num_damaged = 0
    with video.container:
        # With threads that decode several frames at once, damage would also lose the frame before.
        video.thread_type = "SLICE"
        for packet in _packets(video):
            try:
                yield from packet.decode()
            except av.FFmpegError:
                num_damaged += 1
    if num_damaged:
        warnings.warn(f"{path} has {num_damaged} damaged frames, which are left out", stacklevel=2)


def _packets(*streams: Stream) -> Iterator[Packet]:
    """Yield the packets of streams of a container up to the end, or up to damage, of which it warns."""
    container = cast(InputContainer, streams[0].container)
    try:
        yield from container.demux(*streams)
    except av.FFmpegError as error:
        warnings.warn(f"{container.name} is damaged and ends early ({error.strerror})", stacklevel=2)


def _count_packets(path: Path) -> int:
    """Count the frames that a video shows, without decoding them."""
    if (video := _open(path)) is None:
        return 0
    with video.container:
        return sum(packet.size > 0 and not packet.is_discard for packet in _packets(video))


def _copy_packets(copies: dict[Stream, Stream]) -> Iterator[Packet]:
    """Yield the packets of streams, each assigned to the copy of its stream."""
    for packet in _packets(*copies) if copies else ():
        if packet.dts is not None:  # the last, empty packet of each stream has no time
            packet.stream = copies[packet.stream]
            yield packet


@contextlib.contextmanager
def _create(path: Path) -> Iterator[OutputContainer]:
    """Open a new MP4 file; turn errors of FFmpeg into OSError."""
    try:
        with av.open(str(path.resolve()), "w", format="mp4") as container:
            yield container
    except av.FFmpegError as error:
        raise OSError(error.errno, error.strerror, str(path)) from error


def _add_video(
    container: OutputContainer, *, rate: Fraction, time_base: Fraction, size: tuple[int, int]
) -> av.VideoStream:
    stream = container.add_stream("libx264", rate=rate, options=_VIDEO_OPTIONS)
    stream.width, stream.height = size
    stream.pix_fmt = "yuv420p"
    stream.color_range = ColorRange.MPEG
    stream.codec_context.time_base = stream.time_base = time_base
    stream.codec_context.flags |= Flags.frame_duration  # otherwise the last frame lasts as long as the mean one
    return stream


def _copy_display(first: av.VideoFrame, video: av.VideoStream, stream: av.VideoStream, *, upright: bool) -> None:
    """Copy the tags that decide how a player shows the pixels: color, shape of a pixel, orientation."""
    if first.colorspace in _COLOR_MATRICES:
        stream.colorspace = first.colorspace
    stream.color_primaries, stream.color_trc = first.color_primaries, first.color_trc
    matrix = _display_matrix(first)
    if ratio := video.sample_aspect_ratio:
        stream.codec_context.sample_aspect_ratio = 1 / ratio if upright and _is_transposed(matrix) else ratio
    if not upright:
        stream.set_display_matrix(matrix.ravel().tolist())


def _encode(
    stream: av.VideoStream, pictures: Iterable[np.ndarray], times: Iterable[tuple[int, int]]
) -> Iterator[Packet]:
    """Encode pictures at their times: the time and the duration of each in units of the stream."""
    options = {"dst_colorspace": _matrix_of(stream.colorspace), "dst_color_range": ColorRange.MPEG}
    for picture, (pts, duration) in zip(pictures, times, strict=False):
        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format="rgb24")
        frame = frame.reformat(format=stream.pix_fmt, interpolation=_CONVERSION, **options)
        frame.pts, frame.duration, frame.time_base = pts, duration, stream.codec_context.time_base
        yield from stream.encode(frame)
    yield from stream.encode(None)


def _mux(container: OutputContainer, stream: av.VideoStream, packets: Iterable[Packet]) -> int:
    """Write packets and return the number of those of a stream."""
    num_frames = 0
    for packet in packets:
        num_frames += packet.stream is stream
        container.mux(packet)
    return num_frames


def _tensor_of(frame: av.VideoFrame, *, upright: bool) -> Tensor:
    """Convert a frame into (1, 3, H, W), float32 in [0, 1], RGB."""
    options: Any = {"src_colorspace": _matrix_of(frame.colorspace), "src_color_range": frame.color_range}
    pixels = frame.to_ndarray(format="rgb24", interpolation=_CONVERSION, **options)
    if upright:
        pixels = _turn(pixels, _display_matrix(frame))
    return to_float(torch.from_numpy(pixels.copy()).permute(2, 0, 1)[None].contiguous())


def _matrix_of(colorspace: int) -> int:
    return colorspace if colorspace in _COLOR_MATRICES else Colorspace.ITU601


def _display_matrix(frame: av.VideoFrame) -> np.ndarray:
    """Return the matrix (3, 3) that leads from stored (x, y, 1), as a row, to displayed positions; integers."""
    data = frame.side_data.get("DISPLAYMATRIX")
    return _UPRIGHT if data is None else np.frombuffer(bytes(data), np.int32).reshape(3, 3)


def _is_transposed(matrix: np.ndarray) -> bool:
    return abs(matrix[0, 1]) > abs(matrix[0, 0])


def _turn(pixels: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """Turn pixels (H, W, 3) by a display matrix, to the nearest quarter turn."""
    x, y = (matrix[1, 0], matrix[0, 1]) if _is_transposed(matrix) else (matrix[0, 0], matrix[1, 1])
    pixels = pixels.swapaxes(0, 1) if _is_transposed(matrix) else pixels
    return pixels[:: -1 if y < 0 else 1, :: -1 if x < 0 else 1]


def _is_turned(file: Path) -> bool:
    """Return True if a tag turns a file for display; False if it is unreadable."""
    try:
        if not is_video(file):
            return image_header(file).orientation != 1
        first = next(_decode(file), None)
    except UnreadableImageError:
        return False
    return first is not None and bool((np.sign(_display_matrix(first))[:2, :2] != np.eye(2)).any())


@lru_cache(maxsize=1)
def _sound_codecs() -> frozenset[str]:
    """Return the codecs that MP4 can hold."""
    with av.open(io.BytesIO(), "w", format="mp4") as container:
        return frozenset(container.supported_codecs)


def _video_losses(file: Path) -> Iterator[str]:
    if (video := _open(file)) is None:
        return
    with video.container:
        for stream in video.container.streams:
            if stream.type != "audio" and stream is not video:
                yield f"a stream of type {stream.type} is not kept"
            elif stream.type == "audio" and stream.codec_context.name not in _sound_codecs():
                yield f"the sound is not kept, since MP4 cannot hold {stream.codec_context.name}"
        components = video.format.components if video.format else ()
        if (bits := max((component.bits for component in components), default=0)) > 8:
            yield f"{bits} bits a channel are written as 8"
        if any(component.is_alpha for component in components) and video.codec_context.name != "gif":
            yield "transparency is not kept"


def _picture_losses(file: Path, *, upright: bool) -> Iterator[str]:
    header, suffix = image_header(file), file.suffix.lower()
    if header.num_frames > 1:
        yield "the first of several frames is kept"
    if header.has_alpha:
        yield "transparency is not kept"
    if header.bits > 8 and suffix != ".png":
        yield f"{header.bits} bits a channel are written as 8, since {suffix} holds no more"
    if header.orientation != 1 and not upright and suffix not in _TAGGED:
        yield f"the orientation is not kept, since {suffix} cannot hold it"


def _names(files: Sequence[Path]) -> str:
    return ", ".join(file.name for file in files[:_MAX_NAMES]) + (" …" if len(files) > _MAX_NAMES else "")
