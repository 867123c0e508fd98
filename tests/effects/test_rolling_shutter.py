"""RollingShutter against a renderer that casts the rays of each row at its time, in NumPy and SciPy."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
import torch
from helpers import random_image
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import Rotation
from targets import boxes_of
from torch import Tensor, nn
from torch.testing import assert_close

from torchrefract import (
    Camera,
    Compose,
    DepthProvider,
    GroundPlaneDepth,
    LensDistortion,
    RollingShutter,
    Turbulence,
    compose_flows,
    warp,
)
from torchrefract.effects.rolling_shutter import RollingShutterParams

NONE = (0.0, 0.0)
STILL: dict[str, Any] = {"pitch_range": NONE, "yaw_range": NONE, "roll_range": NONE}
HEIGHT, WIDTH, FOCAL, CAMERA_HEIGHT = 135, 240, 175.0, 1.3  # px and m: a dashcam of f = 1400 px at 1920 px
CAMERA = Camera(width=WIDTH, height=HEIGHT, fx=FOCAL, fy=FOCAL, cx=121.0, cy=60.0, coefficients=(0.0,) * 4)


def driving(speed: float, readout: float, **given: float) -> RollingShutterParams:
    """Return the parameters of one camera, by default without vibration; pitch, yaw, roll in deg and one frequency."""
    values = dict.fromkeys(("exposure", "pitch", "yaw", "roll", "phase", "frame"), 0.0) | {"frequency": 15.0} | given

    def tensor(*numbers: float) -> Tensor:
        return torch.tensor([numbers], dtype=torch.float64)

    return RollingShutterParams(
        applied=torch.tensor([True]),
        speed=tensor(speed)[0],
        readout=tensor(readout)[0],
        exposure=tensor(values["exposure"])[0],
        amplitude=tensor(values["pitch"], values["yaw"], values["roll"]),
        frequency=tensor(values["frequency"]),
        phase=torch.full((1, 3, 1), values["phase"], dtype=torch.float64),
        frame=tensor(values["frame"]),
    )


def rendered_flow(
    params: RollingShutterParams,
    planes: list[tuple[np.ndarray, float]],
    moment: float = 0.0,
    depth: np.ndarray | None = None,
):
    """Cast the rays of each row at its time; return the flow (2, H, W) and the depth of the clean frame (H, W).

    planes: normals n and distances d of n X = d, of which the nearest one in front of the camera is seen.
    depth: (H, W), finite; if given, rays end on it instead, 1 / Z being bilinear between pixels, near the planes.
    """
    values = [getattr(params, name)[0].numpy() for name in ("amplitude", "frequency", "phase")]
    amplitude, frequency, phase = values
    x, y = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    rays = np.stack([(x - CAMERA.cx) / FOCAL, (y - CAMERA.cy) / FOCAL, np.ones(x.shape)], axis=-1)

    def distance(origin: np.ndarray, directions: np.ndarray) -> np.ndarray:
        with np.errstate(divide="ignore"):
            ways = [(d - n @ origin) / (directions @ n) for n, d in planes]
        return np.min([np.where(way > 0, way, np.inf) for way in ways], axis=0)

    flow = np.empty((2, HEIGHT, WIDTH))
    start = params.frame[0, 0].item() / 30
    for row in range(HEIGHT):
        time = ((row + 0.5) / HEIGHT - 0.5) * params.readout[0].item() / 1000 + moment
        angles = [
            np.radians(a)
            / math.sqrt(len(frequency))
            * np.sum(np.sin(2 * math.pi * frequency * (start + time) + p) - np.sin(2 * math.pi * frequency * start + p))
            for a, p in zip(amplitude, phase, strict=True)
        ]
        turn = Rotation.from_euler("YXZ", [angles[1], angles[0], angles[2]]).as_matrix()
        origin = np.array([0.0, 0.0, params.speed[0].item() / 3.6 * time])
        directions = rays[row] @ turn.T
        way = distance(origin, directions)
        for _ in range(60):
            if depth is None:
                break
            point = origin + way[:, None] * directions
            place = [c + FOCAL * point[:, axis] / point[:, 2] for axis, c in ((1, CAMERA.cy), (0, CAMERA.cx))]
            end = 1 / map_coordinates(1 / depth, place, order=1, mode="nearest")
            way = (way + (end - origin[2]) / directions[:, 2]) / 2
        is_sky = np.isinf(way)
        point = np.where(is_sky[:, None], directions, origin + np.where(is_sky, 0, way)[:, None] * directions)
        flow[0, row] = CAMERA.cx + FOCAL * point[:, 0] / point[:, 2] - x[row]
        flow[1, row] = CAMERA.cy + FOCAL * point[:, 1] / point[:, 2] - row
    return flow, distance(np.zeros(3), rays)


ROAD = (np.array([0.0, 1.0, 0.0]), CAMERA_HEIGHT)
SCENES = {
    "road": [ROAD],
    "corridor": [ROAD, (np.array([1.0, 0, 0]), 4.0), (np.array([-1.0, 0, 0]), 3.0), (np.array([0, 0, 1.0]), 60.0)],
    "wall": [(np.array([0.4, 0.1, 1.0]), 9.0)],
}
VIBRATION = {"pitch": 0.2, "yaw": 0.1, "roll": 0.3, "phase": 0.7, "frame": 11.0}


@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize("readout", [30.0, -30.0])
@pytest.mark.parametrize("vibration", [{}, VIBRATION])
def test_the_flow_is_that_of_a_renderer_row_by_row(scene, readout, vibration):
    params = driving(100.0, readout, **vibration)
    expected, depth = rendered_flow(params, SCENES[scene])
    image, depth = torch.zeros(1, 1, HEIGHT, WIDTH, dtype=torch.float64), torch.from_numpy(depth)[None, None]
    degraded = RollingShutter(camera=CAMERA).apply(image, params, depth=depth)
    error = (degraded.flow[0] - torch.from_numpy(expected)).norm(dim=0)
    assert np.linalg.norm(expected, axis=0).max() > 8
    valid = degraded.valid[0, 0]
    # A map does not tell where within a pixel two planes meet.
    meets = torch.from_numpy(sees_two_planes(1 / depth[0, 0].numpy(), expected))
    assert error[valid & ~meets].max() < 0.02
    assert error[valid].max() < 0.04
    assert meets.double().mean() < 0.03
    if scene == "corridor":  # the one without sky
        of_map, _ = rendered_flow(params, SCENES[scene], depth=depth[0, 0].numpy())
        assert (degraded.flow[0] - torch.from_numpy(of_map)).norm(dim=0)[valid].max() < 0.001


def sees_two_planes(inverse_depth: np.ndarray, flow: np.ndarray) -> np.ndarray:
    """Return (H, W), bool: the pixel shows a point between two planes; 1 / Z is linear on each of them."""
    bends = np.zeros(inverse_depth.shape, bool)
    for axis in (0, 1):
        bend = np.abs(np.diff(inverse_depth, 2, axis=axis)) > 1e-9
        bends |= np.pad(bend, [(1, 1) if axis == a else (0, 0) for a in (0, 1)], mode="edge")
    row, column = (np.indices(bends.shape) + flow[::-1]).round().astype(int)
    return bends[row.clip(0, HEIGHT - 1), column.clip(0, WIDTH - 1)]


def test_the_flow_of_a_map_has_the_gradient_of_its_exact_solution():
    params, image = driving(100.0, 30.0, **VIBRATION), torch.zeros(1, 1, 9, 16, dtype=torch.float64)
    x, y = torch.arange(16.0, dtype=torch.float64), torch.arange(9.0, dtype=torch.float64)[:, None]
    wall = 1 / (0.1 + 0.01 * x + 0.005 * y)[None, None]  # at an angle to the road

    def flow(speed: Tensor, scale: Tensor) -> Tensor:
        return RollingShutter().apply(image, params._replace(speed=speed), depth=scale * wall).flow[..., 2:-2, 2:-2]

    scale = torch.ones(1, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(flow, (params.speed.clone().requires_grad_(), scale))


@pytest.mark.parametrize(("depth", "speed", "skew"), [(8.0, 40, 37), (8.0, 100, 91), (30.0, 40, 2.6), (30.0, 100, 6.5)])
def test_a_pole_beside_the_road_is_skewed_as_computed_by_hand(depth, speed, skew):
    effect = RollingShutter(
        camera=Camera(width=480, height=270, fx=350, fy=350, cx=239.5, cy=134.5, coefficients=(0,) * 4)
    )
    wall = torch.full((1, 1, 270, 480), depth)
    flow = effect.apply(torch.zeros_like(wall), driving(speed, 30.0), depth=wall).flow
    column = round(239.5 + 350 * 5 / depth)  # 5 m beside the camera
    # The skew is that of a frame of 1920 x 1080 px.
    assert 4 * (flow[0, 0, 0, column] - flow[0, 0, -1, column]).item() == pytest.approx(skew, rel=0.02)


def test_a_pitch_of_a_fifth_of_a_degree_at_15_hz_moves_rows_by_five_pixels():
    effect = RollingShutter(
        camera=Camera(width=481, height=1080, fx=1400, fy=1400, cx=240, cy=539.5, coefficients=(0,) * 4)
    )
    flow = effect.apply(torch.zeros(1, 1, 1080, 481), driving(0.0, 30.0, pitch=0.2)).flow
    stretch = 1 + (539.5 / 1400) ** 2  # of small angles, at the last row
    assert flow[0, 1, -1, 240].abs().item() / stretch == pytest.approx(4.9, rel=0.02)
    assert flow[0, 1, 540].abs().max() < 0.01  # the middle row stays


@pytest.mark.parametrize("still", [{"readout_range": NONE}, {"speed_range": NONE, **STILL}])
def test_no_readout_or_no_motion_is_the_identity(still):
    image = random_image(2, 3, 24, 32)
    degraded = RollingShutter(**still).degrade(image, depth=torch.full((2, 1, 24, 32), 4.0))
    assert torch.equal(degraded.image, image)
    assert not degraded.flow.any()


def test_the_restore_flow_leads_to_where_each_point_is_exposed_and_leaves_out_what_is_hidden():
    depth = torch.full((1, 1, HEIGHT, WIDTH), 30.0, dtype=torch.float64)
    depth[..., 190:200] = 6.0  # a pole
    image = torch.rand(1, 1, HEIGHT, WIDTH, dtype=torch.float64)
    degraded = RollingShutter(camera=CAMERA).apply(image, driving(100.0, 30.0, **VIBRATION), depth=depth)
    assert degraded.restore_residual[degraded.restore_valid].max() < 0.05
    hidden = ~degraded.restore_valid[0, 0, 20:-20, 20:-20]
    assert 0.005 < hidden.double().mean() < 0.05
    assert not hidden[:, :140].any()  # only beside the pole
    smooth = RollingShutter().degrade(random_image(1, 1, HEIGHT, WIDTH), seed=1)
    back = compose_flows(smooth.flow, smooth.restore_flow).norm(dim=1, keepdim=True)
    assert back[smooth.restore_valid].max() < 0.05
    assert smooth.restore_valid.float().mean() > 0.85


@pytest.mark.parametrize(("horizon", "exposure_range"), [(0.4, NONE), (0.5, (5.0, 10.0))])
def test_planned_flows_of_a_road_are_within_the_tolerance(horizon, exposure_range):
    depth, size = GroundPlaneDepth(horizon=horizon), (270, 480)
    for tolerance_px in (0.02, 0.2):
        given = {"depth": depth, "exposure_range": exposure_range, "tolerance_px": tolerance_px}
        effect = RollingShutter(**given, speed_range=(100.0, 100.0), readout_range=(30.0, 33.0), pitch_range=(0.2, 0.2))
        image = torch.zeros(8, 1, *size)
        at_depth = effect.at_depth(effect.sample(image, seed=3), image, None)
        for moment in effect.moments():
            planned = effect.flow_by_plan(at_depth.at(moment), *size).dense
            exact = effect.planned_flow(at_depth.at(moment), *size, None).dense
            assert (planned - exact).norm(dim=1).max() <= tolerance_px + 1e-3


def test_the_vibration_of_a_clip_goes_on_from_frame_to_frame():
    clip, effect = random_image(2, 3, 1, 24, 32), RollingShutter(speed_range=NONE, fps=25.0, tolerance_px=None)
    degraded = effect.degrade(clip, seed=2, frame=4)
    params, (readout,) = degraded.params, degraded.params.readout[:1]
    # The last row of one frame and the first row of a frame that follows 1 / fps - readout later, seen from the middle.
    assert not torch.equal(degraded.flow[:, 0], degraded.flow[:, 1])

    def sines(time):
        return (2 * math.pi * params.frequency[0] * time + params.phase[0, 0]).sin().sum() / 3**0.5

    for t in range(3):
        middle = (4 + t) / 25
        for row in (0, 23):
            time = middle + ((row + 0.5) / 24 - 0.5) * readout / 1000
            pitch = math.radians(params.amplitude[0, 0]) * (sines(time) - sines(middle))
            # In the middle column yaw moves nothing down, and neither does roll.
            y = (row - 11.5) / (0.9 * 32)
            expected = 0.9 * 32 * (math.tan(math.atan(y) - pitch) - y)
            assert degraded.flow[0, t, 1, row, 15:17].mean().item() == pytest.approx(expected, abs=2e-3)


def test_labels_move_along_and_in_a_composition_the_scene_is_sampled_once():
    image = torch.rand(3, HEIGHT, WIDTH)
    boxes = boxes_of([[190, 20, 200, 110]], (HEIGHT, WIDTH))
    effect = RollingShutter(speed_range=(100.0, 100.0), readout_range=(30.0, 30.0), depth=Plane(8.0), **STILL)
    moved = effect(image, {"boxes": boxes, "labels": torch.tensor([1])})[1]["boxes"]
    # The upper left and the lower right corner, relative to the center of the frame, grow by 1 / (1 - v t / Z).
    for corner, (x, y) in enumerate([(190 - WIDTH / 2, 20 - HEIGHT / 2), (200 - WIDTH / 2, 110 - HEIGHT / 2)]):
        grown = 1.0
        for _ in range(20):
            grown = 1 / (1 - 100 / 3.6 * (y * grown / HEIGHT * 0.030) / 8)
        expected = torch.tensor([WIDTH / 2 + x * grown, HEIGHT / 2 + y * grown])
        assert_close(moved[0, 2 * corner : 2 * corner + 2].float(), expected, atol=0.5, rtol=0)
    lens = LensDistortion(frame="pad")
    for exposure, samplings in ((0.0, 1), (10.0, 4)):
        shutter = RollingShutter(exposure_range=(0.0, exposure), num_exposures=4)
        for effect in (shutter, Compose([Turbulence(), shutter, lens])):
            assert effect.plan(HEIGHT, WIDTH).num_samplings == samplings


def test_an_exposure_averages_images_at_times_within_it():
    image = random_image(2, 3, 40, 60)
    effect = RollingShutter(exposure_range=(10.0, 20.0), num_exposures=3, speed_range=(100.0, 100.0), tolerance_px=None)
    params = effect.sample(image, seed=1)
    at_depth = effect.at_depth(params, image, None)
    flows = [effect.flow_by_plan(at_depth.at(moment), 40, 60).dense for moment in (-1 / 3, 0.0, 1 / 3)]
    sharp = [warp(image, flow, padding="reflection")[0] for flow in flows]
    assert (sharp[0] - sharp[2]).abs().max() > 0.1
    degraded = effect.apply(image, params)
    assert_close(degraded.image, sum(sharp) / 3)
    assert_close(degraded.flow, flows[1])  # of the middle
    composed = Compose([effect], tolerance_px=None)
    result = composed.apply(image, composed.sample(image)._replace(children=(params,)))
    assert_close(result.image, degraded.image)
    assert_close(result.flow, degraded.flow)
    as_bytes = effect.apply((255 * image).byte(), params)
    assert as_bytes.image.dtype is torch.uint8
    assert_close(as_bytes.image.float() / 255, degraded.image, atol=2 / 255, rtol=0)


def test_a_moment_of_an_exposure_is_that_of_the_renderer():
    params = driving(100.0, 30.0, exposure=12.0, **VIBRATION)
    effect = RollingShutter(camera=CAMERA, exposure_range=(12.0, 12.0), tolerance_px=None)
    expected, depth = rendered_flow(params, SCENES["road"], moment=-0.004)
    image = torch.zeros(1, 1, HEIGHT, WIDTH, dtype=torch.float64)
    at_depth = effect.at_depth(params, image, torch.from_numpy(depth)[None, None]).at(-1 / 3)
    flow = effect.flow_by_plan(at_depth, HEIGHT, WIDTH).dense[0]
    assert (flow - torch.from_numpy(expected))[:, :-10].abs().max() < 0.02


def test_a_network_gives_the_depth_of_each_image():
    class Network(nn.Module):
        def __init__(self):
            super().__init__()
            self.scale = nn.Parameter(torch.tensor(20.0))

        def forward(self, image: Tensor) -> Tensor:
            return 5 + self.scale.detach() * image.mean(dim=1, keepdim=True)

    network, image = Network(), random_image(2, 3, 40, 60)
    effect = RollingShutter(depth=network)
    assert not list(effect.parameters())
    flow = effect.degrade(image, seed=1).flow
    assert_close(flow, RollingShutter().degrade(image, seed=1, depth=network(image)).flow)


@dataclass(frozen=True)
class Plane(DepthProvider):
    """A wall across the road."""

    depth: float

    def __call__(self, height, width, *, dtype, device):
        return torch.full((1, 1, height, 1), self.depth, dtype=dtype, device=device)


def test_a_pole_that_moves_farther_than_it_is_wide_is_skewed_as_a_whole():
    depth = torch.full((1, 1, HEIGHT, WIDTH), 40.0, dtype=torch.float64)
    depth[..., 200:204] = 6.0
    image = (depth < 10).double()
    degraded = RollingShutter(camera=CAMERA).apply(image, driving(100.0, 30.0), depth=depth)
    for row in (8, 30, 100, HEIGHT - 3):
        time = ((row + 0.5) / HEIGHT - 0.5) * 0.030
        edges = [121 + (edge - 121) / (1 - 100 / 3.6 * time / 6) for edge in (199.5, 203.5)]
        seen = degraded.image[0, 0, row]
        assert seen.sum().item() == pytest.approx(edges[1] - edges[0], abs=0.6)
        columns = torch.arange(WIDTH, dtype=torch.float64)
        assert ((seen * columns).sum() / seen.sum()).item() == pytest.approx(sum(edges) / 2, abs=1.0)
