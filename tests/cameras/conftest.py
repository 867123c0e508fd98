import json
from collections.abc import Callable

import pytest
import torch

from torchrefract import Camera

_MODELS = {"opencv5": "opencv", "rational8": "opencv", "thin-prism12": "opencv", "fisheye4": "fisheye"}


@pytest.fixture(scope="session")
def published(shared_data) -> dict[str, Camera]:
    """Return the published cameras with a focal length by their ids."""
    rows = json.loads((shared_data / "lenses.json").read_text())
    return {
        row["id"]: Camera(
            width=int(row["width"]),
            height=int(row["height"]),
            **{name: float(row[name]) for name in ("fx", "fy", "cx", "cy")},
            coefficients=tuple(row["coeffs"]) or (0.0,) * 4,
            model=_MODELS.get(row["model"], "opencv"),
        )
        for row in rows
        if row["fx"]
    }


@pytest.fixture
def make_camera() -> Callable[..., Camera]:
    """Return a function that creates a camera of 640 x 480 px."""

    def make(coefficients: tuple[float, ...], model: str = "opencv") -> Camera:
        numbers = {"fx": 510.25, "fy": 505.75, "cx": 322.5, "cy": 237.125}
        return Camera(width=640, height=480, **numbers, coefficients=coefficients, model=model)

    return make


@pytest.fixture
def rays() -> torch.Tensor:
    """Return rays (50, 3), float64, up to 35 degrees from the axis."""
    points = torch.rand(50, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return torch.cat([points - 0.5, torch.ones(50, 1, dtype=torch.float64)], dim=1)
