"""Layout of a road scene: road, camera, light and objects, drawn from a random generator.

World axes: x right, y up, z ahead, m. The ground is y = 0. The camera stands at (x, height, 0). Colors are linear.
"""

import math
from typing import NamedTuple

import numpy as np

from torchrefract.data.road_scenes import paint
from torchrefract.data.road_scenes.paint import Array, Color, Paint

_WALLS = ((0.6, 0.56, 0.48), (0.55, 0.42, 0.25), (0.42, 0.2, 0.12), (0.3, 0.42, 0.45), (0.66, 0.64, 0.6))
_ROOFS = ((0.32, 0.08, 0.05), (0.33, 0.34, 0.35), (0.09, 0.17, 0.11), (0.3, 0.15, 0.08))
_LEAVES = ((0.08, 0.14, 0.035), (0.12, 0.17, 0.05), (0.14, 0.15, 0.06), (0.06, 0.1, 0.035), (0.2, 0.18, 0.08))
_CARS = ((0.72, 0.72, 0.7), (0.72, 0.72, 0.7), (0.4, 0.41, 0.42), (0.05, 0.05, 0.055), (0.4, 0.03, 0.03))
_CARS += ((0.05, 0.1, 0.28), (0.5, 0.38, 0.1), (0.12, 0.2, 0.13))
# Width, length, heights of the belt line and the roof, length and shift of the cabin, slope of its windows.
_MODELS = (
    (1.75, 4.1, 0.95, 1.48, 2.7, -0.3, 1.1),  # hatchback
    (1.8, 4.6, 0.92, 1.45, 2.6, -0.2, 1.6),  # sedan
    (1.85, 5.0, 1.0, 1.72, 2.4, 0.3, 0.8),  # pickup
    (1.8, 4.8, 1.05, 2.05, 4.5, -0.1, 0.35),  # minibus
    (2.4, 8.0, 1.15, 3.5, 7.9, 0.0, 0.0),  # truck
)


class Road(NamedTuple):
    """A road and its verges.

    curve in 1/m, lane (its width), half_width and crossing (z of a pedestrian crossing) in m; green_grass and red_soil
    in [0, 1]; asphalt: albedo; shift: of the texture of ground and clouds.
    """

    curve: float
    lane: float
    half_width: float
    is_paved: bool
    is_town: bool
    has_solid_line: bool
    has_edge_lines: bool
    crossing: float | None
    green_grass: float
    red_soil: float
    asphalt: float
    shift: tuple[float, float]

    def center(self, z: Array | float) -> Array | float:
        """Return x of the center line: curve z^2 / (2 + z / 300), a parabola that straightens far away."""
        return self.curve * z * z / (2 + z / 300)

    def slope(self, z: Array | float) -> Array | float:
        """Return dx/dz of the center line."""
        return self.curve * z * (4 + z / 300) / (2 + z / 300) ** 2


class View(NamedTuple):
    """A pinhole camera: position (3,), axes right, down, ahead as rows (3, 3), focal length in longer image sides."""

    position: Array
    axes: Array
    focal: float


class Light(NamedTuple):
    """The direction to the sun (3,), colors (3,), and the density of clouds."""

    sun: Array
    beam: Array
    ambient: Array
    zenith: Array
    horizon: Array
    clouds: float


class Panel(NamedTuple):
    """A flat rectangle.

    center: (3,). right, up: (3,), from the center to the middle of those edges. paint: see `paint`. is_round: shade it
    like an ellipsoid. is_one_sided: only the side of the normal shows, as of a closed body.
    """

    center: Array
    right: Array
    up: Array
    paint: Paint
    is_round: bool = False
    is_one_sided: bool = False

    @property
    def normal(self) -> Array:
        """The unit normal up x right."""
        (a, b, c), (d, e, f) = self.up.tolist(), self.right.tolist()
        normal = b * f - c * e, c * d - a * f, a * e - b * d
        return np.array(normal) / math.hypot(*normal)

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

    def panel(self, center: tuple, right: tuple, up: tuple, paint: Paint, *, is_one_sided: bool = False) -> Panel:
        """Return a panel given in local coordinates (x, y, z)."""
        cosine = self.sign / math.sqrt(1 + self.tangent**2)
        turn = np.array([[cosine, 0, -cosine * self.tangent], [0, 1, 0], [cosine * self.tangent, 0, cosine]])
        position = np.array(center) @ turn + (self.x, 0, self.z)
        return Panel(position, np.array(right) @ turn, np.array(up) @ turn, paint, is_one_sided=is_one_sided)

    def upright(self, half_width: float, height: float, paint: Paint) -> Panel:
        """Return a panel across the body."""
        return self.panel((0, height / 2, 0), (half_width, 0, 0), (0, height / 2, 0), paint)

    def prism(
        self, size: tuple, side: Paint, rear: Paint, front: Paint, top: Paint, *, foot: float = 0.0, inset: float = 0.0
    ) -> list[Panel]:
        """Return a box whose two ends lean in.

        Args:
            size: half width, height, half length, m.
            side, rear, front, top: paints of the faces.
            foot: height of the bottom, m.
            inset: distance by which the upper edges of both ends lean in, m.
        """
        w, h, length = size[0], size[1] / 2, size[2]
        faces: list[tuple] = [((x, foot + h, 0), (0, 0, math.copysign(length, x)), (0, h, 0), side) for x in (-w, w)]
        for z, end in ((-1, rear), (1, front)):
            faces.append(((0, foot + h, z * (length - inset / 2)), (-z * w, 0, 0), (0, h, -z * inset / 2), end))
        if inset < length:
            faces.append(((0, foot + 2 * h, 0), (w, 0, 0), (0, 0, length - inset), top))
        return [self.panel(*face, is_one_sided=True) for face in faces]


def draw_scene(random: np.random.Generator) -> Scene:
    """Draw a scene."""
    road, light = _draw_road(random), _draw_light(random)
    view = _draw_view(random, road)
    crowns, trunks, crown_shadows = _trees(random, road, view, light)
    solid = [*_buildings(random, road), *_barriers(random, road), *_poles(random, road), *_vehicles(random, road)]
    panels = [*_horizon(random), *solid, *trunks, *crowns]
    return Scene(road, view, light, panels, [*solid, *trunks, *crown_shadows])


def _draw_road(random: np.random.Generator) -> Road:
    is_town = random.random() < 0.4
    is_paved = is_town or random.random() < 0.65
    lane = random.uniform(3.0, 3.7)
    return Road(
        curve=random.uniform(-1, 1) ** 3 / 160,
        lane=lane,
        half_width=lane + random.uniform(0.2, 1.2) * is_paved,
        is_paved=is_paved,
        is_town=is_town,
        has_solid_line=random.random() < 0.2,
        has_edge_lines=random.random() < 0.75,
        crossing=random.uniform(9, 30) if is_town and random.random() < 0.3 else None,
        green_grass=random.random(),
        red_soil=random.random(),
        asphalt=random.uniform(0.07, 0.2),
        shift=(random.uniform(0, 256), random.uniform(0, 256)),
    )


def _draw_view(random: np.random.Generator, road: Road) -> View:
    """Draw a dashcam in the left lane."""
    height = random.uniform(1.2, 1.55) + 0.8 * (random.random() < 0.15)
    position = random.uniform(-0.5, 0.5) - road.lane / 2, height, 0.0
    yaw, pitch, roll = random.uniform(-1, 1, 3) * (0.07, 0.06, 0.02)
    (sy, sp, sr), (cy, cp, cr) = np.sin((yaw, pitch, roll)), np.cos((yaw, pitch, roll))
    right = (cy * cr - sy * sp * sr, -cp * sr, -sy * cr - cy * sp * sr)
    down = (-cy * sr - sy * sp * cr, -cp * cr, sy * sr - cy * sp * cr)
    return View(np.array(position), np.array([right, down, (sy * cp, -sp, cy * cp)]), random.uniform(0.55, 0.85))


def _draw_light(random: np.random.Generator) -> Light:
    is_overcast, heading, elevation = random.random() < 0.22, random.uniform(-math.pi, math.pi), random.uniform(0.22, 1)
    elevation = 2.5 if is_overcast else elevation
    sun = np.array([math.sin(heading), elevation * 1.2, math.cos(heading)])
    warm, power = np.clip((0.65 - elevation) / 0.4, 0, 1), random.uniform(0.85, 1.25)

    def mix(clear: Color, golden: Color, gray: Color) -> Array:
        return power * np.array(gray if is_overcast else np.array(clear) * (1 - warm) + np.array(golden) * warm)

    return Light(
        sun=sun / np.linalg.norm(sun),
        beam=mix((1.15, 1.08, 0.95), (1.7, 0.98, 0.45), (0.3, 0.3, 0.3)),
        ambient=mix((0.3, 0.36, 0.46), (0.3, 0.3, 0.36), (0.58, 0.6, 0.63)),
        zenith=mix((0.09, 0.22, 0.56), (0.14, 0.24, 0.45), (0.45, 0.48, 0.53)),
        horizon=mix((0.52, 0.66, 0.82), (0.95, 0.68, 0.42), (0.72, 0.74, 0.77)),
        clouds=1.0 if is_overcast else random.uniform(-0.5, 0.55),
    )


def _place(road: Road, offset: float, z: float, turn: float = 0.0, sign: float = 1.0) -> Body:
    """Place a body at an offset from the center line, turned from the direction of the road."""
    return Body(float(road.center(z)) + offset, z, float(road.slope(z)) + turn, sign)


def _horizon(random: np.random.Generator) -> list[Panel]:
    """Draw mountains, hills, and a line of bush on each side."""
    panels = []
    for far, rise, colors in ((7000, 0.07, _WALLS[2:3]), (2300, 0.035, _LEAVES)):
        z, height = far * random.uniform(0.7, 1.3), far * random.uniform(rise / 6, rise)
        color = np.array(colors[random.integers(len(colors))]) * 0.4 + 0.09
        level = 0.75 if random.random() < 0.35 else 1.0
        ridge = paint.skyline(color, random.random(), height, {3.3: 0.5, 1.0: 0.25, 0.22: 0.07}, level)
        panels.append(Body(0, z).upright(1.7 * z, height, ridge))
    for side in (-1, 1):
        height, color = random.uniform(3, 7), np.array(_LEAVES[random.integers(len(_LEAVES))]) * 0.8
        bush = paint.skyline(color, random.random(), height, {3.0: 0.3, 0.5: 0.15}, 1.0)
        panels.append(Body(side * 306.0, random.uniform(110, 320)).upright(300, height, bush))
    return panels


def _buildings(random: np.random.Generator, road: Road) -> list[Panel]:
    """Draw houses with gable roofs or flat ones, and apartment blocks farther away."""
    panels = []
    for i, z in enumerate((17, 24, 40, 47, 68, 75, 150, 220)):
        is_block, scale = i >= 6, 1 + (i >= 6)
        if random.random() > (0.85 if road.is_town else 0.12):
            continue
        half_width, half_length = random.uniform(3.5, 5.5) * scale, random.uniform(3, 4.5) * scale
        is_flat, seed = is_block or random.random() < 0.35, random.random()
        wall = 2.6 + 2.9 * (random.integers(2, 7) if is_block else random.integers(0, 2) * is_flat)
        offset, turn = road.half_width + random.uniform(6, 12) + half_width + 25 * is_block, random.uniform(-0.1, 0.1)
        body = _place(road, (2 * (i % 2) - 1) * offset, z + random.uniform(-4, 4), turn)
        color, roof = (colors[random.integers(len(colors))] for colors in (_WALLS, _ROOFS))
        rise, roof = 0.5 if is_flat else random.uniform(1, 2.2), paint.textured(roof, seed, 0.7)
        side = paint.building(color, seed, wall, (0, 1) if is_flat else (rise, half_length))
        end = paint.building(color, seed, wall)
        panels += body.prism((half_width, wall + rise * is_flat, half_length), end, end, end, roof)
        if not is_flat:
            size = (half_width, rise, half_length)
            panels += body.prism((half_width, wall + rise, half_length), side, end, end, roof)[:2]
            panels += body.prism(size, end, roof, roof, roof, foot=wall, inset=half_length)[2:]
    return panels


def _barriers(random: np.random.Generator, road: Road) -> list[Panel]:
    """Draw walls in a town, crash barriers and wire fences in the country."""
    panels, wood = [], (0.25, 0.21, 0.17)
    kinds = (
        (0.6 * road.is_town, 4.2, random.uniform(1.4, 2), paint.textured(_WALLS[0], random.random(), 1.0)),
        (0.3 * (not road.is_town), 3.0, 0.76, paint.barrier((0.42, 0.43, 0.44), (0.59,), 0.32, 2.5)),
        (0.6 * (not road.is_town), 7.0, 1.26, paint.barrier(wood, (0.21, 0.63, 1.05), 0.026, 3.0)),
    )
    for chance, offset, height, board in kinds:
        for side in (-1, 1):
            if random.random() < chance:
                half_length = random.uniform(8, 18)
                body = _place(road, side * (road.half_width + offset), random.uniform(5, 14) + half_length)
                panels.append(body.panel((0, height / 2, 0), (0, 0, half_length), (0, height / 2, 0), board))
    return panels


def _poles(random: np.random.Generator, road: Road) -> list[Panel]:
    """Draw a row of power poles or of street lamps on one side."""
    if random.random() > 0.75:
        return []
    side, is_lamp, height = random.choice([-1, 1]), random.random() < 0.7 * road.is_town, random.uniform(7.2, 9.6)
    offset = side * (road.half_width + 2.9 + (not is_lamp) * random.uniform(0.5, 4))
    board = paint.pole((0.4, 0.41, 0.42) if is_lamp else (0.16, 0.11, 0.08), height, is_lamp)
    places = random.uniform(9, 24) + random.uniform(24, 45) * np.arange(5)
    # The arm of a lamp reaches towards the road.
    return [_place(road, offset, z).upright(-side * (1.1 + 0.5 * is_lamp), height, board) for z in places]


def _trees(random: np.random.Generator, road: Road, view: View, light: Light) -> tuple[list[Panel], ...]:
    """Draw trees and bushes: crowns that face the camera, trunks, and crowns that face the sun, for shadows."""
    crowns, trunks, shadows, is_umbrella = [], [], [], random.random() < 0.5
    for i, near in enumerate((10, 16, 26, 38, 52, 70, 95, 9, 13, 18, 25, 34, 46)):
        is_bush = i >= 7
        if random.random() > 0.75 - 0.3 * road.is_town:
            continue
        width = random.uniform(1.5, 2.8) * (0.35 if is_bush else 1.4 if is_umbrella else 1.0)
        height = width * (random.uniform(0.75, 1.2) - 0.45 * (is_umbrella and not is_bush))
        foot = -0.3 * height if is_bush else random.uniform(1.4, 2.6) + is_umbrella
        offset = random.choice([-1, 1]) * (road.half_width + 1.2 + width + random.random() * random.uniform(2, 16))
        z, seed = near * random.uniform(0.8, 1.25), random.random()
        x, leaves = float(road.center(z)) + offset, paint.crown(_LEAVES[random.integers(5)], seed, width, height)
        center = np.array([x, foot + height, z])
        crowns.append(_facing(center, view.position - center, width, height, leaves))
        shadows.append(_facing(center, light.sun, width, height, leaves))
        if not is_bush:
            trunks.append(
                Body(x, z, x / z).upright(0.13, foot + 0.6 * height, paint.textured((0.15, 0.11, 0.08), seed, 5.0))
            )
    return crowns, trunks, shadows


def _facing(center: Array, direction: Array, half_width: float, half_height: float, board: Paint) -> Panel:
    """Return a round panel whose normal is a direction."""
    right = np.cross(direction, (0, 1, 0))
    up = np.cross(right, direction)
    right, up = right / np.linalg.norm(right), up / np.linalg.norm(up)
    return Panel(center, right * half_width, up * half_height, board, is_round=True)


def _vehicles(random: np.random.Generator, road: Road) -> list[Panel]:
    """Draw two vehicles ahead, two oncoming (traffic keeps left) and one parked."""
    panels, parked = [], road.half_width - road.lane / 2 + 1.3
    nearest, farthest = np.array((9, 30, 9, 36, 10)), np.array((20, 70, 26, 90, 30))
    for i, sign in enumerate((1, 1, -1, -1, 1)):
        width, length, belt, roof, cabin, ahead, slope = _MODELS[random.integers(len(_MODELS))]
        offset = -sign * (road.lane / 2 + parked * (i == 4)) + random.uniform(-0.25, 0.25)
        body = _place(road, offset, random.uniform(nearest[i], farthest[i]) + length / 2, sign=sign)
        color = _CARS[random.integers(len(_CARS))]
        if random.random() > (0.3 if i == 4 else 0.42):
            continue
        top = paint.textured(color, 0.0, 0.0)
        rear, front = (paint.hull_end(color, width / 2, belt, is_front) for is_front in (False, True))
        panels += body.prism((width / 2, belt, length / 2), paint.hull_side(color, length / 2), rear, front, top)
        height, half_width, inset = roof - belt, width * 0.46, min(slope * (roof - belt), 0.45 * cabin)
        windows = ((0.1, 0.86), (0.1, 0.86), (0.06, 0.9)) if slope else ((0, 0), (0, 0), (0.05, 0.36))
        side = paint.cabin(color, cabin / 2, height, inset, windows[0])
        rear, front = (paint.cabin(color, half_width, math.hypot(height, inset), 0.0, w) for w in windows[1:])
        body = body._replace(x=body.x + ahead * sign * body.tangent, z=body.z + ahead * sign)
        panels += body.prism((half_width, height, cabin / 2), side, rear, front, top, foot=belt, inset=inset)
    return panels
