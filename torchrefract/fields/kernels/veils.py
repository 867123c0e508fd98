"""What numba compiles: frames behind fog, AT_ONCE pixels of a row after the other.

Of those behind so much fog that nothing is seen of them the image is not read, of those behind so little that it is not
seen nothing else is; of neither there is an exponential. Rows are those of all frames, one below the other; each call
does those from `start` on and before `stop`. Arrays are read at places from their begin, as no part of one is made
without being counted. Arguments:

source and out: (N C H W,); size: C, H, W.
light: (2, N, C), the airlight as it is stored, and as it is blended.
linear: what is blended is linear light.
"""

import numpy as np

from torchrefract._jit import fma, inlined, jit
from torchrefract.fields.kernels.exponentials import exponential, power
from torchrefract.fields.kernels.nodes import Floats, Number

AT_ONCE = 128
Size = tuple[int, int, int]
# Of t = exp(-(a n + b) d): n, (N H W,), which t takes the place of; d, (N or 1, H, W or 1), m; a, (N,), and b.
Drifting = tuple[Floats, Floats, Floats, Floats]
_NONE, _ONE, _HALF = np.float32(0), np.float32(1), np.float32(0.5)
_FARTHEST = np.float32(1e12)  # m
_LARGEST = np.float32(1e15)  # beyond it, and where it is none, a number is no light and stays as it is
# Of sRGB: where its line ends, as stored and in linear light, the slope of that, and the curve.
_END_STORED, _END, _SLOPE = np.float32(0.04045), np.float32(0.0031308), np.float32(12.92)
_OFFSET, _SCALE, _EXPONENT = np.float32(0.055), np.float32(1.055), np.float32(2.4)


@jit
def behind_drifts(
    linear: bool,
    drifting: Drifting,
    ends: tuple[Number, Number],
    source: Floats,
    size: Size,
    light: Floats,
    start: int,
    stop: int,
    out: Floats,
) -> None:
    """Behind fog in drifts, whose t is made on the way.

    ends: of (a n + b) d: below the first one t is 1; above the second one, at most 87, it is 0.
    """
    noise, distance, scale, offset = drifting
    channels, height, width = size
    x = np.empty(AT_ONCE, np.float32)
    for at in range(start, stop):
        i, y = divmod(at, height)
        d = distance[min(i, distance.shape[0] - 1), y]
        for begin in range(0, width, AT_ONCE):
            count, place = min(AT_ONCE, width - begin), np.uintp(at * width + begin)
            if d.size == 1:
                near = min(d[0], _FARTHEST)
                a, b = scale[i] * near, offset[i] * near
                for k in range(count):
                    x[k] = fma(noise[place + np.uintp(k)], a, b)
            else:
                for k in range(count):
                    near = min(d[np.uintp(begin + k)], _FARTHEST)
                    x[k] = fma(noise[place + np.uintp(k)], scale[i] * near, offset[i] * near)
            kind = _transmission(x, ends, count, noise, place)
            for c in range(channels):
                pixel = np.uintp(((i * channels + c) * height + y) * width + begin)
                color = light[0, i, c], light[1, i, c]
                _blend(noise, place, kind, color, linear, source, pixel, count, out)


@jit
def behind(
    linear: bool,
    t: Floats,
    ends: tuple[Number, Number],
    source: Floats,
    size: Size,
    light: Floats,
    start: int,
    stop: int,
    out: Floats,
) -> None:
    """Behind fog that lets t through, (N or 1, H, W or 1).

    ends: of t: from the first one on it counts as 1, up to the second as 0.
    """
    channels, height, width = size
    own, none, kind = np.empty(AT_ONCE, np.float32), np.uintp(0), 0
    for at in range(start, stop):
        i, y = divmod(at, height)
        row = t[min(i, t.shape[0] - 1), y]
        for begin in range(0, width, AT_ONCE):
            count = min(AT_ONCE, width - begin)
            if row.size == 1 and begin == 0:
                for k in range(count):
                    own[k] = row[0]
                kind = _ended(own, ends, count)
            elif row.size > 1:
                for k in range(count):
                    own[k] = row[np.uintp(begin + k)]
                kind = _ended(own, ends, count)
            for c in range(channels):
                pixel = np.uintp(((i * channels + c) * height + y) * width + begin)
                _blend(own, none, kind, (light[0, i, c], light[1, i, c]), linear, source, pixel, count, out)


@jit
def slopes(t: Floats, source: Floats, size: Size, light: Floats, start: int, stop: int, out: Floats) -> None:
    """Of what linear light behind fog becomes, as it is stored, in what it was: out (N C H W,), behind t."""
    channels, height, width = size
    own = np.empty(width, np.float32)
    for at in range(start, stop):
        i, y = divmod(at, height)
        row = t[min(i, t.shape[0] - 1), y]
        for k in range(width):
            own[k] = row[0] if row.size == 1 else row[k]
        for c in range(channels):
            pixel = np.uintp(((i * channels + c) * height + y) * width)
            for k in range(width):
                value = source[pixel + np.uintp(k)]
                mixed = _mixed(_decoded(value), own[k], light[1, i, c])
                found = own[k] * _decoding(value) * _encoding(mixed)
                out[pixel + np.uintp(k)] = _ONE if own[k] == _ONE else found


@inlined
def _ended(t: Floats, ends: tuple[Number, Number], count: int) -> int:
    """The kind of pixels, see `_transmission`, whose t has its ends from here on."""
    high, low = ends
    least, most = _bits(t[0]), _bits(t[0])
    for k in range(count):
        bits = _bits(t[k])
        least, most = min(least, bits), max(most, bits)
        t[k] = _ONE if t[k] >= high else _NONE if t[k] <= low else t[k]
    return 1 if least >= _bits(high) else -1 if most <= _bits(low) else 0


@inlined
def _transmission(x: Floats, ends: tuple[Number, Number], count: int, out: Floats, place: np.uintp) -> int:
    """The kind of these pixels: -1 where nothing comes through, 1 where all does, else 0."""
    low, high = ends
    least, most = _bits(x[0]), _bits(x[0])
    for k in range(count):
        bits = _bits(x[k])
        least, most = min(least, bits), max(most, bits)
    kind = 1 if most < _bits(low) else -1 if least > _bits(high) else 0
    if kind:
        for k in range(count):
            out[place + np.uintp(k)] = _ONE if kind > 0 else _NONE
    else:
        for k in range(count):
            t = exponential(-min(max(x[k], _NONE), high))
            t = _ONE if x[k] < low else t
            out[place + np.uintp(k)] = _NONE if x[k] > high else t
    return kind


@inlined
def _bits(value: Number) -> np.int32:
    """In the order of numbers that are not negative, and below them where they are: extremes are found at once."""
    return np.float32(value).view(np.int32)


@inlined
def _blend(
    t: Floats,
    place: np.uintp,
    kind: int,
    color: tuple[Number, Number],
    linear: bool,
    source: Floats,
    pixel: np.uintp,
    count: int,
    out: Floats,
) -> None:
    """Pixels of one channel, from a place on."""
    stored, light = color
    if kind < 0:
        for k in range(count):
            out[pixel + np.uintp(k)] = stored
    elif kind > 0:
        for k in range(count):
            out[pixel + np.uintp(k)] = source[pixel + np.uintp(k)]
    elif linear:
        for k in range(count):
            value, own = source[pixel + np.uintp(k)], t[place + np.uintp(k)]
            found = _encoded(_mixed(_decoded(value), own, light))
            # What goes through the curve and back is another number.
            out[pixel + np.uintp(k)] = value if own == _ONE else stored if own == _NONE else found
    else:
        for k in range(count):
            out[pixel + np.uintp(k)] = _mixed(source[pixel + np.uintp(k)], t[place + np.uintp(k)], light)


@inlined
def _mixed(value: Number, t: Number, light: Number) -> Number:
    """The value itself where t = 1, and the light where t = 0."""
    return value if t == _ONE else fma(t, value - light, light)


@inlined
def _decoded(stored: Number) -> Number:
    """Linear light of a stored value; `fields.fog.srgb_to_linear`."""
    line = stored * (_ONE / _SLOPE)
    high = power((max(stored, _END_STORED) + _OFFSET) * (_ONE / _SCALE), _EXPONENT)
    return line if stored <= _END_STORED else high if stored < _LARGEST else stored


@inlined
def _encoded(light: Number) -> Number:
    """The stored value of linear light; `fields.fog.linear_to_srgb`."""
    line = light * _SLOPE
    high = fma(_SCALE, power(max(light, _END), _ONE / _EXPONENT), -_OFFSET)
    return line if light <= _END else high if light < _LARGEST else light


@inlined
def _decoding(stored: Number) -> Number:
    """The slope of `_decoded`."""
    high = _EXPONENT / _SCALE * power((max(stored, _END_STORED) + _OFFSET) * (_ONE / _SCALE), _EXPONENT - _ONE)
    return _ONE / _SLOPE if stored <= _END_STORED else high if stored < _LARGEST else _ONE


@inlined
def _encoding(light: Number) -> Number:
    """The slope of `_encoded`."""
    high = _SCALE / _EXPONENT * power(max(light, _END), _ONE / _EXPONENT - _ONE)
    return _SLOPE if light <= _END else high if light < _LARGEST else _ONE
