import math
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from torchrefract import Camera, Compose, LensDistortion, Rectification

# A car's camera, from a calibration with 20 chessboards.
DASHCAM = Camera(
    width=1280, height=720, fx=1161.0, fy=1157.0, cx=676.0, cy=388.3, coefficients=(-0.281, 0.168, 8e-4, -4e-4, -0.05)
)
SMALL = Camera(width=48, height=27, fx=43.0, fy=42.5, cx=25.0, cy=14.1, coefficients=(-0.281, 0.168, 8e-4, -4e-4))


def smooth(*shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
    y, x = (torch.arange(n, dtype=torch.float64) / n for n in shape[-2:])
    waves = [torch.sin(7 * x + 3 * c) * torch.cos(5 * y[:, None] - c) for c in range(shape[-3])]
    return (0.5 + 0.4 * torch.stack(waves)).expand(shape).to(dtype).clone()


PINHOLE: dict[str, Any] = {"width": 48, "height": 27, "fx": 43.0, "fy": 42.5, "cx": 25.0, "cy": 14.1}
# One of each model, and of OpenCV's one of each length.
ALL = {
    "opencv4": SMALL,
    "opencv5": Camera(**PINHOLE, coefficients=(-0.281, 0.168, 8e-4, -4e-4, -0.05)),
    "opencv8": Camera(**PINHOLE, coefficients=(0.6, 0.12, 1e-3, -5e-4, 0.01, 0.95, 0.25, 0.03)),
    "opencv12": Camera(
        **PINHOLE, coefficients=(-0.3, 0.15, 1e-3, 2e-3, -0.02, 0.02, 0.01, 0.005, 3e-3, 1e-3, -2e-3, 4e-3)
    ),
    "opencv14": Camera(
        **PINHOLE, coefficients=(-0.3, 0.15, 1e-3, 2e-3, -0.02, 0.02, 0.01, 0.005, 3e-3, 1e-3, -2e-3, 4e-3, 0.03, -0.05)
    ),
    "fisheye": Camera(**PINHOLE, coefficients=(-0.12, 0.043, -0.0088, -0.0037), model="fisheye"),
    "division": Camera(**PINHOLE, coefficients=(-0.2,), model="division"),
    "polynomial12": Camera(
        **PINHOLE,
        coefficients=(-0.28, 0.16, -0.05, 1e-2, 1e-3, 1e-4, 1e-3, -2e-3, 3e-3, 1e-3, -2e-3, 4e-3),
        model="polynomial12",
    ),
}
every_model = pytest.mark.parametrize("camera", ALL.values(), ids=ALL)


def test_the_flow_of_frames_of_half_the_size_is_opencvs_map(oracle):
    height, width = DASHCAM.height // 2, DASHCAM.width // 2
    effect = Rectification(DASHCAM, tolerance_px=None)
    flow = effect.degrade(torch.zeros(1, 1, height, width, dtype=torch.float64), seed=0).flow[0]
    # Pixel centers are whole numbers, so the principal point keeps its half pixel.
    cx, cy = ((c + 0.5) / 2 - 0.5 for c in (DASHCAM.cx, DASHCAM.cy))
    matrix, vector = (
        np.array([[DASHCAM.fx / 2, 0, cx], [0, DASHCAM.fy / 2, cy], [0, 0, 1]]),
        np.array(DASHCAM.coefficients),
    )
    theirs = cv2.initUndistortRectifyMap(matrix, vector, np.empty(0), matrix, (width, height), cv2.CV_32FC1)
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    expected = torch.from_numpy(np.stack(theirs))
    oracle("rectification, cv2.initUndistortRectifyMap", flow + torch.stack([x, y]), expected, 1e-3)
    assert flow.abs().max() > 10


def project(camera: Camera, points: np.ndarray) -> np.ndarray:
    """Project points (2, N) of the plane z = 1 by OpenCV or in closed form -> (2, N), px."""
    matrix, vector, space = (
        np.array(camera.matrix),
        np.array(camera.coefficients),
        np.vstack([points, 0 * points[:1] + 1]),
    )
    if camera.model == "fisheye":
        return cv2.fisheye.projectPoints(space.T[:, None].copy(), np.zeros(3), np.zeros(3), matrix, vector)[0][:, 0].T
    if camera.model == "opencv":
        return cv2.projectPoints(space.T.copy(), np.zeros(3), np.zeros(3), matrix, vector)[0][:, 0].T
    r2 = (points**2).sum(axis=0)
    if camera.model == "division":
        scaled = points * 2 / (1 + np.sqrt(1 - 4 * vector[0] * r2))
    else:
        (x, y), (p1, p2, s1, s2, s3, s4) = points, vector[6:]
        g = 1 + sum(k * r2**i for i, k in enumerate(vector[:6], start=1))
        bent_x = 2 * p1 * x * y + p2 * (r2 + 2 * x**2) + s1 * r2 + s2 * r2**2
        bent_y = p1 * (r2 + 2 * y**2) + 2 * p2 * x * y + s3 * r2 + s4 * r2**2
        scaled = points * g + np.stack([bent_x, bent_y])
    return scaled * [[camera.fx], [camera.fy]] + [[camera.cx], [camera.cy]]


@every_model
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_flow_points_to_where_the_camera_shows_the_ray_of_a_pixel(camera, dtype, oracle):
    degraded = Rectification(camera, tolerance_px=None).degrade(torch.zeros(1, 1, 27, 48, dtype=dtype), seed=0)
    pixels = np.mgrid[:27, :48][::-1].reshape(2, -1).astype(float)
    rays = (pixels - [[camera.cx], [camera.cy]]) / [[camera.fx], [camera.fy]]
    ours = degraded.flow[0].double().reshape(2, -1) + torch.from_numpy(pixels)
    bar = 1e-9 if dtype is torch.float64 else 1e-4
    oracle(f"rectification of each model, {dtype}", ours, torch.from_numpy(project(camera, rays)), bar)
    # The restore flow points to the ray that the camera shows at the pixel.
    clean = (degraded.restore_flow[0].double().reshape(2, -1).numpy() + pixels - [[camera.cx], [camera.cy]]) / [
        [camera.fx],
        [camera.fy],
    ]
    oracle(
        f"restore flow of each model, {dtype}", torch.from_numpy(project(camera, clean)), torch.from_numpy(pixels), bar
    )
    assert degraded.restore_valid.double().mean() > 0.7


def test_one_sampling_with_a_lens_keeps_more_than_two():
    camera = ALL["fisheye"].resized(width=480, height=270)
    y, x = torch.meshgrid(torch.arange(270).double(), torch.arange(480).double(), indexing="ij")

    def scene(u: Tensor, v: Tensor) -> Tensor:
        return 0.5 + 0.4 * torch.sin(u / 2.3) * torch.cos(v / 2.9)  # fine, so that sampling blurs it

    raw = scene(x, y)[None, None]
    rectify, lens = Rectification(camera), LensDistortion()
    degraded = Compose([rectify, lens]).degrade(raw, seed=3)
    first, second = rectify.apply(raw, degraded.params.children[0]), lens.apply(raw, degraded.params.children[1])
    twice = lens.apply(first.image, degraded.params.children[1]).image
    clean = torch.stack([x, y]) + second.flow[0]
    rays = (clean.reshape(2, -1).numpy() - [[camera.cx], [camera.cy]]) / [[camera.fx], [camera.fy]]
    u, v = torch.from_numpy(project(camera, rays)).view(2, 270, 480)
    seen = degraded.valid[0, 0] & (u > 2) & (u < 477) & (v > 2) & (v < 267)
    assert seen.double().mean() > 0.5
    once, both = (
        -10 * (image[0, 0] - scene(u, v))[seen].square().mean().log10().item() for image in (degraded.image, twice)
    )
    assert once > both + 2, (once, both)


@pytest.mark.parametrize(
    ("name", "tolerance_px", "frame"), [("opencv14", None, "pad"), ("fisheye", 0.05, "pad"), ("opencv5", 0.05, "crop")]
)
def test_one_graph_gives_the_same_as_eager_mode(name, tolerance_px, frame):
    effect, image = Rectification(ALL[name], tolerance_px=tolerance_px, frame=frame), smooth(2, 3, 27, 48)
    assert (effect.plan(27, 48).stride > 1) == (tolerance_px is not None)
    compiled = torch.compile(effect, fullgraph=True, backend="eager")
    assert_close(compiled(image), effect(image), rtol=0, atol=2e-4)


def test_a_composition_shares_its_tolerance_with_a_rectification():
    camera = ALL["opencv8"].resized(width=480, height=270)
    parts = [
        [Rectification(camera, tolerance_px=t), LensDistortion(k1_range=(-0.25, -0.2), tolerance_px=t)]
        for t in (1.0, None)
    ]
    near = Compose(parts[0], tolerance_px=0.1)
    plan = near.plan(270, 480)
    assert plan.groups[0].stride > 1
    image = torch.rand(2, 1, 270, 480, dtype=torch.float64)
    flow, exact = (effect.degrade(image, seed=2).flow for effect in (near, Compose(parts[1])))
    assert (flow - exact).square().sum(dim=1).sqrt().max() <= plan.error_px <= 0.1


def test_a_plan_needs_the_shape_of_the_frames_of_the_camera():
    effect = Rectification(DASHCAM, tolerance_px=0.05)
    assert effect.plan(720, 1280).stride > 8
    assert effect.plan(720, 1280).max_gradient < 0.5
    with pytest.raises(ValueError, match="image must have the shape of the camera's frames"):
        effect.plan(720, 720)


def test_a_camera_without_distortion_returns_the_image():
    image = torch.rand(2, 3, 27, 48)
    still = Camera(width=48, height=27, fx=43.0, fy=42.5, cx=25.0, cy=14.1, coefficients=(0.0,) * 5)
    assert torch.equal(Rectification(still)(image), image)


# r (1 - 0.4 r^2) falls beyond r^2 = 1 / 1.2, and theta (1 - 0.6 theta^2) beyond theta^2 = 1 / 1.8.
@pytest.mark.parametrize(("model", "k1", "edge"), [("opencv", -0.4, 1.2**-0.5), ("fisheye", -0.6, math.tan(1.8**-0.5))])
def test_a_model_that_folds_inside_the_frame_warns(model, k1, edge):
    pinhole: dict[str, Any] = PINHOLE | {"fx": 24.0, "fy": 24.0}
    folding = Camera(**pinhole, coefficients=(k1, 0.0, 0.0, 0.0), model=model)
    with pytest.warns(UserWarning, match="camera: the model folds back inside the frame"):
        degraded = Rectification(folding).degrade(torch.rand(1, 3, 27, 48), seed=0)
    y, x = torch.meshgrid(torch.arange(27.0), torch.arange(48.0), indexing="ij")
    r = torch.hypot(x - folding.cx, y - folding.cy) / 24
    clear = (r - edge).abs() > 1e-4
    assert 0.02 < (r > edge).double().mean() < 0.5
    assert torch.equal(degraded.valid[0, 0][clear], (r < edge)[clear])


def test_frames_of_another_shape_raise():
    with pytest.raises(ValueError, match="image must have the shape of the camera's frames, 48 x 27 px, got 48 x 48"):
        Rectification(SMALL)(torch.rand(1, 3, 48, 48))


def test_invalid_cameras_raise():
    with pytest.raises(TypeError, match="camera must be a Camera, got dict"):
        Rectification({"fx": 1.0})  # pyright: ignore[reportArgumentType]
    # 1 - 2 r^2 is zero at r = 0.707, 1 - 3 r^2 at 0.577; the upper left corner is at 0.67 focal lengths.
    Rectification(Camera(**PINHOLE, coefficients=(0.0,) * 5 + (-2.0, 0.0, 0.0)))
    with pytest.raises(
        ValueError, match=r"above zero inside the frame, up to r = 0.6\d+ focal lengths, got zero at r = 0.577"
    ):
        Rectification(Camera(**PINHOLE, coefficients=(0.0,) * 5 + (-3.0, 0.0, 0.0)))
