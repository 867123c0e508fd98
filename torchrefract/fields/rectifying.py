"""The flow that shows the frames of a camera as another one would have taken them, from the same place."""

from dataclasses import replace

import torch
from torch import Tensor

from torchrefract._checks import check_positive
from torchrefract.cameras.models import Camera


def rectifying_flow(camera: Camera, *, zoom: float = 1.0) -> tuple[Tensor, Tensor, Camera]:
    """The flow that turns frames of a camera of any model into those of a pinhole.

        flow(p) = project((x, y, 1)) - p,  x = (u - cx) / (zoom fx),  y = (v - cy) / (zoom fy)

    Args:
        camera: of the frames.
        zoom: of its focal lengths; below 1 the pinhole sees more.

    Returns:
        flow: (1, 2, H, W), px; where the camera shows nothing of the ray, to outside the frame.
        exists: (1, 1, H, W), bool: the camera shows that ray.
        pinhole: the new camera.
    """
    zoom, height, width = check_positive("zoom", zoom), camera.height, camera.width
    pinhole = replace(camera, model="opencv", coefficients=(0.0,) * 4, fx=zoom * camera.fx, fy=zoom * camera.fy)
    v, u = torch.meshgrid(torch.arange(height).double(), torch.arange(width).double(), indexing="ij")
    x, y = (u - pinhole.cx) / pinhole.fx, (v - pinhole.cy) / pinhole.fy
    rays = torch.stack([x, y, torch.ones_like(x)], dim=-1).view(-1, 3)
    places, exists, _ = camera.project(rays)
    outside = places.new_tensor([-2.0 * width, -2.0 * height])
    flow = torch.where(exists[:, None], places, outside) - torch.stack([u, v], dim=-1).view(-1, 2)
    return flow.T.reshape(1, 2, height, width).float(), exists.view(1, 1, height, width), pinhole
