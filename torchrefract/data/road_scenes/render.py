"""Rendering of a road scene: sky and ground in closed form, then panels with a depth buffer.

Each pixel is sampled by five rays. A ray's direction has length 1 along the camera's axis, so that its parameter is
the depth. The product of a fixed vector and the direction is linear in the pixel's column and row.
"""

import math

import numpy as np

from torchrefract.data.road_scenes.paint import Array, Color, noise
from torchrefract.data.road_scenes.scene import Light, Panel, Road, Scene, View

Window = tuple[slice, slice, slice]  # rays, rows, columns

# Position of each ray in its pixel, (right, down), px from the center, on distinct rows and columns.
_OFFSETS = np.array([(0.0, 0.0), (-0.15, -0.4), (0.4, -0.15), (0.15, 0.4), (-0.4, 0.15)])
_NEAR, _FAR = 0.2, 3e4  # m
_CLOUD_HEIGHT, _CLOUD_SCALE = 900.0, 170.0  # m; size of clouds in multiples of the texture of the ground
_HAZE = 9000.0  # m, the distance at which contrast is one half
_UNIT = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])


class Camera:
    """The rays of a view in an image of (height, width) px."""

    def __init__(self, view: View, height: int, width: int):
        self.position, self.axes, self.size = view.position, view.axes, (height, width)
        self.scale = view.focal * max(height, width)
        across, down = _OFFSETS.T[..., None]
        self._x = ((np.arange(width) + 0.5 - width / 2 + across) / self.scale)[:, None, :].astype(np.float32)
        self._y = ((np.arange(height) + 0.5 - height / 2 + down) / self.scale)[:, :, None].astype(np.float32)
        self.frame: Window = (slice(None), slice(0, height), slice(0, width))

    def dot(self, vector: Array, window: Window) -> Array:
        """Return the products of a vector and the directions of rays, (5, h, w)."""
        right, down, ahead = (self.axes @ vector).astype(np.float32)
        return (right * self._x[:, :, window[2]] + ahead) + down * self._y[:, window[1]]

    def window(self, points: Array) -> Window | None:
        """Return the part of the frame that the convex hull of points (K, 3) may cover; None if it is outside."""
        right, down, ahead = self.axes @ (points - self.position).T
        if (ahead < _NEAR).any():  # the projection of a hull that reaches behind the camera has no bounds
            return None if (ahead < _NEAR).all() else self.frame
        slices = [slice(None)]
        for value, limit in zip((down, right), self.size, strict=True):
            place = value / ahead * self.scale + limit / 2
            slices.append(slice(max(int(place.min() - 1), 0), min(int(place.max() + 2), limit)))
        is_visible = all(part.start < part.stop for part in slices[1:])
        return (slices[0], slices[1], slices[2]) if is_visible else None


def render(scene: Scene, height: int, width: int) -> tuple[Array, Array]:
    """Render a scene.

    Returns:
        image: (H, W, 3), float32, in [0, 1]; the mean of five rays.
        depth: (H, W), float32, m along the camera's axis of the ray through the pixel's center; inf for the sky.
    """
    camera = Camera(scene.view, height, width)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        drop = -camera.dot(np.array([0.0, 1.0, 0.0]), camera.frame)
        depth = np.where(drop > 0, np.float32(camera.position[1]) / drop, np.float32(np.inf))
        is_shaded = np.zeros(depth.shape, dtype=bool)
        for panel in scene.casters:
            _cast_shadow(panel, camera, scene.light.sun, depth, is_shaded)
        lit, dim = _backdrop(scene, camera)
        color = np.where(is_shaded[..., None], dim, lit)
        for panel in scene.panels:
            _draw_panel(panel, camera, scene.light, color, depth)
    return np.clip(color.mean(axis=0), 0, 1), depth[0]


def _draw_panel(panel: Panel, camera: Camera, light: Light, color: Array, depth: Array) -> None:
    """Draw a panel where it is nearer than `depth`; changes `color` and `depth`."""
    normal = panel.normal
    distance = float(normal @ (panel.center - camera.position))
    window = camera.window(panel.center + _UNIT @ (panel.right, panel.up))
    if window is None or (panel.is_one_sided and distance >= 0):
        return
    t = np.float32(distance) / camera.dot(normal, window)
    rays, u, v, albedo = _meet(panel, camera, window, t, (t > _NEAR) & (t < depth[window]))
    t, facing = t[rays], -math.copysign(1, distance) * normal
    if panel.is_round:
        bulge = np.sqrt(np.clip(1 - u * u - v * v, 0, 1))
        facing = np.stack([u, v, bulge], axis=1) @ np.stack([panel.right, panel.up, facing * math.hypot(*panel.up)])
        facing /= np.sqrt((facing * facing).sum(axis=1, keepdims=True))
    sunlight = np.clip(facing @ light.sun, 0, None)[..., None] * light.beam
    shaded = albedo * (light.ambient * (0.75 + 0.25 * facing[..., 1:2]) + sunlight)
    color[window][rays] = _tone(_blend(shaded, light.horizon * 0.9, t / (t + _HAZE)))
    depth[window][rays] = t


def _cast_shadow(panel: Panel, camera: Camera, sun: Array, depth: Array, is_shaded: Array) -> None:
    """Mark the rays that meet the ground where the panel hides the sun; changes `is_shaded`."""
    normal, corners = panel.normal, panel.center + _UNIT @ (panel.right, panel.up)
    window = camera.window(corners - np.outer(corners[:, 1], sun / sun[1]))
    if window is None or (panel.is_one_sided and normal @ sun <= 0):
        return
    ground, start = depth[window], np.float32(normal @ (camera.position - panel.center))
    t = -(start + ground * camera.dot(normal, window)) / np.float32(normal @ sun)
    is_shaded[window][_meet(panel, camera, window, ground, (t > -0.3) & np.isfinite(ground), (sun, t))[0]] = True


def _meet(
    panel: Panel, camera: Camera, window: Window, depth: Array, mask: Array, beyond: tuple[Array, Array] | None = None
) -> tuple[tuple[Array, ...], Array, Array, Array]:
    """Return the rays that meet a solid part of a panel.

    Args:
        panel, camera, window: the rays are those of the camera in the window.
        depth: (5, h, w), where a ray meets the plane of the panel, or where it turns.
        mask: (5, h, w), bool, rays to consider.
        beyond: direction (3,) of rays that turn, and the length (5, h, w) from there to the plane of the panel.

    Returns:
        index of the rays in the window, coordinates u and v (K,) in [-1, 1], albedo (K, 3).
    """
    u, v = (
        np.float32(axis @ (camera.position - panel.center)) + depth * camera.dot(axis, window)
        for axis in panel.inverse_axes
    )
    if beyond is not None:
        u, v = (
            value + beyond[1] * np.float32(axis @ beyond[0])
            for value, axis in zip((u, v), panel.inverse_axes, strict=True)
        )
    rays = np.nonzero(mask & (np.abs(u) <= 1) & (np.abs(v) <= 1))
    u, v = u[rays], v[rays]
    albedo, solid = panel.paint(u * math.hypot(*panel.right), (v + 1) * math.hypot(*panel.up))
    return tuple(index[solid] for index in rays), u[solid], v[solid], albedo[solid]


def _backdrop(scene: Scene, camera: Camera) -> tuple[Array, Array]:
    """Return ground and sky, (H, W, 3), in the sun and in the shade.

    Texture, lines and edges are averaged over the pixel's footprint, so that one ray a pixel is enough.
    """
    road, light = scene.road, scene.light
    x, y, z = (camera.dot(axis, camera.frame)[0] for axis in np.eye(3))
    is_ground = y < 0
    drop = np.where(is_ground, camera.position[1], _CLOUD_HEIGHT - camera.position[1]).astype(np.float32)
    depth = np.minimum(drop / np.abs(y), _FAR)
    across = depth / camera.scale
    along = across * depth / drop
    plane = camera.position[0] + depth * x, depth * z
    size = np.where(is_ground, 1, _CLOUD_SCALE).astype(np.float32)
    footprint = np.maximum(across, 0.5 * along) / size
    # Noise of four cell sizes, each faded out where a pixel covers more than about one cell.
    grain = np.stack(
        [
            noise(plane[0] / size / cell + road.shift[0], plane[1] / size / cell + road.shift[1])
            / (1 + (footprint / cell) ** 2)
            for cell in (0.035, 0.2, 1.3, 8.0)
        ]
    )
    lit = np.empty((*y.shape, 3), np.float32)
    lit[~is_ground] = _tone(_sky(light, np.stack([x, y, z])[:, ~is_ground], grain[:, ~is_ground]))
    dim, (x, z) = lit.copy(), (axis[is_ground] for axis in plane)
    across, along = across[is_ground], along[is_ground]
    # A pixel's rows run ahead: they cross a line next to the camera at a slant.
    across += along * np.abs((x - camera.position[0]) / np.maximum(z, 1) - road.slope(z))
    albedo, haze = _ground(road, x, z, across, along, grain[:, is_ground]), z / (z + _HAZE)
    for image, share in ((lit, 1.0), (dim, 0.15)):
        shaded = albedo * (light.ambient * 0.95 + light.beam * (light.sun[1] * share))
        image[is_ground] = _tone(_blend(shaded, light.horizon * 0.9, haze))
    return lit, dim


def _ground(road: Road, x: Array, z: Array, across: Array, along: Array, grain: Array) -> Array:
    """Return the albedo of the ground (K, 3): verge, shoulder or pavement, road, road paint."""
    fine, small, middle, coarse = grain
    side = x - road.center(z)
    distance, is_rural, is_gravel = np.abs(side), 1 - road.is_town, 1 - road.is_paved
    soil = _mix((0.4, 0.3, 0.18), (0.42, 0.17, 0.08), road.red_soil)
    grass = _mix((0.42, 0.33, 0.13), (0.13, 0.2, 0.05), road.green_grass)
    shade, ragged = 0.3 * fine + 0.2 * small, (middle + 0.4 * small) * is_rural
    tuft = np.clip(0.62 + coarse + 0.6 * middle + 0.5 * small + 0.3 * fine, 0, 1)
    albedo = _blend(_times(soil, 1 + shade), _times(grass, 1 + 1.3 * shade + 0.25 * middle), tuft)
    strip = (0.36, 0.35, 0.33) if road.is_town else np.multiply(soil, 0.95)
    edge = road.half_width + road.is_paved * 1.1 + 0.9 * road.is_town + 0.3 * ragged - distance
    albedo = _blend(albedo, _times(strip, 1 + shade), _coverage(edge, across))
    albedo = _blend(albedo, (0.5, 0.49, 0.46), band(distance - road.half_width - 0.1, 0.22, across) * road.is_town)
    track = np.clip(1 - np.abs(np.abs(distance - road.lane / 2) - 0.8) / 0.5, 0, None)  # of wheels
    gravel = _mix((0.42, 0.33, 0.22), (0.44, 0.22, 0.12), road.red_soil)
    surface = (road.asphalt,) * 3 if road.is_paved else gravel
    tone = (
        1 + 0.35 * fine + (0.1 + 0.2 * is_gravel) * (small + middle) + 0.1 * coarse + (0.32 * is_gravel - 0.14) * track
    )
    edge = road.half_width + (0.06 + 0.3 * is_gravel) * ragged - distance
    albedo = _blend(albedo, _times(surface, tone), _coverage(edge, across))
    if road.is_paved:
        worn = np.clip(0.85 + 0.2 * fine + 0.2 * small + 0.15 * coarse, 0, 1)
        white = band(side, 0.14, across) * (1 if road.has_solid_line else dashes(z + road.shift[0], 9.0, 4.0, along))
        if road.crossing is not None:
            bars = dashes(side + 50, 1.2, 0.6, across) * _coverage(road.half_width - distance, across)
            white = np.maximum(white, bars * band(z - road.crossing - 1.5, 3.0, along))
        yellow = band(distance - road.lane + 0.05, 0.13, across) * road.has_edge_lines
        albedo = _blend(_blend(albedo, (0.7, 0.7, 0.68), white * worn), (0.62, 0.42, 0.06), yellow * worn)
    return albedo


def _sky(light: Light, ray: Array, grain: Array) -> Array:
    """Return the light of the sky (K, 3): a gradient, a glow around the sun, clouds that thin out to the horizon."""
    length = np.sqrt((ray * ray).sum(axis=0))
    rise, toward = ray[1] / length, np.clip(light.sun @ ray / length, 0, 1)
    low = 1 / (1 + 6 * rise)
    sky = _blend(light.zenith, light.horizon, low * low * (1 + rise))
    sky = sky + _times(light.beam, 0.02 / (1.02 - toward) * (1 - np.clip(light.clouds, 0.2, 0.95)))
    density = light.clouds + 1.1 * grain[3] + 0.6 * grain[2] + 0.25 * grain[1]
    share = np.clip(density * 1.4, 0, 1) * 0.85 * np.minimum(rise * 14, 1)
    return _blend(
        sky, _times(light.beam * 0.45 + light.ambient * 0.85, 0.95 - 0.3 * np.clip(density - 0.5, 0, 1)), share
    )


def band(distance: Array, width: float, footprint: Array) -> Array:
    """Return the share of a footprint that a band covers, from the distance to the band's middle."""
    half = footprint / 2
    return (
        np.clip(np.minimum(distance + half, width / 2) - np.maximum(distance - half, -width / 2), 0, None) / footprint
    )


def dashes(position: Array, period: float, length: float, footprint: Array) -> Array:
    """Return the share of a footprint that dashes cover: the exact box filter."""

    def painted(end: Array) -> Array:
        periods = np.floor(end / period)
        return periods * length + np.minimum(end - periods * period, length)

    return (painted(position + footprint / 2) - painted(position - footprint / 2)) / footprint


def _coverage(distance: Array, footprint: Array) -> Array:
    """Return the share of a footprint inside an edge at a distance that is positive inside."""
    return np.clip(distance / footprint + 0.5, 0, 1)


def _tone(light: Array) -> Array:
    """Map linear light to display values; the square root stands for the display's gamma."""
    return np.sqrt(np.clip(light, 0, 1)).astype(np.float32)


def _mix(first: Color, second: Color, share: float) -> Array:
    return np.asarray(first) * (1 - share) + np.asarray(second) * share


def _blend(under: Array, over: Color, share: Array) -> Array:
    return under + (np.asarray(over, np.float32) - under) * share[..., None]


def _times(color: Color, factor: Array) -> Array:
    return np.asarray(color, np.float32) * factor[..., None]
