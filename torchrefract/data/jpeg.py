"""Detection of JPEG files that lack pixel data but have their end marker.

A decoder fills missing blocks with gray and only prints a warning. Bytes that are added at the end of the pixel data
tell: a decoder of complete data ignores them, and one that lacks data takes them for pixels.
"""

import io
import re

import numpy as np
from PIL.JpegImagePlugin import JpegImageFile

_MARKER = re.compile(rb"\xff+[^\x00\xff]", re.DOTALL)  # in pixel data, a byte 0xFF is followed by 0
START_OF_SCAN, _END = 0xDA, 0xD9
_RESTARTS = range(0xD0, 0xD8)
_WITHOUT_LENGTH = (0x01, *range(0xD0, _END))
_PROGRESSIVE = (0xC2, 0xC6, 0xCA, 0xCE)  # start of frame
_FILLER = bytes(range(1, 255)) * 4
_GRAY = 128  # of a block without data


def lacks_pixel_data(data: bytes, pixels: np.ndarray) -> bool:
    """Return True if a JPEG holds less data than its size needs.

    Args:
        data: the file.
        pixels: (H, W, 3), its decoded pixels.
    """
    extended, is_progressive, is_in_sequence = _extend_scans(data)
    if not is_in_sequence:
        return True
    gray = (pixels[::4, ::4] == _GRAY).all(axis=2)
    # Missing blocks of a progressive file are not gray but blurred.
    if not is_progressive and not (gray[:, 1:] & gray[:, :-1]).any() and not gray[[0, 0, -1, -1], [0, -1, 0, -1]].any():
        return False
    # OpenCV would print that the added bytes make the file corrupt.
    try:
        original, again = (JpegImageFile(io.BytesIO(content)).tobytes() for content in (data, extended))
    except OSError:
        return True
    return original != again


def _extend_scans(data: bytes) -> tuple[bytes, bool, bool]:
    """Add bytes before each marker that ends pixel data.

    Returns:
        the new file, True if it is progressive, and True if no restart marker is missing between two others.
    """
    parts, is_progressive, is_in_sequence, in_scan, position, num_restarts = [data[:2]], False, True, False, 2, 0
    while marker := _MARKER.search(data, position):
        code = data[marker.end() - 1]
        parts += [data[position : marker.start()], _FILLER if in_scan else b"", marker.group()]
        position = marker.end()
        if code == _END:
            break
        is_progressive |= code in _PROGRESSIVE
        if code in _RESTARTS:
            is_in_sequence &= code == _RESTARTS[num_restarts % 8]
            num_restarts += 1
        if code not in _WITHOUT_LENGTH:
            end = position + int.from_bytes(data[position : position + 2], "big")
            parts.append(data[position:end])
            position, in_scan, num_restarts = end, code == START_OF_SCAN, 0
    return b"".join([*parts, data[position:]]), is_progressive, is_in_sequence
