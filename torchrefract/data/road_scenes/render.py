"""Rendered dashcam frames of southern African roads, with their true depth: clean frames without files.

Sky and ground are drawn in closed form, then panels with a depth buffer. Each pixel is sampled by five rays. A ray's
direction has length 1 along the camera's axis, so that its parameter is the depth. The product of a fixed vector and
the direction is linear in the pixel's column and row.
"""

import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from torchrefract._tensor import to_float, to_uint8
from torchrefract._validation import check_count, check_size, check_tensor
from torchrefract.data.road_scenes.scene import (
    Array,
    Color,
    Light,
    Panel,
    Road,
    Scene,
    View,
    draw_scene,
    noise,
    scale_color,
)
from torchrefract.types import Frame

Window = tuple[slice, slice, slice]  # rays, rows, columns

_SMALLEST = 8  # px a side
_KEPT_BYTES, _PIXEL_BYTES = 2 << 30, 7  # of all frames, and of a pixel with its depth
_BITS = (1 << 64) - 1  # negative seeds and keys count modulo 2^64
# Position of each ray in its pixel, (right, down), px from the center, on distinct rows and columns.
_OFFSETS = np.array([(0.0, 0.0), (-0.15, -0.4), (0.4, -0.15), (0.15, 0.4), (-0.4, 0.15)])
_NEAR, _FAR = 0.2, 3e4  # m
_CLOUD_HEIGHT, _CLOUD_SCALE = 900.0, 170.0  # m; size of clouds in multiples of the texture of the ground
_HAZE = 9000.0  # m, the distance at which contrast is one half


class RoadScenes(Dataset[Frame]):
    """Rendered road scenes with their depth, see `render_road_scenes`.

    The image has 256 levels, as that of a camera. Each process keeps the frames that it renders, up to 2 GiB, because
    a frame takes longer than a step of a small network.

    Args:
        count: number of scenes.
        size: (height, width), px, each at least 8.
        seed: any integer of 64 bits.
        first: key of the first scene; the others follow.
    """

    def __init__(self, count: int, *, size: Sequence[int] = (64, 112), seed: int = 0, first: int = 0):
        self.count = check_count("count", count)
        self.size = check_size("size", size)
        check_count("size", min(self.size), low=_SMALLEST)
        self.seed = check_count("seed", seed, low=-(2**63))
        self.first = check_count("first", first, low=-(2**63))
        self._frames: dict[int, Frame] = {}

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, index: int) -> Frame:
        """Render a frame: image (3, H, W), key () and depth (1, H, W)."""
        if not -self.count <= index < self.count:
            raise IndexError(f"index must lie in [{-self.count}, {self.count - 1}], got {index}")
        key = torch.tensor(self.first + index % self.count, device="cpu")
        frame = self._frames.get(int(key))
        if frame is None:
            image, depth = render_road_scenes(key[None], *self.size, seed=self.seed)
            frame = Frame(to_uint8(image)[0], key, depth[0])
            if len(self._frames) < self.num_kept:
                self._frames[int(key)] = frame
        return Frame(to_float(frame.image), frame.key.clone(), frame.depth.clone())

    def __getstate__(self) -> dict[str, Any]:
        """Leave out the rendered frames: a process that starts without them renders what it needs."""
        return vars(self) | {"_frames": {}}

    @property
    def num_kept(self) -> int:
        """The number of frames that a process keeps."""
        return min(self.count, -(-_KEPT_BYTES // (_PIXEL_BYTES * self.size[0] * self.size[1])))

    def render(self, *, processes: int) -> Iterator[int]:
        """Render the frames that this process keeps, in forked processes; yield the number of each when it is done.

        Workers of a loader that are forked afterwards have the frames too; others render what they need.
        """
        # A generator of its own leaves that of PyTorch, and so a training, as it is.
        options: dict[str, Any] = {"batch_size": None, "generator": torch.Generator()}
        options |= {"num_workers": processes, "multiprocessing_context": "fork" if processes else None}
        loader = DataLoader(self, sampler=range(self.num_kept), **options)
        for number, frame in enumerate(loader):
            # Copies, since memory that processes share is scarce.
            self._frames[int(frame.key)] = Frame(to_uint8(frame.image[None])[0], frame.key.clone(), frame.depth.clone())
            yield number


def render_road_scenes(keys: Tensor, height: int, width: int, *, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Render road scenes on the CPU; a frame depends on its key and the seed alone.

    Args:
        keys: (B,), int64, B >= 1.
        height, width: px, at least 8. The longer side sets the field of view, so that a scene is alike at all sizes.
        seed: any integer of 64 bits; scenes of different seeds are independent.

    Returns:
        image: (B, 3, H, W), float32, in [0, 1], on the device of `keys`; each pixel is the mean of five rays.
        depth: (B, 1, H, W), float32, m along the camera's axis of the ray through the pixel's center; inf for the sky.

    Raises:
        ValueError: `keys` has another shape, or a side is below 8.
        TypeError: `keys` is not an int64 tensor.
    """
    if check_tensor("keys", keys).ndim != 1 or len(keys) == 0:
        raise ValueError(f"keys must have shape (B,) with B >= 1, got {tuple(keys.shape)}")
    if keys.dtype != torch.int64:
        raise TypeError(f"keys must be int64, got {keys.dtype}")
    check_count("height", height, low=_SMALLEST)
    check_count("width", width, low=_SMALLEST)
    generators = [np.random.default_rng((seed & _BITS, key & _BITS)) for key in keys.tolist()]
    images, depths = zip(*(render(draw_scene(random), height, width) for random in generators), strict=True)
    image = torch.from_numpy(np.stack(images)).permute(0, 3, 1, 2).contiguous()
    return image.to(keys.device), torch.from_numpy(np.stack(depths)[:, None]).to(keys.device)


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
        places = np.stack([down, right]) / ahead * self.scale + np.array(self.size)[:, None] / 2
        first = np.maximum(places.min(axis=1) - 1, 0).astype(int)
        last = np.minimum(places.max(axis=1) + 2, self.size).astype(int)
        rows, columns = map(slice, first, last)
        return (slice(None), rows, columns) if (first < last).all() else None


def render(scene: Scene, height: int, width: int) -> tuple[Array, Array]:
    """Render the image (H, W, 3) and the depth (H, W) of a scene, float32."""
    camera = Camera(scene.view, height, width)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        drop = -camera.dot(np.array([0.0, 1.0, 0.0]), camera.frame)
        depth = np.where(drop > 0, np.float32(camera.position[1]) / drop, np.float32(np.inf))
        is_shaded = np.zeros(depth.shape, dtype=bool)
        for panel in scene.casters:
            _cast_shadow(panel, camera, scene.light.sun, depth, is_shaded)
        color = np.repeat(_backdrop(scene, camera, depth, is_shaded)[None], len(depth), axis=0)
        for panel in scene.panels:
            _draw_panel(panel, camera, scene.light, color, depth)
    return np.clip(color.mean(axis=0), 0, 1), depth[0]


def _draw_panel(panel: Panel, camera: Camera, light: Light, color: Array, depth: Array) -> None:
    """Draw a panel where it is nearer than `depth`; changes `color` and `depth`."""
    distance = float(panel.normal @ (panel.center - camera.position))
    window = camera.window(panel.corners)
    if window is None:
        return
    t = np.float32(distance) / camera.dot(panel.normal, window)
    rays, albedo = _solid_rays(panel, (t > _NEAR) & (t < depth[window]), *_coordinates(panel, camera, window, t))
    facing = -math.copysign(1, distance) * panel.normal
    shaded = albedo * (
        light.ambient * float(0.75 + 0.25 * facing[1]) + light.beam * max(float(facing @ light.sun), 0.0)
    )
    color[window][rays] = _tone(_blend(shaded, light.horizon * 0.9, t[rays] / (t[rays] + _HAZE)))
    depth[window][rays] = t[rays]


def _cast_shadow(panel: Panel, camera: Camera, sun: Array, depth: Array, is_shaded: Array) -> None:
    """Mark the rays that meet the ground where the panel hides the sun; changes `is_shaded`."""
    window = camera.window(panel.corners - np.outer(panel.corners[:, 1], sun / sun[1]))
    if window is None:
        return
    ground, start = depth[window], np.float32(panel.normal @ (camera.position - panel.center))
    t = -(start + ground * camera.dot(panel.normal, window)) / np.float32(panel.normal @ sun)
    u, v = (
        value + t * np.float32(axis @ sun)
        for value, axis in zip(_coordinates(panel, camera, window, ground), panel.inverse_axes, strict=True)
    )
    is_shaded[window][_solid_rays(panel, (t > -0.3) & np.isfinite(ground), u, v)[0]] = True


def _coordinates(panel: Panel, camera: Camera, window: Window, depth: Array) -> list[Array]:
    """Return the coordinates u and v of the rays at a depth (5, h, w); the panel covers [-1, 1]."""
    start = camera.position - panel.center
    return [np.float32(axis @ start) + depth * camera.dot(axis, window) for axis in panel.inverse_axes]


def _solid_rays(panel: Panel, mask: Array, u: Array, v: Array) -> tuple[tuple[Array, ...], Array]:
    """Return the index of the rays of a mask that meet a solid part of the panel, and its albedo there (K, 3)."""
    rays = np.nonzero(mask & (np.abs(u) <= 1) & (np.abs(v) <= 1))
    albedo, solid = panel.paint(u[rays] * math.hypot(*panel.right), (v[rays] + 1) * math.hypot(*panel.up))
    return tuple(index[solid] for index in rays), albedo[solid]


def _backdrop(scene: Scene, camera: Camera, depth: Array, is_shaded: Array) -> Array:
    """Return ground and sky (H, W, 3): edges are means over the rays, all else is that of each pixel's center."""
    road, light = scene.road, scene.light
    x, y, z = (camera.dot(axis, camera.frame) for axis in np.eye(3))
    left, height, shift = float(camera.position[0]), float(camera.position[1]), road.shift.astype(np.float32)
    rise, size = y[0], np.where(y[0] < 0, np.float32(1), np.float32(_CLOUD_SCALE))
    plane_depth = np.minimum(np.where(rise < 0, np.float32(height), np.float32(_CLOUD_HEIGHT)) / np.abs(rise), _FAR)
    # A pixel covers a distance on the plane that grows with the depth, and more of it ahead than across.
    footprint = plane_depth / camera.scale / size * np.maximum(1, 0.5 / np.abs(rise))
    plane = (left + plane_depth * x[0]) / size, plane_depth * z[0] / size
    # Noise of four cell sizes, each faded out where a pixel covers more than about one cell.
    cells = np.array([0.035, 0.2, 1.3, 8.0], np.float32)[:, None, None]
    grain = noise(plane[0] / cells + shift[0], plane[1] / cells + shift[1]) / (1 + (footprint / cells) ** 2)
    color, is_sky, is_ground = np.zeros((*rise.shape, 3), np.float32), (y >= 0).any(axis=0), (y < 0).any(axis=0)
    color[is_sky] = _tone(_sky(light, np.stack([x[0], y[0], z[0]])[:, is_sky], grain[:, is_sky]))
    t = np.minimum(depth[:, is_ground], _FAR)
    albedo = _ground(road, left + t * x[:, is_ground], t * z[:, is_ground], grain[:, is_ground])
    sunlight = light.beam * (float(light.sun[1]) * (1 - 0.85 * _share(is_shaded[:, is_ground]))[:, None])
    ground = _blend(albedo * (light.ambient * 0.95 + sunlight), light.horizon * 0.9, t[0] / (t[0] + _HAZE))
    color[is_ground] = _blend(color[is_ground], _tone(ground), _share(y[:, is_ground] < 0))
    return color


def _ground(road: Road, x: Array, z: Array, grain: Array) -> Array:
    """Return the albedo of the ground (K, 3) at rays (5, K): verge, shoulder, road, road paint."""
    fine, small, middle, coarse = grain
    distance, is_gravel = np.abs(x - road.center(z)), 1 - road.is_paved
    soil = _mix((0.4, 0.3, 0.18), (0.42, 0.17, 0.08), road.red_soil)
    grass = _mix((0.42, 0.33, 0.13), (0.13, 0.2, 0.05), road.green_grass)
    shade, ragged = 0.3 * fine + 0.2 * small, middle + 0.4 * small
    tuft = np.clip(0.62 + coarse + 0.6 * middle + 0.5 * small + 0.3 * fine, 0, 1)
    tuft *= _share(distance >= road.half_width + 1.1 * road.is_paved + 0.3 * ragged)  # the shoulder is bare
    albedo = _blend(scale_color(soil, 1 + shade), scale_color(grass, 1 + 1.3 * shade + 0.25 * middle), tuft)
    track = np.clip(1 - np.abs(np.abs(distance[0] - road.lane / 2) - 0.8) / 0.5, 0, None)  # of wheels
    surface = (road.asphalt,) * 3 if road.is_paved else _mix((0.42, 0.33, 0.22), (0.44, 0.22, 0.12), road.red_soil)
    tone = 1 + 0.35 * fine + (0.1 + 0.2 * is_gravel) * (small + middle) + (0.32 * is_gravel - 0.14) * track
    is_road = distance < road.half_width + (0.06 + 0.3 * is_gravel) * ragged
    albedo = _blend(albedo, scale_color(surface, tone), _share(is_road))
    if road.is_paved:
        worn = np.clip(0.85 + 0.2 * fine + 0.2 * small + 0.15 * coarse, 0, 1)
        is_white = (distance < 0.07) & (road.has_solid_line | ((z + float(road.shift[0])) % 9.0 < 4.0))
        albedo = _blend(albedo, (0.7, 0.7, 0.68), _share(is_white) * worn)
        albedo = _blend(albedo, (0.62, 0.42, 0.06), _share(np.abs(distance - road.lane + 0.05) < 0.065) * worn)
    return albedo


def _sky(light: Light, ray: Array, grain: Array) -> Array:
    """Return the light of the sky (K, 3): a gradient, a glow around the sun, clouds that thin out to the horizon."""
    length = np.sqrt((ray * ray).sum(axis=0))
    rise, toward = ray[1] / length, np.clip(light.sun @ ray / length, 0, 1)
    low = 1 / (1 + 6 * rise)
    sky = _blend(light.zenith, light.horizon, low * low * (1 + rise))
    sky = sky + scale_color(light.beam, 0.02 / (1.02 - toward) * (1 - np.clip(light.clouds, 0.2, 0.95)))
    density = light.clouds + 1.1 * grain[3] + 0.6 * grain[2] + 0.25 * grain[1]
    share = np.clip(density * 1.4, 0, 1) * 0.85 * np.minimum(rise * 14, 1)
    cloud = scale_color(light.beam * 0.45 + light.ambient * 0.85, 0.95 - 0.3 * np.clip(density - 0.5, 0, 1))
    return _blend(sky, cloud, share)


def _tone(light: Array) -> Array:
    """Map linear light to display values; the square root stands for the display's gamma."""
    return np.sqrt(np.clip(light, 0, 1)).astype(np.float32)


def _share(mask: Array) -> Array:
    """Return the share of the rays (5, K) of each pixel that a mask holds, float32."""
    return mask.mean(axis=0, dtype=np.float32)


def _mix(first: Color, second: Color, share: float) -> Array:
    return np.asarray(first) * (1 - share) + np.asarray(second) * share


def _blend(under: Array, over: Color, share: Array) -> Array:
    return under + (np.asarray(over, np.float32) - under) * share[..., None]
