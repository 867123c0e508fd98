"""Layout of a road scene: road, camera, light and objects, drawn from a random generator.

World axes: x right, y up, z ahead, m. The ground is y = 0. The camera stands at (x, height, 0). Colors are linear
albedos.
"""

import math
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np

Array = np.ndarray
Color = Array | tuple[float, ...]
Painted = tuple[Array, Array]  # albedo (K, 3), solid parts (K,), bool
Paint = Callable[[Array, Array], Painted]  # of u to the right of the middle of a panel and v above its foot, (K,), m

_WALLS = ((0.6, 0.56, 0.48), (0.55, 0.42, 0.25), (0.42, 0.2, 0.12), (0.3, 0.42, 0.45), (0.66, 0.64, 0.6))
_ROOFS = ((0.32, 0.08, 0.05), (0.33, 0.34, 0.35), (0.09, 0.17, 0.11), (0.3, 0.15, 0.08))
_LEAVES = ((0.08, 0.14, 0.035), (0.12, 0.17, 0.05), (0.14, 0.15, 0.06), (0.06, 0.1, 0.035), (0.2, 0.18, 0.08))
_CARS = ((0.72, 0.72, 0.7), (0.4, 0.41, 0.42), (0.05, 0.05, 0.055), (0.4, 0.03, 0.03), (0.05, 0.1, 0.28))
_BARK, _GLASS, _DARK = (0.16, 0.11, 0.08), (0.07, 0.1, 0.13), (0.02, 0.02, 0.022)
_WHITE_LAMPS, _RED_LAMPS = (1.6, 1.5, 1.3), (0.75, 0.02, 0.02)
# Width, length, heights of the belt line and the roof, length of the cabin, distance by which its ends lean in, m.
_MODELS = ((1.8, 4.4, 0.93, 1.46, 2.7, 0.7), (1.8, 4.8, 1.05, 2.05, 4.5, 0.35))  # car, minibus
_WHEEL = 0.33  # m, radius
_CORNERS = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
_TILE = 256  # period of the noise, a power of two
_NOISE = np.random.default_rng(0).uniform(-1, 1, _TILE * _TILE).astype(np.float32)


class Road:
    """A road and its verges, drawn from a random generator; lengths in m, curve in 1/m."""

    def __init__(self, random: np.random.Generator):
        self.is_town = random.random() < 0.4
        self.is_paved = self.is_town or random.random() < 0.65
        self.lane = random.uniform(3.0, 3.7)  # width
        self.half_width = self.lane + random.uniform(0.2, 1.2) * self.is_paved
        self.curve = random.uniform(-1, 1) ** 3 / 160
        self.has_solid_line = random.random() < 0.2
        self.green_grass, self.red_soil = random.random(2)
        self.asphalt = random.uniform(0.07, 0.2)  # albedo
        self.shift = random.uniform(0, 256, 2)  # of the texture of ground and clouds

    def center(self, z: Array | float) -> Array | float:
        """Return x of the center line: curve z^2 / (2 + z / 300), a parabola that straightens far away."""
        return self.curve * z * z / (2 + z / 300)

    def place(self, offset: float, z: float, sign: float = 1.0) -> "Body":
        """Place a body at an offset from the center line, in the direction of the road."""
        tangent = self.curve * z * (4 + z / 300) / (2 + z / 300) ** 2
        return Body(float(self.center(z)) + offset, z, tangent, sign)


class View(NamedTuple):
    """A pinhole camera: position (3,), axes right, down, ahead as rows (3, 3), focal length in longer image sides."""

    position: Array
    axes: Array
    focal: float


class Light:
    """The direction to the sun (3,), colors of light (3,) and the density of clouds, drawn from a random generator."""

    def __init__(self, random: np.random.Generator):
        is_overcast, heading = random.random() < 0.22, random.uniform(-math.pi, math.pi)
        elevation = 2.5 if is_overcast else random.uniform(0.22, 1)
        warm, power = np.clip((0.65 - elevation) / 0.4, 0, 1), random.uniform(0.85, 1.25)

        def mix(clear: Color, golden: Color, gray: Color) -> Array:
            color = gray if is_overcast else np.array(clear) * (1 - warm) + np.array(golden) * warm
            return power * np.asarray(color, np.float32)

        sun = np.array([math.sin(heading), elevation * 1.2, math.cos(heading)])
        self.sun = sun / np.linalg.norm(sun)
        self.beam = mix((1.15, 1.08, 0.95), (1.7, 0.98, 0.45), (0.3, 0.3, 0.3))
        self.ambient = mix((0.3, 0.36, 0.46), (0.3, 0.3, 0.36), (0.58, 0.6, 0.63))
        self.zenith = mix((0.09, 0.22, 0.56), (0.14, 0.24, 0.45), (0.45, 0.48, 0.53))
        self.horizon = mix((0.52, 0.66, 0.82), (0.95, 0.68, 0.42), (0.72, 0.74, 0.77))
        self.clouds = 1.0 if is_overcast else random.uniform(-0.5, 0.55)


class Panel(NamedTuple):
    """A flat rectangle; `right` and `up`, (3,), lead from its center, (3,), to the middle of those edges."""

    center: Array
    right: Array
    up: Array
    paint: Paint

    @property
    def normal(self) -> Array:
        """The unit normal up x right."""
        (a, b, c), (d, e, f) = self.up.tolist(), self.right.tolist()  # np.cross takes ten times as long
        normal = b * f - c * e, c * d - a * f, a * e - b * d
        return np.array(normal) / math.hypot(*normal)

    @property
    def corners(self) -> Array:
        """The corners, (4, 3)."""
        return self.center + _CORNERS @ (self.right, self.up)

    @property
    def inverse_axes(self) -> tuple[Array, Array]:
        """Vectors whose products with a point relative to the center are its coordinates, in [-1, 1] on the panel."""
        return self.right / (self.right @ self.right), self.up / (self.up @ self.up)


class Scene(NamedTuple):
    """One frame. `panels` are visible, `casters` throw shadows on the ground."""

    road: Road
    view: View
    light: Light
    panels: list[Panel]
    casters: list[Panel]


class Body(NamedTuple):
    """A place on the ground; local x runs across a body, local z towards its front."""

    x: float
    z: float
    tangent: float = 0.0  # of the angle between local and world z
    sign: float = 1.0  # -1 if the front faces the camera

    def panel(self, center: tuple, right: tuple, up: tuple, paint: Paint) -> Panel:
        """Return a panel given in local coordinates (x, y, z)."""
        cosine = self.sign / math.sqrt(1 + self.tangent**2)
        turn = np.array([[cosine, 0, -cosine * self.tangent], [0, 1, 0], [cosine * self.tangent, 0, cosine]])
        position = np.array(center) @ turn + (self.x, 0, self.z)
        return Panel(position, np.array(right) @ turn, np.array(up) @ turn, paint)

    def upright(self, half_width: float, height: float, paint: Paint) -> Panel:
        """Return a panel across the body."""
        return self.panel((0, height / 2, 0), (half_width, 0, 0), (0, height / 2, 0), paint)

    def box(self, size: tuple, paints: tuple[Paint, ...], *, foot: float = 0.0, inset: float = 0.0) -> list[Panel]:
        """Return the faces of a box of (half width, height, half length) whose rear and front lean in by `inset`.

        Args:
            size: m, as are `foot`, the height of the bottom, and `inset`.
            paints: of both sides, rear, front and top.
        """
        w, h, length, lean = size[0], size[1] / 2, size[2], inset / 2
        faces: tuple[tuple, ...] = (
            ((-w, foot + h, 0), (0, 0, -length), (0, h, 0)),
            ((w, foot + h, 0), (0, 0, length), (0, h, 0)),
            ((0, foot + h, lean - length), (w, 0, 0), (0, h, lean)),
            ((0, foot + h, length - lean), (-w, 0, 0), (0, h, -lean)),
            ((0, foot + 2 * h, 0), (w, 0, 0), (0, 0, length - inset)),
        )
        return [self.panel(*face, paint) for face, paint in zip(faces, paints[:1] + paints, strict=True)]


def noise(x: Array, y: Array | float) -> Array:
    """Return smooth value noise in [-1, 1] with unit cells and period 256."""
    column, row = np.floor(x), np.floor(y)
    x, y = x - column, y - row
    x, y = x * x * (3 - 2 * x), y * y * (3 - 2 * y)
    left, top = column.astype(np.int32) & (_TILE - 1), (row.astype(np.int32) & (_TILE - 1)) * _TILE
    right, bottom = (left + 1) & (_TILE - 1), (top + _TILE) & (_TILE**2 - 1)
    upper, lower = _NOISE[top + left], _NOISE[bottom + left]
    upper, lower = upper + (_NOISE[top + right] - upper) * x, lower + (_NOISE[bottom + right] - lower) * x
    return upper + (lower - upper) * y


def scale_color(color: Color, factor: Array) -> Array:
    """Multiply a color (3,) or colors (K, 3) by factors (K,)."""
    return np.asarray(color, np.float32) * factor[..., None]


def textured(color: Color, seed: float, scale: float) -> Paint:
    """Paint a solid surface with noise of `scale` cells a meter."""
    return lambda u, v: (scale_color(color, 1 + 0.2 * noise(u * scale + seed * 256, v * scale)), v >= 0)


def _skyline(color: Color, seed: float, height: float, octaves: dict[float, float], u: Array, v: Array) -> Painted:
    """Paint hills or bush below a skyline of noise; `octaves` has the amplitude of each cell size, both in heights."""
    top = 0.5 + sum(size * noise(u / height / cell + seed * 256, 77 * cell) for cell, size in octaves.items())
    texture = noise(u * 4 / height + seed * 256, v * 6 / height)
    return scale_color(color, 1 + 0.3 * texture), v < height * np.clip(top, 0.1, 1)


def _crown(color: Color, seed: float, half_width: float, half_height: float, u: Array, v: Array) -> Painted:
    """Paint leaves in an ellipse whose rim breaks up."""
    depth = np.sqrt(np.clip(1 - (u / half_width) ** 2 - (v / half_height - 1) ** 2, 0, None))
    x, y = u + seed * 256, v * (0.6 + 0.4 * half_width / half_height)
    leaf = noise(x * 2.2, y * 2.2) + 0.7 * noise(x * 7.5, y * 7.5)
    return scale_color(color, (1.1 + 0.6 * leaf) * (0.65 + 0.35 * v / half_height)), depth > 0.4 + 0.35 * leaf


def _pole(height: float, u: Array, v: Array) -> Painted:
    """Paint a mast with an arm for wires."""
    return scale_color(_BARK, 1 + 0.25 * noise(u * 9, v)), (np.abs(u) < 0.13) | (np.abs(height - v - 0.6) < 0.09)


def _wall(color: Color, roof: Color, seed: float, height: float, u: Array, v: Array) -> Painted:
    """Paint a wall with a row of framed windows in each storey, a plinth and the edge of the roof."""
    along, storey = u / (2.4 + seed) + 100.5, np.abs(v % 2.9 - 1.5)
    middle = np.abs(along - np.floor(along) - 0.5)
    frame = (middle < 0.29) & (storey < 0.65) & (v < height - 0.6)
    albedo = scale_color(color, np.where(v < 0.35, 0.6, 1 + 0.08 * noise(u + seed * 256, v)))
    albedo[frame], albedo[frame & (np.abs(middle - 0.135) < 0.115) & (storey < 0.55)] = (0.62, 0.6, 0.56), _GLASS
    albedo[v > height - 0.45] = roof
    return albedo, v >= 0


def _hull(color: Color, half_width: float, height: float, lamps: Color | None, u: Array, v: Array) -> Painted:
    """Paint the lower part of a vehicle: a side with wheels or, with the color of its lamps, an end."""
    albedo = scale_color(color, np.ones_like(u))
    wheel = np.hypot(np.abs(u) - 0.62 * half_width, v - _WHEEL) if lamps is None else np.full_like(u, np.inf)
    albedo[(v < 0.42) | (wheel < 0.41)], albedo[wheel < 0.21] = _DARK, (0.3, 0.3, 0.31)
    if lamps is not None:
        albedo[(np.abs(np.abs(u) / half_width - 0.8) < 0.15) & (np.abs(v / height - 0.71) < 0.14)] = lamps
    return albedo, (v > 0.24) | (wheel < _WHEEL)


def _cabin(color: Color, half_width: float, height: float, inset: float, u: Array, v: Array) -> Painted:
    """Paint a trapezoid whose ends lean in by `inset` at the top, with a window."""
    end, albedo = half_width - inset * v / height, scale_color(color, np.ones_like(u))
    albedo[(np.abs(v / height - 0.48) < 0.38) & (np.abs(u) < end - 0.08)] = _GLASS
    return albedo, np.abs(u) < end


def _bonnet(color: Color, half_width: float, length: float, bend: float, power: float, u: Array, v: Array) -> Painted:
    """Paint a bonnet whose front recedes by `bend` of its length at the sides; its front and two creases shine."""
    x, along = np.abs(u) / half_width, v / length
    gloss = 0.3 * along**4 + 0.25 * np.exp(-(((x - 0.4 - 0.2 * along**2) / 0.03) ** 2))
    albedo = scale_color(color, 1 + 0.3 * noise(u * 3, v * 3)) + scale_color((0.5, 0.55, 0.6), gloss)
    return albedo, along < 1 - bend * x**power


def draw_scene(random: np.random.Generator) -> Scene:
    """Draw a scene."""
    road, light = Road(random), Light(random)
    view = _draw_view(random, road)
    objects = [*_buildings(random, road), *_poles(random, road), *_vehicles(random, road), *_trees(random, road)]
    return Scene(road, view, light, [*_horizon(random), *objects, *_ego_car(random, view)], objects)


def _draw_view(random: np.random.Generator, road: Road) -> View:
    """Draw a dashcam in the left lane."""
    position = random.uniform(-0.5, 0.5) - road.lane / 2, random.uniform(1.2, 1.7), 0.0
    (sy, cy), (sp, cp) = (
        (math.sin(a), math.cos(a)) for a in (random.uniform(-0.07, 0.07), random.uniform(-0.06, 0.06))
    )
    axes = np.array([(cy, 0, -sy), (-sy * sp, -cp, -cy * sp), (sy * cp, -sp, cy * cp)])
    return View(np.array(position), axes, random.uniform(0.55, 0.85))


def _horizon(random: np.random.Generator) -> list[Panel]:
    """Draw mountains, hills, and a line of bush on each side."""
    mountains, bush = {3.3: 0.5, 1.0: 0.25, 0.22: 0.07}, {3.0: 0.3, 0.5: 0.15}
    panels = []
    for x, z, half_width, height, color, octaves in (
        (0, random.uniform(5000, 9000), 15000, random.uniform(80, 490), np.array(_WALLS[2]) * 0.4 + 0.09, mountains),
        (0, random.uniform(1600, 3000), 5000, random.uniform(13, 80), random.choice(_LEAVES) * 0.4 + 0.09, mountains),
        (-306, random.uniform(110, 320), 300, random.uniform(3, 7), random.choice(_LEAVES) * 0.8, bush),
        (306, random.uniform(110, 320), 300, random.uniform(3, 7), random.choice(_LEAVES) * 0.8, bush),
    ):
        panels.append(
            Body(x, z).upright(half_width, height, partial(_skyline, color, random.random(), height, octaves))
        )
    return panels


def _buildings(random: np.random.Generator, road: Road) -> list[Panel]:
    """Draw houses, and apartment blocks farther away."""
    panels = []
    for i, z in enumerate((17, 24, 40, 47, 68, 75, 150, 220)):
        is_block = i >= 6
        if random.random() > (0.85 if road.is_town else 0.12):
            continue
        half_width, half_length = random.uniform(3.5, 5.5) * (1 + is_block), random.uniform(3, 4.5) * (1 + is_block)
        height, seed = 3.1 + 2.9 * (random.integers(2, 7) if is_block else random.integers(0, 2)), random.random()
        offset = road.half_width + random.uniform(6, 12) + half_width + 25 * is_block
        body, roof = road.place((2 * (i % 2) - 1) * offset, z + random.uniform(-4, 4)), random.choice(_ROOFS)
        wall = partial(_wall, random.choice(_WALLS), roof, seed, height)
        paints = wall, wall, wall, textured(roof, seed, 0.7)
        panels += body.box((half_width, height, half_length), paints)
    return panels


def _poles(random: np.random.Generator, road: Road) -> list[Panel]:
    """Draw a row of power poles on one side."""
    if random.random() > 0.75:
        return []
    side, height = random.choice([-1, 1]), random.uniform(7.2, 9.6)
    offset = side * (road.half_width + random.uniform(2.9, 6.9))
    places = random.uniform(9, 24) + random.uniform(24, 45) * np.arange(5)
    return [road.place(offset, z).upright(1.1, height, partial(_pole, height)) for z in places]


def _trees(random: np.random.Generator, road: Road) -> list[Panel]:
    """Draw trees and bushes, turned to the camera."""
    panels = []
    for i, near in enumerate((10, 16, 26, 38, 52, 70, 95, 9, 13, 18, 25, 34, 46)):
        is_bush = i >= 7
        if random.random() > 0.75 - 0.3 * road.is_town:
            continue
        width = random.uniform(1.5, 2.8) * (0.35 if is_bush else 1.0)
        height = width * random.uniform(0.5, 1.2)
        foot = -0.3 * height if is_bush else random.uniform(1.4, 3.2)
        offset = random.choice([-1, 1]) * (road.half_width + 1.2 + width + random.random() * random.uniform(2, 16))
        z, seed = near * random.uniform(0.8, 1.25), random.random()
        x, leaves = float(road.center(z)) + offset, partial(_crown, random.choice(_LEAVES), seed, width, height)
        body = Body(x, z, x / z)
        panels.append(body.panel((0, foot + height, -0.1), (width, 0, 0), (0, height, 0), leaves))
        if not is_bush:
            panels.append(body.upright(0.13, foot + 0.6 * height, textured(_BARK, seed, 5.0)))
    return panels


def _vehicles(random: np.random.Generator, road: Road) -> list[Panel]:
    """Draw up to two vehicles ahead and two oncoming; traffic keeps left."""
    panels = []
    for sign, nearest, farthest in ((1, 9, 20), (1, 30, 70), (-1, 9, 26), (-1, 36, 90)):
        width, length, belt, roof, cabin, inset = _MODELS[random.integers(len(_MODELS))]
        offset, color = random.uniform(-0.25, 0.25) - sign * road.lane / 2, random.choice(_CARS)
        body = road.place(offset, random.uniform(nearest, farthest) + length / 2, sign=sign)
        if random.random() > 0.42:
            continue
        top, side = textured(color, 0.0, 0.0), partial(_hull, color, length / 2, belt, None)
        rear, front = (partial(_hull, color, width / 2, belt, lamps) for lamps in (_RED_LAMPS, _WHITE_LAMPS))
        panels += body.box((width / 2, belt, length / 2), (side, rear, front, top))
        height, half_width = roof - belt, width * 0.46
        side = partial(_cabin, color, cabin / 2, height, inset)
        end = partial(_cabin, color, half_width, math.hypot(height, inset), 0.0)
        panels += body.box((half_width, height, cabin / 2), (side, end, end, top), foot=belt, inset=inset)
    return panels


def _ego_car(random: np.random.Generator, view: View) -> list[Panel]:
    """Draw in half of the scenes the bonnet below the camera, which covers up to a fifth of a frame of 16:9."""
    down, ahead = np.array([0.52, random.uniform(0.6, 0.92) * 9 / 32]) / view.focal, (0.7, random.uniform(0.9, 2.0))
    half_width = random.uniform(0.35, 0.7) * ahead[1] / view.focal
    bend, power = random.uniform(0.25, 1) ** 2, random.uniform(2, 5)
    if random.random() > 0.5:
        return []
    rear, front = (view.position + z * (view.axes[2] + y * view.axes[1]) for y, z in zip(down, ahead, strict=True))
    right, up, offset = half_width * view.axes[0], (front - rear) / 2, random.uniform(-0.15, 0.15)
    paint = partial(_bonnet, random.choice(_CARS), half_width, 2 * math.hypot(*up), bend, power)
    return [Panel((rear + front) / 2 + offset * right, right, up, paint)]
