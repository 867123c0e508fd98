"""Pictures and videos that tests write and read, as NumPy arrays in RGB or gray."""

from collections.abc import Callable, Iterable, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any, Literal

import av
import cv2
import numpy as np
from PIL import Image, ImageSequence


def smooth_picture(height: int = 48, width: int = 96, seed: int = 0) -> np.ndarray:
    """Return (H, W, 3), uint8, smooth enough for a video codec."""
    y, x = np.mgrid[:height, :width]
    waves = [127 + 100 * np.sin(x / (9 + c) + seed) * np.cos(y / (11 - c)) for c in range(3)]
    return np.stack(waves, axis=-1).astype(np.uint8)


def save_picture(path: Path, pixels: np.ndarray) -> None:
    """Write (H, W), (H, W, 3), of 8 or 16 bits, and create the folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), pixels[..., ::-1] if pixels.ndim == 3 else pixels)


def load_picture(path: Path) -> np.ndarray:
    """Return the pixels that OpenCV reads, of any number of bits."""
    pixels = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert pixels is not None, f"{path} cannot be read"
    return pixels[..., ::-1] if pixels.ndim == 3 else pixels


def load_frames(path: Path) -> list[np.ndarray]:
    """Return the frames (H, W, 3) that Pillow reads of a picture or an animation."""
    with Image.open(path) as image:
        return [np.asarray(frame.convert("RGB")) for frame in ImageSequence.Iterator(image)]


def save_turned(path: Path, pixels: np.ndarray, orientation: int) -> None:
    """Write a picture with an EXIF tag that turns it for display."""
    exif = Image.Exif()
    exif[0x0112] = orientation
    Image.fromarray(pixels).save(path, exif=exif)


def save_clip(path: Path, frames: Iterable[np.ndarray], *, fps: float = 12) -> None:
    """Write frames (H, W, 3) as a video of OpenCV's, each a JPEG."""
    frames = list(frames)
    height, width, _ = frames[0].shape
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), fps, (width, height))
    for frame in frames:
        writer.write(frame[..., ::-1])
    writer.release()


def load_clip(path: Path) -> list[np.ndarray]:
    """Return the frames that OpenCV reads of a video."""
    capture, frames = cv2.VideoCapture(str(path)), list[np.ndarray]()
    while (frame := capture.read()[1]) is not None:
        frames.append(frame[..., ::-1])
    return frames


def open_media(path: Path, mode: Literal["r", "w"] = "r") -> Any:
    """Open a container of PyAV, whose types leave out much of what streams have."""
    return av.open(str(path), mode)


def save_media(
    path: Path,
    frames: Sequence[np.ndarray],
    *,
    times: Sequence[int] = (),
    unit: Fraction = Fraction(1, 1000),
    codec: str = "libx264",
    pix_fmt: str = "yuv420p",
    sound: str = "",
    matrix: tuple[int, ...] | None = None,
    space: int = 2,
    prepare: Callable = lambda *_: None,
) -> None:
    """Write a video of frames (H, W, 3) at times, with a sine of a second as its sound.

    sound: the codec of the sound; none if empty.
    matrix: the display matrix.
    space: the number of the color space.
    prepare: function of the container and the stream of the video, called before the first frame.
    """
    with open_media(path, "w") as container:
        stream = container.add_stream(codec, rate=25)
        stream.height, stream.width = frames[0].shape[:2]
        stream.pix_fmt, stream.colorspace = pix_fmt, space
        stream.codec_context.time_base = stream.time_base = unit
        if matrix:
            stream.set_display_matrix(matrix)
        prepare(container, stream)
        track: Any = container.add_stream(sound, rate=48000, layout="mono") if sound else None
        for pixels, t in zip(frames, times or range(len(frames)), strict=True):
            frame = av.VideoFrame.from_ndarray(pixels, format="rgb24")
            frame = frame.reformat(format=pix_fmt, dst_colorspace=space if space != 2 else 5, threads=1)
            frame.pts, frame.time_base = t, unit
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
        for start in range(0, 48000 if track else 0, 960):
            wave = (9000 * np.sin(np.arange(start, start + 960) / 17)).astype(np.int16)[None]
            frame = av.AudioFrame.from_ndarray(wave, format="s16", layout="mono")
            frame.sample_rate, frame.pts = 48000, start
            for resampled in av.AudioResampler(track.codec_context.format, "mono", 48000).resample(frame):
                container.mux(track.encode(resampled))
        if track:
            container.mux(track.encode(None))


def times_of(path: Path) -> list[float]:
    """Return the times of the frames of a video, s."""
    with open_media(path) as container:
        return [frame.time for frame in container.decode(video=0)]


def sound_of(path: Path) -> tuple[float, np.ndarray]:
    """Return the time of the first sample, s, and all samples (1, N)."""
    with open_media(path) as container:
        frames = list(container.decode(audio=0))
    return frames[0].time, np.concatenate([frame.to_ndarray() for frame in frames], axis=1)


def files_in(folder: Path) -> list[str]:
    """Return the sorted paths of all files in a folder, but for hidden ones."""
    names = (path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())
    return sorted(name for name in names if not name.startswith("."))
