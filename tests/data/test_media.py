"""Videos keep their times, sound and orientation; pictures their orientation, bits and color profile."""

import errno
import io
import re
import warnings
import zlib
from collections.abc import Callable
from fractions import Fraction
from itertools import count, product
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from av.codec.context import Flags
from pictures import load_clip, open_media, save_media, sound_of, times_of
from PIL import ExifTags, Image, ImageCms, ImageOps, PngImagePlugin

from torchrefract._validation import UsageError
from torchrefract.data.frames import FrameFolder
from torchrefract.data.images import UnreadableImageError, image_header, image_size, read_image
from torchrefract.data.media import describe_losses, describe_turned, find_media, is_complete, write_picture
from torchrefract.data.video import convert_video, read_video, video_info, write_video

ONE = 1 << 16  # of the fixed-point numbers of a display matrix
TURNS = [(a, b, 0, c, d, 0, 0, 0, 1 << 14) for a, b, c, d in (
    *((x * ONE, 0, 0, y * ONE) for x, y in product((1, -1), repeat=2)),
    *((0, x * ONE, y * ONE, 0) for x, y in product((1, -1), repeat=2)),
)]  # fmt: skip  # rows of a table
TIMES_MS = [0, 40, 80, 120, 1400, 1440, 1480, 2600]  # a phone in the dark


def page(k: int = 0, *, height: int = 32, width: int = 48) -> np.ndarray:
    """Return (H, W, 3), uint8, smooth, and different in all its corners."""
    y, x = np.mgrid[:height, :width]
    return np.dstack([3 * x + 20, 5 * y + 20, 100 + x + y + 10 * k]).clip(0, 255).astype(np.uint8)


def duration_of_sound(path: Path) -> float:
    """Return the seconds of sound that the file states."""
    with open_media(path) as container:
        return float(container.streams.audio[0].duration * container.streams.audio[0].time_base)


def remux(
    source: Path, target: Path, *, shift_s: int = 0, prepare: Callable[[Any, Any], None] = lambda *_: None
) -> None:
    """Copy the packets of a file, later by whole seconds; `prepare` changes the new container and its first stream."""
    with open_media(source) as old, open_media(target, "w") as new:
        copies = {stream: new.add_stream_from_template(stream) for stream in old.streams}
        prepare(new, new.streams.video[0])
        for packet in old.demux():
            if packet.dts is not None:
                packet.pts += int(shift_s / packet.time_base)
                packet.dts += int(shift_s / packet.time_base)
                packet.stream = copies[packet.stream]
                new.mux(packet)


def equal(new: np.ndarray, samples: np.ndarray) -> bool:
    return np.array_equal(new[:, : samples.shape[1]], samples)


def as_pixels(frame: torch.Tensor) -> np.ndarray:
    return (255 * frame[0]).movedim(0, -1).numpy()


def unchanged(frames):
    return (as_pixels(frame).round().astype(np.uint8) for frame in frames)


def turned(pixels: np.ndarray, matrix: tuple[int, ...]) -> np.ndarray:
    """Move each pixel by the display matrix of ISO 14496-12: x' = a x + c y, y' = b x + d y."""
    a, b, c, d = (int(np.sign(matrix[i])) for i in (0, 1, 3, 4))
    y, x = np.mgrid[: pixels.shape[0], : pixels.shape[1]]
    right, down = a * x + c * y, b * x + d * y
    right, down = right - right.min(), down - down.min()
    result = np.zeros((down.max() + 1, right.max() + 1, 3), pixels.dtype)
    result[down, right] = pixels
    return result


@pytest.mark.parametrize("matrix", TURNS)
def test_a_turned_video_is_read_as_displayed_or_as_stored_and_stays_upright(tmp_path, matrix):
    save_media(tmp_path / "a.mp4", [page(k) for k in range(3)], times=(0, 40, 80), matrix=matrix)
    stored, displayed = (
        as_pixels(next(read_video(tmp_path / "a.mp4", [1], upright=upright))[1]) for upright in (False, True)
    )
    assert np.abs(stored - page(1)).mean() < 4  # of the codec
    np.testing.assert_array_equal(displayed, turned(stored, matrix))
    assert bool(describe_turned([tmp_path / "a.mp4"])) == (matrix != TURNS[0])
    for upright in (False, True):
        convert_video(tmp_path / "a.mp4", tmp_path / "b.mp4", change=unchanged, upright=upright)
        again = [as_pixels(next(read_video(tmp_path / "b.mp4", [1], upright=is_up))[1]) for is_up in (False, True)]
        assert np.abs(again[1] - displayed).mean() < 3
        assert np.abs(again[0] - (displayed if upright else stored)).mean() < 3


@pytest.mark.parametrize("quarter", [0, 90, 180, 270])
def test_opencv_shows_a_converted_video_as_the_original(tmp_path, quarter):
    c, s = {0: (1, 0), 90: (0, 1), 180: (-1, 0), 270: (0, -1)}[quarter]
    save_media(tmp_path / "a.mp4", [page()], matrix=(c * ONE, s * ONE, 0, -s * ONE, c * ONE, 0, 0, 0, 1 << 14))
    expected = load_clip(tmp_path / "a.mp4")[0].astype(float)
    assert np.abs(as_pixels(next(read_video(tmp_path / "a.mp4", [0]))[1]) - expected).mean() < 2
    convert_video(tmp_path / "a.mp4", tmp_path / "b.mp4", change=unchanged, upright=False)
    assert np.abs(load_clip(tmp_path / "b.mp4")[0] - expected).mean() < 3


@pytest.mark.parametrize(
    ("suffix", "codec", "unit", "times", "sound"),
    [
        (".mp4", "libx264", Fraction(1, 1000), TIMES_MS, "aac"),
        (".mov", "libx264", Fraction(1, 90000), [90 * t + 3 for t in TIMES_MS], "aac"),
        (".mov", "mpeg4", Fraction(1, 600), [600 * t // 1000 for t in TIMES_MS], "pcm_s16le"),
        (".mkv", "libx264", Fraction(1, 1000), [t + 700 for t in TIMES_MS], "flac"),
        (".mkv", "libx264", Fraction(1, 1000), TIMES_MS, "libopus"),
        (".mp4", "libx264", Fraction(1001, 30000), list(range(8)), "libmp3lame"),
        (".avi", "mjpeg", Fraction(1, 25), list(range(8)), "libmp3lame"),
        (".ts", "libx264", Fraction(1, 90000), [3600 * t for t in range(8)], "aac"),  # of a dashcam
    ],
)
def test_a_converted_video_keeps_times_and_sound(tmp_path, suffix, codec, unit, times, sound):
    source, target = tmp_path / f"a{suffix}", tmp_path / "b.mp4"
    pages = [page(k) for k in range(8)]
    pix_fmt = "yuvj420p" if codec == "mjpeg" else "yuv420p"
    save_media(source, pages, times=times, unit=unit, codec=codec, sound=sound, pix_fmt=pix_fmt)
    assert describe_losses([source], upright=True) == []
    assert convert_video(source, target, change=unchanged) == 8
    if suffix not in (".avi", ".ts"):  # of one rate, and with a start above 0
        assert times_of(source) == pytest.approx([float(t * unit) for t in times], abs=1e-3)
    assert times_of(target) == pytest.approx(times_of(source), abs=1e-3)
    (start, samples), (new_start, new_samples) = sound_of(source), sound_of(target)
    # MKV rounds the start of compressed sound to 1 ms. FFmpeg's decoder ignores where MP4 ends it, so the padding of
    # Opus follows the samples, but the file states the end.
    shift = next(k for k in range(-48, 49) if equal(new_samples[:, max(0, k) :], samples[:, max(0, -k) :]))
    assert shift == 0 or suffix == ".mkv"
    assert new_start == pytest.approx(start, abs=1e-3)
    if sound == "libopus":
        assert duration_of_sound(target) == pytest.approx(samples.shape[1] / 48000, abs=1.5e-3)
    assert is_complete(source, target)
    for (_, frame), (_, original) in zip(read_video(target, range(8)), read_video(source, range(8)), strict=True):
        assert np.abs(as_pixels(frame) - as_pixels(original)).mean() < 3


def test_whole_seconds_before_the_first_frame_and_sound_are_left_out(tmp_path):
    first, source, target = tmp_path / "a.ts", tmp_path / "b.ts", tmp_path / "c.mp4"
    save_media(first, [page(k) for k in range(8)], times=[40 * k for k in range(8)], sound="aac")
    remux(first, source, shift_s=9000)  # the camera was switched on 2.5 h before
    assert times_of(source)[0] >= 9000
    assert convert_video(source, target, change=unchanged) == 8
    assert times_of(target) == pytest.approx([t % 1 for t in times_of(source)], abs=1e-3)
    (start, samples), (new_start, new_samples) = sound_of(source), sound_of(target)
    assert times_of(target)[0] - new_start == pytest.approx(times_of(source)[0] - start, abs=1e-3)
    assert new_samples.shape == samples.shape


@pytest.mark.parametrize(("space", "pix_fmt"), [(1, "yuv420p"), (5, "yuv420p"), (9, "yuv420p"), (2, "yuvj420p")])
def test_colors_are_read_by_the_matrix_and_range_of_the_video_and_kept(tmp_path, space, pix_fmt):
    flat = np.full((32, 48, 3), (200, 60, 30), np.uint8)
    save_media(tmp_path / "a.mp4", [flat], space=space, pix_fmt=pix_fmt)
    convert_video(tmp_path / "a.mp4", tmp_path / "b.mp4", change=unchanged)
    for name in ("a.mp4", "b.mp4"):
        _, frame = next(read_video(tmp_path / name, [0]))
        assert np.abs(as_pixels(frame) - flat).max() < 3, name
    with open_media(tmp_path / "b.mp4") as container:
        assert next(container.decode(video=0)).colorspace == space


def test_pixels_that_are_not_square_keep_their_shape(tmp_path):
    def widen(_: Any, stream: Any) -> None:
        stream.sample_aspect_ratio = stream.codec_context.sample_aspect_ratio = Fraction(4, 3)
        stream.set_display_matrix(TURNS[-1])

    save_media(tmp_path / "a.mp4", [page()], matrix=TURNS[-1])
    remux(tmp_path / "a.mp4", tmp_path / "wide.mp4", prepare=widen)
    for upright, ratio in ((False, Fraction(4, 3)), (True, Fraction(3, 4))):
        convert_video(tmp_path / "wide.mp4", tmp_path / "b.mp4", change=unchanged, upright=upright)
        with open_media(tmp_path / "b.mp4") as container:
            assert container.streams.video[0].sample_aspect_ratio == ratio


def test_a_title_that_is_not_unicode_is_read_over(tmp_path):
    options: dict[str, Any] = {"codec": "mjpeg", "pix_fmt": "yuvj420p", "unit": Fraction(1, 25)}
    save_media(tmp_path / "a.avi", [page()], **options, prepare=lambda new, _: new.metadata.update(title="Strasse"))
    content = (tmp_path / "a.avi").read_bytes()
    assert b"Strasse" in content
    (tmp_path / "a.avi").write_bytes(content.replace(b"Strasse", b"Stra\xdfe."))
    ((number, frame),) = read_video(tmp_path / "a.avi", [0])
    assert number == 0
    assert np.abs(frame[0].permute(1, 2, 0).numpy() * 255 - page()).mean() < 2


@pytest.mark.parametrize("angle", [10, 45, -80, 170])
def test_a_video_that_is_turned_by_an_odd_angle_raises(tmp_path, angle):
    c, s = (round(ONE * f(np.deg2rad(angle))) for f in (np.cos, np.sin))
    save_media(tmp_path / "a.mp4", [page()], matrix=(c, s, 0, -s, c, 0, 0, 0, 1 << 14))
    message = rf"a\.mp4 must be turned for display by a multiple of 90 degrees, got {angle}; remove its tag: ffmpeg "
    with pytest.raises(UnreadableImageError, match=message):
        next(read_video(tmp_path / "a.mp4", count()))
    for upright in (True, False):
        with pytest.raises(UnreadableImageError, match=message):
            convert_video(tmp_path / "a.mp4", tmp_path / "b.mp4", change=unchanged, upright=upright)


def test_an_interlaced_video_is_warned_of_once(tmp_path):
    def interlace(_: Any, stream: Any) -> None:
        stream.codec_context.flags |= Flags.interlaced_dct

    save_media(tmp_path / "a.mp4", [page(k) for k in range(3)], prepare=interlace)
    with pytest.warns(UserWarning, match=r"a\.mp4 is interlaced: .* Deinterlace it first: ffmpeg .*bwdif") as caught:
        assert convert_video(tmp_path / "a.mp4", tmp_path / "b.mp4", change=unchanged) == 3
    assert len(caught) == 1


@pytest.mark.parametrize(("transfer", "name"), [(16, "PQ"), (18, "HLG"), (1, None), (13, None)])
def test_a_video_of_high_dynamic_range_is_warned_of_once(tmp_path, transfer, name):
    def state_transfer(_: Any, stream: Any) -> None:
        stream.color_trc = transfer

    save_media(tmp_path / "a.mp4", [page(k) for k in range(3)], prepare=state_transfer)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        assert len([*read_video(tmp_path / "a.mp4", count())]) == 3
    messages = [str(warning.message) for warning in caught]
    assert len(messages) == (name is not None)
    for message in messages:
        assert re.search(
            rf"a\.mp4 has a high dynamic range \({name}\), .* Convert it to BT.709 first, .*tonemap of ffmpeg", message
        )


# A thread of the parent that the child waits for does not exist in it.
FORKED = """
import gc, os, signal, sys
from pathlib import Path
import numpy as np
from torchrefract.data.video import read_video, write_video

gc.disable()  # so that the child frees what the parent has left, as a worker of a DataLoader may
path = Path("a.mp4")
write_video([np.full((64, 96, 3), 9, np.uint8)] * 3, path, fps=25, size=(64, 96))
frames = list(read_video(path, range(3)))
if child := os.fork():
    signal.signal(signal.SIGALRM, lambda *_: os.kill(child, signal.SIGKILL))
    signal.alarm(20)
    sys.exit(os.waitpid(child, 0)[1])
gc.collect()
os._exit(0)
"""


def test_a_forked_process_frees_what_was_read_and_written(tmp_path, spawn):
    (tmp_path / "fork.py").write_text(FORKED)
    assert spawn("fork.py", cwd=tmp_path).code == 0


def test_what_a_video_loses_is_described(tmp_path):
    save_media(tmp_path / "law.mov", [page()], sound="pcm_mulaw")
    save_media(tmp_path / "deep.mkv", [page()], pix_fmt="yuv420p10le", sound="flac")
    save_media(tmp_path / "clear.mov", [page()], codec="qtrle", pix_fmt="argb")
    notes = "notes.txt", "text/plain", b"notes"
    save_media(tmp_path / "silent.mov", [page()])
    remux(tmp_path / "silent.mov", tmp_path / "notes.mkv", prepare=lambda new, _: new.add_attachment(*notes))
    files = [tmp_path / name for name in ("law.mov", "deep.mkv", "clear.mov", "notes.mkv")]
    assert describe_losses(files, upright=True) == [
        "the sound is not kept, since MP4 cannot hold pcm_mulaw: law.mov",
        "10 bits a channel are written as 8: deep.mkv",
        "transparency is not kept: clear.mov",
        "a stream of type attachment is not kept: notes.mkv",
    ]
    for file in files:
        assert convert_video(file, tmp_path / "b.mp4", change=unchanged) == 1


def test_a_sound_and_a_video_of_an_unknown_codec_are_named(tmp_path):
    save_media(tmp_path / "a.mov", [page()], sound="aac")
    data = (tmp_path / "a.mov").read_bytes()
    (tmp_path / "phone.mov").write_bytes(data.replace(b"mp4a", b"apac").replace(b"esds", b"????"))
    (tmp_path / "video.mov").write_bytes(data.replace(b"avc1", b"????"))
    loss = "a sound of a codec that FFmpeg does not know is not kept: phone.mov"
    assert describe_losses([tmp_path / "phone.mov", tmp_path / "video.mov"], upright=True) == [loss]
    assert convert_video(tmp_path / "phone.mov", tmp_path / "b.mp4", change=unchanged) == 1
    assert video_info(tmp_path / "video.mov") == (0, 0.0)
    with pytest.raises(UnreadableImageError, match=r"video\.mov is not a video with a frame that can be decoded"):
        convert_video(tmp_path / "video.mov", tmp_path / "c.mp4", change=unchanged)


def test_frames_after_damage_are_kept_and_the_damage_is_warned_of(tmp_path):
    save_media(tmp_path / "a.avi", [page(k) for k in range(6)], codec="png", pix_fmt="rgb24", unit=Fraction(1, 25))
    data = bytearray((tmp_path / "a.avi").read_bytes())
    second = data.index(b"\x89PNG", data.index(b"\x89PNG") + 1)
    data[second : second + 60] = bytes(60)
    (tmp_path / "a.avi").write_bytes(data)
    with pytest.warns(UserWarning, match=r"a\.avi has 1 damaged frames, which are left out"):
        num_frames = convert_video(tmp_path / "a.avi", tmp_path / "b.mp4", change=unchanged)
    # FFmpeg joins the damaged frame with the one after it.
    assert num_frames == 4
    assert times_of(tmp_path / "b.mp4") == pytest.approx([0, 0.12, 0.16, 0.2], abs=1e-3)
    with pytest.warns(UserWarning, match="1 damaged frames"):
        assert is_complete(tmp_path / "a.avi", tmp_path / "b.mp4")  # so that the next run does not convert it again
    save_media(tmp_path / "c.avi", [page()] * 7, codec="png", pix_fmt="rgb24", unit=Fraction(1, 25))
    assert not is_complete(tmp_path / "c.avi", tmp_path / "b.mp4")


def test_frames_that_change_their_size_raise(tmp_path):
    for name, size in (("a", (32, 48)), ("b", (48, 64))):
        save_media(tmp_path / f"{name}.mkv", [page(height=size[0], width=size[1])], codec="mjpeg", pix_fmt="yuvj420p")
    with open_media(tmp_path / "both.mkv", "w") as target:
        for k, name in enumerate("ab"):
            with open_media(tmp_path / f"{name}.mkv") as source:
                stream = target.streams.video[0] if k else target.add_stream_from_template(source.streams.video[0])
                packet = next(source.demux(video=0))
                packet.stream, packet.pts, packet.dts = stream, 40 * k, 40 * k
                target.mux(packet)
    with pytest.raises(UnreadableImageError, match=r"both\.mkv changes the size of its frames"):
        convert_video(tmp_path / "both.mkv", tmp_path / "c.mp4", change=unchanged)


def test_a_full_disk_raises(tmp_path, file_limit):
    pages = [np.random.default_rng(k).integers(0, 256, (64, 96, 3), np.uint8) for k in range(40)]
    with file_limit(100_000), pytest.raises(OSError, match="File too large"):
        write_video(pages, tmp_path / "a.mp4", fps=10, size=(96, 64))


def test_the_delays_of_a_gif_are_kept_up_to_the_last_one(tmp_path):
    images = [Image.fromarray(page(k)) for k in (0, 5, 9)]
    images[0].save(tmp_path / "a.gif", save_all=True, append_images=images[1:], duration=[50, 700, 90])
    convert_video(tmp_path / "a.gif", tmp_path / "b.mp4", change=unchanged)
    assert times_of(tmp_path / "b.mp4") == pytest.approx([0, 0.05, 0.75], abs=1e-3)
    with open_media(tmp_path / "b.mp4") as container:
        assert container.duration == pytest.approx(840_000, abs=1000)  # microseconds
    assert is_complete(tmp_path / "a.gif", tmp_path / "b.mp4")


def test_a_video_without_a_number_of_frames_in_its_header_is_counted(tmp_path):
    save_media(tmp_path / "a.mkv", [page(k) for k in range(8)], times=TIMES_MS)
    assert video_info(tmp_path / "a.mkv")[0] == 8
    assert write_video([page()] * 5, tmp_path / "b.mp4", fps=29.97, size=(48, 32)) == 5
    assert video_info(tmp_path / "b.mp4") == (5, pytest.approx(29.97, rel=1e-6))


def load(path: Path) -> Image.Image:
    return Image.open(io.BytesIO(path.read_bytes()))


def tagged(path: Path, orientation: int, **options) -> np.ndarray:
    """Write a picture with an orientation, a maker and a color profile; return its stored pixels."""
    exif = Image.Exif()
    exif[0x010F], exif[0x0112] = "maker", orientation
    profile = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    Image.fromarray(page()).save(path, exif=exif, icc_profile=profile, **options)
    return np.asarray(load(path))


@pytest.mark.parametrize("suffix", ["jpg", "png", "webp"])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_a_picture_is_read_as_displayed_or_as_stored_and_stays_upright(tmp_path, suffix, orientation):
    source, target = tmp_path / f"a.{suffix}", tmp_path / f"b.{suffix}"
    stored = tagged(source, orientation, quality=98)
    displayed = np.asarray(ImageOps.exif_transpose(load(source)))
    for upright, expected in ((False, stored), (True, displayed)):
        image = read_image(source, upright=upright)
        assert np.abs(as_pixels(image[None]) - expected).mean() < 2
        write_picture(image, target, source=source, upright=upright)
        with load(target) as written:
            assert written.getexif().get(0x0112) == (1 if upright else orientation)
            assert written.getexif()[0x010F] == "maker"
            assert written.info["icc_profile"] == load(source).info["icc_profile"]
            assert np.abs(np.asarray(ImageOps.exif_transpose(written)).astype(float) - displayed).mean() < 4
        assert is_complete(source, target)
    assert bool(describe_turned([source])) == (orientation != 1)


@pytest.mark.parametrize("upright", [True, False])
@pytest.mark.parametrize("order", ["little", "big"])
def test_the_thumbnail_of_the_source_which_shows_other_pixels_is_not_kept(tmp_path, upright, order):
    def directory(entries: list[tuple[int, int, int]], following: int) -> bytes:
        """Return entries of a tag, its type (3 of 2 bytes, 4 of 4 bytes) and its value, and the next offset."""
        rows = [
            (tag.to_bytes(2, order), kind, value.to_bytes(2 if kind == 3 else 4, order)) for tag, kind, value in entries
        ]
        texts = [
            tag + kind.to_bytes(2, order) + (1).to_bytes(4, order) + value.ljust(4, b"\0") for tag, kind, value in rows
        ]
        return len(rows).to_bytes(2, order) + b"".join(texts) + following.to_bytes(4, order)

    thumbnail = io.BytesIO()
    Image.fromarray(page()).resize((16, 12)).save(thumbnail, "jpeg")
    head = (b"II" if order == "little" else b"MM") + (42).to_bytes(2, order) + (8).to_bytes(4, order)
    of_thumbnail = [(0x0103, 3, 6), (0x0201, 4, 68), (0x0202, 4, len(thumbnail.getvalue()))]
    exif = head + directory([(0x0112, 3, 6)], 26) + directory(of_thumbnail, 0) + thumbnail.getvalue()
    source, target = tmp_path / "a.jpg", tmp_path / "b.jpg"
    Image.fromarray(page()).save(source, exif=b"Exif\0\0" + exif)
    assert load(source).getexif().get_ifd(ExifTags.IFD.IFD1)[0x0201] == 68
    write_picture(read_image(source, upright=upright), target, source=source, upright=upright)
    assert load(target).getexif()[0x0112] == (1 if upright else 6)
    assert not load(target).getexif().get_ifd(ExifTags.IFD.IFD1)


def test_exif_data_behind_the_pixels_of_a_png_turn_it(tmp_path):
    source, target = tmp_path / "a.png", tmp_path / "b.png"
    Image.fromarray(page()).save(source)
    exif = Image.Exif()
    exif[0x0112] = 6
    chunk = b"eXIf" + exif.tobytes().removeprefix(b"Exif\0\0")
    data = source.read_bytes()
    late = (len(chunk) - 4).to_bytes(4, "big") + chunk + zlib.crc32(chunk).to_bytes(4, "big")
    source.write_bytes(data[:-12] + late + data[-12:])  # before IEND
    displayed = page().swapaxes(0, 1)[:, ::-1]
    assert image_size(source) == displayed.shape[:2]
    assert describe_turned([source])
    for upright, pixels in ((True, displayed), (False, page())):
        image = read_image(source, upright=upright)
        assert np.array_equal(as_pixels(image[None]), pixels)
        write_picture(image, target, source=source, upright=upright)
        assert np.array_equal(np.asarray(ImageOps.exif_transpose(load(target))), displayed)
    source.write_bytes(data[:-12] + late[:-1] + b"?" + data[-12:])
    assert image_header(source).orientation == 1  # its checksum is wrong


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".webp"])
@pytest.mark.parametrize("kind", ["as a long number", "in XMP alone"])
def test_the_size_in_the_header_is_that_of_the_pixels_whatever_states_the_orientation(tmp_path, suffix, kind):
    file, exif = tmp_path / f"a{suffix}", Image.Exif()
    exif[0x010F] = "maker"
    xmp = (
        b'<rdf:Description xmlns:tiff="http://ns.adobe.com/tiff/1.0/" tiff:Orientation="6"/>' if "XMP" in kind else b""
    )
    data = exif.tobytes() if xmp else b"Exif\0\0MM\0*\0\0\0\b\0\1\1\x12\0\4\0\0\0\1\0\0\0\6\0\0\0\0"
    info = PngImagePlugin.PngInfo()
    info.add_itxt("XML:com.adobe.xmp", xmp.decode())
    options: dict[str, Any] = {"pnginfo": info} if suffix == ".png" else {"xmp": xmp}
    Image.fromarray(page()).save(file, exif=data, **options)
    height, width = page().shape[:2]
    expected = (height, width) if xmp else (width, height)  # OpenCV and viewers ignore an orientation of XMP
    assert image_size(file) == tuple(read_image(file).shape[1:]) == expected
    assert bool(describe_turned([file])) == (not xmp)


@pytest.mark.parametrize("deep", [True, False])
def test_pictures_in_formats_that_are_not_read_are_warned_of(tmp_path, deep):
    Image.fromarray(page()).save(tmp_path / "a.png")
    for name in ("b.HEIC", "c.tif", "notes.txt"):
        (tmp_path / name).touch()
    with pytest.warns(
        UserWarning, match=r"holds 2 pictures or videos in formats that are not read, such as .*\.(HEIC|tif)"
    ):
        assert find_media(tmp_path, deep=deep) == [tmp_path / "a.png"]
    with pytest.warns(UserWarning, match="holds 2 pictures"):
        assert len(FrameFolder(tmp_path, size=(8, 12))) == 1
    for name in ("d.jfif", "e.ppm", "f.PGM", "g.exr", "h.mpeg", "i.asf", "j.h264"):
        (tmp_path / name).touch()
    with pytest.warns(UserWarning, match="holds 9 pictures"):
        find_media(tmp_path, deep=deep)


@pytest.mark.parametrize("deep", [True, False])
def test_a_folder_that_cannot_be_read_is_one_line_of_error(tmp_path, monkeypatch, deep):
    def refuse(path):
        raise PermissionError(errno.EACCES, "Permission denied", str(path))

    monkeypatch.setattr("os.scandir", refuse)
    with pytest.raises(UsageError, match=f"source must be a folder that can be read, got .*{tmp_path.name}"):
        find_media(tmp_path, deep=deep, name="source")


def test_a_folder_of_folders_is_an_error_that_says_so_where_they_are_not_searched(tmp_path):
    (tmp_path / "drive").mkdir()
    Image.fromarray(page()).save(tmp_path / "drive" / "a.png")
    with pytest.raises(UsageError, match=f"got .*{tmp_path.name}, whose folders are not searched; give one of them$"):
        find_media(tmp_path)
    assert find_media(tmp_path, deep=True) == [tmp_path / "drive" / "a.png"]


def test_folders_beside_files_are_warned_of_where_they_are_not_searched(tmp_path):
    for name in ("a.png", "drive/b.png", "rectified/a.png", "calibration/a.png", "notes/c.txt", ".hidden/d.png"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        Image.fromarray(page()).save(tmp_path / name, "png")
    (tmp_path / "rectified" / "config.json").touch()  # as commands write it into their output
    (tmp_path / "calibration" / "report.md").touch()
    with pytest.warns(UserWarning, match="holds folders with more files, drive, which are not searched; give each by"):
        assert find_media(tmp_path) == [tmp_path / "a.png"]
    assert len(find_media(tmp_path, deep=True)) == 4


def test_sixteen_bits_are_kept(tmp_path):
    pixels = np.random.default_rng(0).integers(0, 65536, (6, 8, 3)).astype(np.uint16)
    cv2.imwrite(str(tmp_path / "a.png"), pixels)
    assert describe_losses([tmp_path / "a.png"], upright=True) == []
    write_picture(read_image(tmp_path / "a.png"), tmp_path / "b.png", source=tmp_path / "a.png")
    np.testing.assert_array_equal(cv2.imread(str(tmp_path / "b.png"), cv2.IMREAD_UNCHANGED), pixels)


def test_what_a_picture_loses_is_described(tmp_path):
    pages = [Image.fromarray(page(k)) for k in range(3)]
    for name in ("moving.png", "moving.webp"):
        pages[0].save(tmp_path / name, save_all=True, append_images=pages[1:], duration=100)
    pages[0].convert("RGBA").save(tmp_path / "clear.png")
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((6, 8), np.uint16))
    (tmp_path / "a.png").rename(tmp_path / "deep.jpg")
    tagged(tmp_path / "a.jpg", 6)
    (tmp_path / "a.jpg").rename(tmp_path / "turned.bmp")
    names = ("moving.png", "moving.webp", "clear.png", "deep.jpg", "turned.bmp")
    assert describe_losses([tmp_path / name for name in names], upright=False) == [
        "the first of several frames is kept: moving.png, moving.webp",
        "transparency is not kept: clear.png",
        "16 bits a channel are written as 8, since .jpg holds no more: deep.jpg",
        "the orientation is not kept, since .bmp cannot hold it: turned.bmp",
    ]


def test_an_invalid_color_profile_is_warned_of(tmp_path):
    source = tmp_path / "a.png"
    Image.fromarray(page()).save(source, icc_profile=bytes(16) + b"RGB " + bytes(200))
    assert image_header(source).profile
    with pytest.warns(UserWarning, match=r"a\.png has an invalid color profile, which is not kept"):
        write_picture(read_image(source), tmp_path / "b.png", source=source)
    assert np.array_equal(np.asarray(load(tmp_path / "b.png")), page())


@pytest.mark.parametrize("kind", [b"GRAY", b"CMYK"])
def test_a_profile_of_other_channels_is_not_written(tmp_path, kind):
    source = tmp_path / "a.jpg"
    Image.fromarray(page()).save(source, icc_profile=bytes(16) + kind + bytes(200))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        write_picture(read_image(source), tmp_path / "b.jpg", source=source)
    assert "icc_profile" not in load(tmp_path / "b.jpg").info
