"""Lenses and splines, here and at the peers, on one frame."""

import importlib
import math
from collections.abc import Mapping
from types import ModuleType
from typing import Any

import torch
import torch.nn.functional as F
from timing import Candidate
from torch import Tensor

from torchrefract import LensDistortion, ThinPlateSpline, warp
from torchrefract.fields.lens import lens_restore_flow
from torchrefract.warping.grid import pixel_axes

SPLINE_PX = 5.0
TOLERANCE_PX = 0.05
_K1, _K2, _P, _FOCAL = -0.25, 0.09, 0.0005, 0.9


def candidates(frame: Tensor, pixels: Any, peers: Mapping[str, ModuleType]) -> dict[str, Candidate]:
    """Lenses and splines on a frame (1, 3, H, W), and on the same as uint8 HxWx3, by job and name."""
    found = _ours(frame, pixels)
    if "kornia" in peers:
        found |= _kornia(frame)
    if "torch_tps" in peers:
        found |= _torch_tps(peers["torch_tps"], frame)
    if "cv2" in peers:
        found |= _opencv(peers["cv2"], pixels)
    return found


def _ours(frame: Tensor, pixels: Any) -> dict[str, Candidate]:
    strength: dict[str, Any] = {"amplitude_range": (SPLINE_PX, SPLINE_PX)}
    one: dict[str, Any] = {"k1_range": (_K1, _K1), "k2_range": (_K2, _K2), "focal_range": (_FOCAL, _FOCAL)}
    within = f"within {TOLERANCE_PX} px"
    mild, of_opencv = LensDistortion(**one, tolerance_px=TOLERANCE_PX), torch.from_numpy(pixels).permute(2, 0, 1)
    effects = {
        "lens: ours LensDistortion, exact": LensDistortion(tolerance_px=None),
        f"lens: ours LensDistortion, the peers' lens {within}": mild,
        "spline: ours ThinPlateSpline, exact": ThinPlateSpline(**strength, tolerance_px=None),
        f"spline: ours ThinPlateSpline {within}": ThinPlateSpline(**strength, tolerance_px=TOLERANCE_PX),
    }
    found: dict[str, Candidate] = {name: lambda effect=effect: effect(frame) for name, effect in effects.items()}
    height, width = frame.shape[2:]
    coefficients = torch.tensor([[_K1, _K2, 0, 0, 0, 0, _P, _P, 0, 0, 0, 0]])
    focal = torch.full((1, 2), _FOCAL * width)
    center = torch.tensor([[width - 1, height - 1]]) / 2

    def closed_form() -> Tensor:
        flow, _ = lens_restore_flow(coefficients, focal, center, height=height, width=width)
        return warp(frame, flow)[0]

    return found | {
        f"lens: ours LensDistortion on bytes, {within}": lambda: mild(of_opencv).permute(1, 2, 0),
        "lens: ours closed form": closed_form,
    }


def _kornia(frame: Tensor) -> dict[str, Candidate]:
    augmentation = importlib.import_module("kornia.augmentation")
    calibration = importlib.import_module("kornia.geometry.calibration")
    transform = importlib.import_module("kornia.geometry.transform")
    height, width = frame.shape[2:]
    camera = torch.tensor([_camera(height, width)])
    lens = torch.tensor([[_K1, _K2, _P, _P, 0.0]])
    to_sampler = torch.tensor([2 / width, 2 / height])  # of px
    side = torch.linspace(-1, 1, 4)
    points = torch.cartesian_prod(side, side)[None]
    five = augmentation.RandomThinPlateSpline(scale=math.sqrt(3) * SPLINE_PX * 2 / width, p=1.0)

    def sixteen() -> Tensor:
        moved = points + SPLINE_PX * to_sampler * torch.randn_like(points)
        kernel, affine = transform.get_tps_transform(moved, points)
        return transform.warp_image_tps(frame, points, kernel, affine)

    return {
        "lens: kornia undistort_image": lambda: calibration.undistort_image(frame, camera, lens),
        "spline: kornia RandomThinPlateSpline, 5 points": lambda: five(frame),
        "spline: kornia warp_image_tps": sixteen,
    }


def _torch_tps(package: Any, frame: Tensor) -> dict[str, Candidate]:
    height, width = frame.shape[2:]
    x, y = pixel_axes(height, width, dtype=frame.dtype, device=frame.device)
    at = torch.stack([x.expand(1, 1, height, width), y.expand(1, 1, height, width)], dim=-1).view(-1, 2)
    points = torch.cartesian_prod(torch.linspace(0, width - 1, 4), torch.linspace(0, height - 1, 4))
    size = torch.tensor([width, height])

    def sixteen() -> Tensor:
        spline = package.ThinPlateSpline().fit(points, points + SPLINE_PX * torch.randn_like(points))
        grid = ((2 * spline.transform(at) + 1) / size - 1).view(1, height, width, 2)
        return F.grid_sample(frame, grid, mode="bilinear", padding_mode="reflection", align_corners=False)

    return {"spline: torch-tps ThinPlateSpline + grid_sample": sixteen}


def albumentations(package: Any, width: int) -> dict[str, Any]:
    """The transforms for a frame of a width in px, by job and name."""
    share = 10 * SPLINE_PX / width
    return {
        "lens: albumentations OpticalDistortion": package.OpticalDistortion(distort_limit=(_K1, _K1), p=1.0),
        "spline: albumentations ThinPlateSpline": package.ThinPlateSpline(
            scale_range=(share, share), num_control_points=4, p=1.0
        ),
    }


def _opencv(package: Any, pixels: Any) -> dict[str, Candidate]:
    height, width = pixels.shape[:2]
    camera = torch.tensor(_camera(height, width), dtype=torch.float64).numpy()
    lens = torch.tensor([_K1, _K2, _P, _P, 0.0], dtype=torch.float64).numpy()

    def undistort() -> Any:
        maps = package.initUndistortRectifyMap(camera, lens, None, camera, (width, height), package.CV_32FC1)
        return package.remap(pixels, *maps, package.INTER_LINEAR)

    return {"lens: OpenCV initUndistortRectifyMap + remap": undistort}


def _camera(height: int, width: int) -> list[list[float]]:
    focal = _FOCAL * width
    return [[focal, 0.0, (width - 1) / 2], [0.0, focal, (height - 1) / 2], [0.0, 0.0, 1.0]]
