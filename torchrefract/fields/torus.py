"""The torus that a field is sampled on, large enough for the frame and what it is correlated with."""

import math

from torchrefract.fields.covariance import REACH

# Room round the torus in apertures: a smoothed field is correlated over sqrt(2) of them.
_APERTURE_REACH = 6.0
# Larger tori cost gigabytes. With less room the covariance is off by up to twice what `Spectrum.clipped` tells.
_MOST_POINTS = 1 << 24


def torus(height: int, width: int, *, length: float, kind: str, aperture: float = 0.0) -> tuple[int, int]:
    """(Ht, Wt), px: a torus on which opposite edges of a frame have lost sight of each other.

    Args:
        height, width: of the frame, px.
        length: the longest correlation length, px.
        kind: of the covariance.
        aperture: the widest, px.
    """
    # A frame as large as the cap still gets some room: its edges must not join.
    most = max(_MOST_POINTS, 2 * height * width)
    room = math.ceil(min(math.hypot(REACH[kind] * length, _APERTURE_REACH * aperture), most))
    size = _fast_size(height + room), _fast_size(width + room)
    if size[0] * size[1] <= most:
        return size
    # The room for which (height + room) (width + room) is the most that is allowed.
    half = (height + width) / 2
    room = math.floor(math.sqrt(half * half - height * width + most) - half)
    return _fast_size_below(height + room, height), _fast_size_below(width + room, width)


def _fast_size(least: int) -> int:
    """The smallest even number from `least` on that has no prime factor above 7."""
    size = max(2, least + least % 2)
    while not _is_smooth(size):
        size += 2
    return size


def _fast_size_below(most: int, least: int) -> int:
    """The largest such number up to `most`, or where that is below `least`, the smallest from there on."""
    sizes = range(most - most % 2, max(least, 2) - 1, -2)
    return next(filter(_is_smooth, sizes), _fast_size(least))


def _is_smooth(size: int) -> bool:
    return 210**64 % size == 0
