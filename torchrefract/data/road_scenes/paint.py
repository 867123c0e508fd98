"""Paints of panels: functions of the position on a panel that return albedo (K, 3) and a mask of solid parts (K,).

u runs across from the middle of a panel, v up from its lower edge, both (K,), m. Colors are linear albedos.
"""

from collections.abc import Callable
from functools import cache

import numpy as np

Array = np.ndarray
Color = Array | tuple[float, ...]
Paint = Callable[[Array, Array], tuple[Array, Array]]

_GLASS, _DARK = (0.07, 0.1, 0.13), (0.02, 0.02, 0.022)
_TILE = 256  # period of the noise, a power of two
_WHEEL = 0.33  # m, radius


@cache
def _noise_tile() -> Array:
    return np.random.default_rng(0).uniform(-1, 1, _TILE * _TILE).astype(np.float32)


def noise(x: Array, y: Array | float) -> Array:
    """Return smooth value noise in [-1, 1] with unit cells and period 256."""
    column, row = np.floor(x), np.floor(y)
    x, y = x - column, y - row
    x, y = x * x * (3 - 2 * x), y * y * (3 - 2 * y)
    left, top = column.astype(np.int32) & (_TILE - 1), (row.astype(np.int32) & (_TILE - 1)) * _TILE
    right, bottom, tile = (left + 1) & (_TILE - 1), (top + _TILE) & (_TILE**2 - 1), _noise_tile()
    upper, lower = tile[top + left], tile[bottom + left]
    upper, lower = upper + (tile[top + right] - upper) * x, lower + (tile[bottom + right] - lower) * x
    return upper + (lower - upper) * y


def _fraction(value: Array) -> Array:
    return value - np.floor(value)


def _shaded(color: Color, shade: Array) -> Array:
    return np.asarray(color, np.float32) * shade[:, None]


def textured(color: Color, seed: float, scale: float) -> Paint:
    """Paint a solid surface with noise of `scale` cells a meter."""
    return lambda u, v: (_shaded(color, 1 + 0.2 * noise(u * scale + seed * 256, v * scale)), v >= 0)


def skyline(color: Color, seed: float, height: float, octaves: dict[float, float], level: float) -> Paint:
    """Paint what lies below a skyline of noise, as hills or bush; a level below 1 cuts it flat.

    Args:
        color, seed: albedo; offset of the noise, in [0, 1).
        height: of the panel, m.
        octaves: amplitude of each cell size, both in heights of the panel.
        level: in heights of the panel.
    """

    def paint(u: Array, v: Array) -> tuple[Array, Array]:
        top = 0.5 + sum(size * noise(u / height / cell + seed * 256, 77 * cell) for cell, size in octaves.items())
        texture = noise(u * 4 / height + seed * 256, v * 6 / height)
        return _shaded(color, 1 + 0.3 * texture), v < height * np.clip(top, 0.1, level)

    return paint


def crown(color: Color, seed: float, half_width: float, half_height: float) -> Paint:
    """Paint leaves in an ellipse whose rim breaks up."""
    stretch = 0.6 + 0.4 * half_width / half_height

    def paint(u: Array, v: Array) -> tuple[Array, Array]:
        depth = np.sqrt(np.clip(1 - (u / half_width) ** 2 - (v / half_height - 1) ** 2, 0, None))
        x, y = u + seed * 256, v * stretch
        leaf = noise(x * 2.2, y * 2.2) + 0.7 * noise(x * 7.5, y * 7.5)
        return _shaded(color, (1.1 + 0.6 * leaf) * (0.65 + 0.35 * v / half_height)), depth > 0.4 + 0.35 * leaf

    return paint


def pole(color: Color, height: float, is_lamp: bool) -> Paint:
    """Paint a mast with an arm: on both sides for wires, on the right side for a lamp."""

    def paint(u: Array, v: Array) -> tuple[Array, Array]:
        top = height - v
        arm = (top < 0.16) & (u > 0) if is_lamp else (top > 0.5) & (top < 0.68)
        return _shaded(color, 1 + 0.25 * noise(u * 9, v)), (np.abs(u) < 0.13) | arm

    return paint


def building(color: Color, seed: float, wall: float, gable: tuple[float, float] = (0.0, 1.0)) -> Paint:
    """Paint a wall with a row of framed windows and doors in each storey, and a plinth.

    Args:
        color, seed: albedo; which cells have doors, in [0, 1).
        wall: height without the gable, m.
        gable: height, and half the width at its foot, m.
    """

    def paint(u: Array, v: Array) -> tuple[Array, Array]:
        along = u / (2.4 + seed) + 100.5
        storey, middle = _fraction(v / 2.9) * 2.9, np.abs(_fraction(along) - 0.5)
        frame = (middle < 0.29) & (np.abs(storey - 1.5) < 0.65) & (v < wall - 0.4)
        pane = frame & (np.abs(middle - 0.135) < 0.115) & (np.abs(storey - 1.5) < 0.55)
        door = (_fraction(np.floor(along) * 0.381 + seed) < 0.3) & (middle < 0.2) & (v < 2.1)
        albedo = _shaded(color, np.where(v < 0.35, 0.6, 1 + 0.08 * noise(u + seed * 256, v)))
        albedo[frame], albedo[pane], albedo[door] = (0.62, 0.6, 0.56), _GLASS, (0.16, 0.08, 0.04)
        return albedo, v < wall + np.where(gable[0] > 0, gable[0] * (1 - np.abs(u) / gable[1]), 1)

    return paint


def barrier(color: Color, rails: tuple[float, ...], thickness: float, spacing: float) -> Paint:
    """Paint posts and horizontal rails at some heights, m."""

    def paint(u: Array, v: Array) -> tuple[Array, Array]:
        distance = np.min([np.abs(v - height) for height in rails], axis=0)
        solid = (distance < thickness / 2) | (_fraction(u / spacing + 100) < 0.12 / spacing)
        return _shaded(color, np.where(distance < thickness / 8, 0.6, 1.0)), solid

    return paint


def hull_side(color: Color, half_length: float) -> Paint:
    """Paint the lower side of a vehicle, with wheels."""

    def paint(u: Array, v: Array) -> tuple[Array, Array]:
        wheel = np.hypot(np.abs(u) - 0.62 * half_length, v - _WHEEL)
        albedo = _shaded(color, np.where(np.abs(u + 0.05) < 0.02, 0.4, 1.0))
        albedo[(v < 0.45) | (wheel < 0.41)], albedo[wheel < 0.21] = _DARK, (0.3, 0.3, 0.31)
        return albedo, (v > 0.24) | (wheel < _WHEEL)

    return paint


def hull_end(color: Color, half_width: float, height: float, is_front: bool) -> Paint:
    """Paint the front or the rear of a vehicle: lamps, grille, bumper, number plate, tires."""

    def paint(u: Array, v: Array) -> tuple[Array, Array]:
        x, y = np.abs(u) / half_width, v / height
        albedo = _shaded(color, np.where((y > 0.3) & (y < 0.46), 0.4, 1.0))
        albedo[(v < 0.4) | (is_front & (x < 0.6) & (y > 0.52) & (y < 0.78))] = _DARK
        albedo[(np.abs(x - 0.8) < 0.15) & (y > 0.58) & (y < 0.85)] = (1.6, 1.5, 1.3) if is_front else (0.75, 0.02, 0.02)
        albedo[(x < 0.3) & (y > 0.42) & (y < 0.54)] = (0.7, 0.62, 0.25)
        return albedo, (v > 0.24) | (np.abs(u) > half_width - 0.24)

    return paint


def cabin(color: Color, half_width: float, height: float, inset: float, glass: tuple[float, float]) -> Paint:
    """Paint a trapezoid with a window; without a window, the ribbed load of a truck.

    Args:
        color: albedo around the window.
        half_width, height: m, at the lower edge.
        inset: difference of the half widths at the lower and the upper edge, m.
        glass: lower and upper edge of the window, in heights.
    """

    def paint(u: Array, v: Array) -> tuple[Array, Array]:
        end, y = half_width - inset * v / height, v / height
        albedo = _shaded(color, np.where((glass[1] < 0.5) & (_fraction(u * 1.6) < 0.12), 0.8, 1.0))
        albedo[(y > glass[0]) & (y < glass[1]) & (np.abs(u) < end - 0.08)] = _GLASS
        return albedo, np.abs(u) < end

    return paint
