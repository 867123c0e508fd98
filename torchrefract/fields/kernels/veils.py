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
    drifting: Drifting,
    ends: tuple[Number, Number],
    source: Floats,
    size: Size,
    light: Floats,
    linear: bool,
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
    t: Floats,
    ends: tuple[Number, Number],
    source: Floats,
    size: Size,
    light: Floats,
    linear: bool,
    start: int,
    stop: int,
    out: Floats,
) -> None:
    """Behind fog that lets t through, (N or 1, H, W or 1).

    ends: of t: above the first one it counts as 1, below the second as 0.
    """
    channels, height, width = size
    own, none = np.empty(AT_ONCE, np.float32), np.uintp(0)
    for at in range(start, stop):
        i, y = divmod(at, height)
        row = t[min(i, t.shape[0] - 1), y]
        for begin in range(0, width, AT_ONCE):
            count = min(AT_ONCE, width - begin)
            clear, opaque = 0, 0
            for k in range(count):
                found = row[0] if row.size == 1 else row[np.uintp(begin + k)]
                found = _ONE if found > ends[0] else found
                own[k] = _NONE if found < ends[1] else found
                clear += own[k] == _ONE
                opaque += own[k] == _NONE
            kind = _kind(clear, opaque, count)
            for c in range(channels):
                pixel = np.uintp(((i * channels + c) * height + y) * width + begin)
                _blend(own, none, kind, (light[0, i, c], light[1, i, c]), linear, source, pixel, count, out)


@inlined
def _transmission(x: Floats, ends: tuple[Number, Number], count: int, out: Floats, place: np.uintp) -> int:
    """The kind of these pixels, see `_kind`."""
    low, high = ends
    clear, opaque = 0, 0
    for k in range(count):
        clear += x[k] < low
        opaque += x[k] > high
    kind = _kind(clear, opaque, count)
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
def _kind(clear: int, opaque: int, count: int) -> int:
    """-1 where nothing comes through, 1 where all does, else 0."""
    return (clear == count) - (opaque == count)


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
    apart = value - light
    return fma(t, apart, light) if t < _HALF else fma(t - _ONE, apart, value)


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
