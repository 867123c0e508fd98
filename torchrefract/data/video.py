"""Video files: read frame by frame, write from pictures, and convert with their times, sound and orientation."""

import contextlib
import io
import math
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from fractions import Fraction
from functools import lru_cache
from heapq import merge
from itertools import chain, count, repeat
from pathlib import Path
from typing import Any, cast

import av
import numpy as np
import torch
from av.codec.context import Flags
from av.container import InputContainer, OutputContainer
from av.packet import Packet
from av.stream import Stream
from av.video.reformatter import ColorRange, Colorspace, Interpolation
from torch import Tensor

from torchrefract._io import is_remote
from torchrefract._tensor import to_float
from torchrefract._validation import warn
from torchrefract.data.images import UnreadableImageError, opened

_DEFAULT_RATE = Fraction(25)  # of a video whose header has no rate
# Without frames that refer to later ones, the packets of a video are in the order of their times.
_VIDEO_OPTIONS = {"crf": "17", "preset": "veryfast", "bf": "0"}
# A process that is forked later, as a worker of a DataLoader, would wait forever for threads that it does not have.
_THREADS = 1  # of a conversion
# Without these options swscale darkens colors by more than one level.
_CONVERSION = Interpolation.BILINEAR | Interpolation.ACCURATE_RND | Interpolation.FULL_CHR_H_INT
_COLOR_MATRICES = {int(space) for space in Colorspace}  # those that can be converted
_HDR = {16: "PQ", 18: "HLG"}  # transfer characteristics of ITU-T H.273
_UPRIGHT = np.eye(3, dtype=np.int32)
_MAX_SKEW = 0.01  # of a display matrix, which is rounded
# Before version 19, PyAV raises for a title that is not UTF-8.
_ANY_METADATA: dict[str, Any] = {"metadata_errors": "replace"} if int(av.__version__.split(".")[0]) < 19 else {}


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
        return video.frames or count_frames(path), float(video.average_rate or 0)


def count_frames(path: Path) -> int:
    """Count the frames that a video shows, without decoding them."""
    if (video := _open(path)) is None:
        return 0
    with video.container:
        return sum(packet.size > 0 and not packet.is_discard for packet in _packets(video))


def decodable_frames(path: Path) -> int:
    """Decode a video and count its frames; warns of damaged ones, which are left out."""
    return sum(1 for _ in _decode(path))


def is_turned_video(path: Path) -> bool:
    """Return True if the display matrix of a video turns its frames; False if the file is not a video."""
    first = next(_decode(path), None)
    return first is not None and bool((np.sign(_display_matrix(first))[:2, :2] != np.eye(2)).any())


def video_losses(path: Path) -> Iterator[str]:
    """Describe what the output of `convert_video` will lack."""
    if (video := _open(path)) is None:
        return
    with video.container:
        for stream in video.container.streams:
            if stream.type != "audio" and stream is not video:
                yield f"a stream of type {stream.type} is not kept"
            elif not _has_codec(stream):
                yield "a sound of a codec that FFmpeg does not know is not kept"
            elif stream.type == "audio" and stream.codec_context.name not in _sound_codecs():
                yield f"the sound is not kept, since MP4 cannot hold {stream.codec_context.name}"
        components = video.format.components if video.format else ()
        if (bits := max((component.bits for component in components), default=0)) > 8:
            yield f"{bits} bits a channel are written as 8"
        if any(component.is_alpha for component in components) and video.codec_context.name != "gif":
            yield "transparency is not kept"


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

    Whole seconds before the first frame and sound are left out: recordings such as MPEG-TS may count from when the
    camera was switched on, and a player of MP4 would wait for so long.

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
        raise UnreadableImageError(
            f"{source} would give frames of {width} x {height}, and videos take even sides only; crop it first: ffmpeg "
            '-i INPUT -vf "crop=trunc(iw/2)*2:trunc(ih/2)*2" OUTPUT'
        )
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
            if _has_codec(sound) and sound.codec_context.name in _sound_codecs()
        }
        start = max(0, original.start_time or 0) // av.time_base  # s
        shift = round(start / time_base)
        shifted = ((pts - shift, duration) for pts, duration in (times.popleft() for _ in count()))
        encoded = _encode(stream, chain([picture], pictures), shifted)
        sounds = _copy_packets(copies, start)
        return _mux(container, stream, merge(encoded, sounds, key=lambda packet: (packet.dts or 0) * packet.time_base))


def _open(path: Path) -> av.VideoStream | None:
    """Open a file and return its video stream, whose container must be closed; None if the file is not a video."""
    with opened(path) as stream:
        stream.read(1)  # FFmpeg's error would not say why a file cannot be read
    try:
        # FFmpeg takes the part of a relative path before a colon for a protocol.
        source = path.open("rb") if is_remote(path) else str(path.resolve())
        container = av.open(cast(Any, source), **_ANY_METADATA)
    except av.FFmpegError:
        return None
    if isinstance(video := container.streams.best("video"), av.VideoStream) and _has_codec(video):
        return video
    container.close()
    return None


def _has_codec(stream: Stream) -> bool:
    """Return True if FFmpeg knows the codec of a stream: not that of the spatial sound of phones, for example."""
    return stream.codec_context is not None


def _decode(path: Path) -> Iterator[av.VideoFrame]:
    """Decode the frames of a video, in the order of their times.

    Warns of damaged packets, which it leaves out, of interlaced frames and of a high dynamic range. Raises
    UnreadableImageError for frames that are turned by another angle than a multiple of 90 degrees.
    """
    if (video := _open(path)) is None:
        return
    num_damaged, is_interlaced, is_hdr = 0, False, False
    with video.container:
        # With threads that decode several frames at once, damage would also lose the frame before.
        video.thread_type = "SLICE"
        for packet in _packets(video):
            try:
                for frame in packet.decode():
                    _check_turn(frame, path)
                    if not is_hdr and (is_hdr := frame.color_trc in _HDR):
                        warn(
                            f"{path} has a high dynamic range ({_HDR[frame.color_trc]}), whose values are used like "
                            "those of an ordinary video: colors are pale, and light in fog and glare does not add up. "
                            "Convert it to BT.709 first, such as by the filters zscale and tonemap of ffmpeg"
                        )
                    if not is_interlaced and (is_interlaced := frame.interlaced_frame):
                        warn(
                            f"{path} is interlaced: the rows of a frame are of two times. Deinterlace it first: "
                            "ffmpeg -i INPUT -vf bwdif OUTPUT"
                        )
                    yield frame
            except av.FFmpegError:
                num_damaged += 1
    if num_damaged:
        warn(f"{path} has {num_damaged} damaged frames, which are left out")


def _packets(*streams: Stream) -> Iterator[Packet]:
    """Yield the packets of streams of a container up to the end, or up to damage, of which it warns."""
    container = cast(InputContainer, streams[0].container)
    try:
        yield from container.demux(*streams)
    except av.FFmpegError as error:
        warn(f"{container.name} is damaged and ends early ({error.strerror})")


def _copy_packets(copies: dict[Stream, Stream], start: int) -> Iterator[Packet]:
    """Yield the packets of streams, each assigned to the copy of its stream, with times from `start`, s, on."""
    for packet in _packets(*copies) if copies else ():
        if packet.dts is not None:  # the last, empty packet of each stream has no time
            shift = round(start / packet.time_base)
            packet.dts -= shift
            packet.pts = None if packet.pts is None else packet.pts - shift
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
        frame = frame.reformat(format=stream.pix_fmt, interpolation=_CONVERSION, threads=_THREADS, **options)
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
    pixels = frame.to_ndarray(format="rgb24", interpolation=_CONVERSION, threads=_THREADS, **options)
    if upright:
        pixels = _turn(pixels, _display_matrix(frame))
    return to_float(torch.from_numpy(pixels.copy()).permute(2, 0, 1)[None].contiguous())


def _matrix_of(colorspace: int) -> int:
    return colorspace if colorspace in _COLOR_MATRICES else Colorspace.ITU601


def _check_turn(frame: av.VideoFrame, path: Path) -> None:
    """Raise UnreadableImageError unless a player shows the frame by a quarter turn or mirrored."""
    matrix = _display_matrix(frame)[:2, :2].astype(float)
    straight, crossed = abs(matrix.diagonal()).max(), abs(np.fliplr(matrix).diagonal()).max()
    if min(straight, crossed) > _MAX_SKEW * max(straight, crossed):
        angle = math.degrees(math.atan2(matrix[0, 1], matrix[0, 0]))
        raise UnreadableImageError(
            f"{path} must be turned for display by a multiple of 90 degrees, got {angle:.0f}; remove its tag: "
            "ffmpeg -display_rotation 0 -i INPUT -c copy OUTPUT"
        )


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


@lru_cache(maxsize=1)
def _sound_codecs() -> frozenset[str]:
    """Return the codecs that MP4 can hold."""
    with av.open(io.BytesIO(), "w", format="mp4") as container:
        return frozenset(container.supported_codecs)
