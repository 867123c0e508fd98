"""Cameras of COLMAP's models are those of its formulas, in text, in binary files and in folders."""

import struct

import numpy as np
import pytest
import torch

from torchrefract.cameras.io import read_camera, read_covariance

RADIAL = (-0.28, 0.074, 2e-4, 1.8e-5)
EIGHT = (0.6, 0.12, 1e-3, -5e-4, 0.01, 0.95, 0.25, 0.03)
FISHEYE = (-0.0137, 0.0207, -0.0128, 0.0025)
# COLMAP's models by their numbers, with the parameters that its documentation lists.
COLMAP: dict[int, tuple[float, ...]] = {
    0: (510.25, 323.0, 237.625),
    1: (510.25, 505.75, 323.0, 237.625),
    2: (510.25, 323.0, 237.625, -0.1),
    3: (510.25, 323.0, 237.625, -0.1, 0.02),
    4: (510.25, 505.75, 323.0, 237.625, *RADIAL),
    5: (510.25, 505.75, 323.0, 237.625, *FISHEYE),
    6: (510.25, 505.75, 323.0, 237.625, *EIGHT),
    8: (510.25, 323.0, 237.625, -0.01),
    9: (510.25, 323.0, 237.625, -0.01, 0.05),
    12: (510.25, 323.0, 237.625, -0.1),
    13: (510.25, 505.75, 323.0, 237.625, -0.1),
    14: (510.25, 323.0, 237.625),
    15: (510.25, 505.75, 323.0, 237.625),
}
COLMAP_REFUSED = {
    7: ("FOV", 5),
    10: ("THIN_PRISM_FISHEYE", 12),
    11: ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
    16: ("EUCM", 6),
}


def colmap_bytes(cameras: dict[int, tuple[int, tuple[float, ...]]]) -> bytes:
    """Return a cameras.bin of cameras by their ids: number of the model and parameters."""
    data = struct.pack("<Q", len(cameras))
    for key, (kind, values) in cameras.items():
        data += struct.pack(f"<iiQQ{len(values)}d", key, kind, 640, 480, *values)
    return data


def colmap_pixels(kind: int, values: tuple[float, ...], rays: np.ndarray) -> np.ndarray:
    """Project rays (N, 3) by the formulas of COLMAP's documentation, to its coordinates."""
    x, y = rays[:, 0] / rays[:, 2], rays[:, 1] / rays[:, 2]
    if kind in (5, 8, 9, 14, 15):
        radius = np.hypot(x, y)
        x, y = (a * np.arctan(radius) / radius for a in (x, y))
    num_focal = 1 if kind in (0, 2, 3, 8, 9, 12, 14) else 2
    (*focal, cx, cy), lens = values[: num_focal + 2], values[num_focal + 2 :]
    r2 = x * x + y * y
    tangential = (0.0, 0.0)
    if kind in (12, 13):
        factor = 2 / (1 + np.sqrt(1 - 4 * lens[0] * r2))
    elif kind == 5:
        factor = 1 + sum(k * r2 ** (i + 1) for i, k in enumerate(lens))
    else:
        k = (*lens, *(0.0,) * (8 - len(lens)))
        factor = (1 + k[0] * r2 + k[1] * r2**2 + k[4] * r2**3) / (1 + k[5] * r2 + k[6] * r2**2 + k[7] * r2**3)
        p1, p2 = k[2:4]
        tangential = (2 * p1 * x * y + p2 * (r2 + 2 * x * x), 2 * p2 * x * y + p1 * (r2 + 2 * y * y))
    u, v = (a * factor + b for a, b in zip((x, y), tangential, strict=True))
    return np.stack([focal[0] * u + cx, focal[-1] * v + cy], axis=1)


@pytest.mark.parametrize("kind", COLMAP)
def test_colmap_cameras_project_half_a_pixel_lower_than_by_their_formulas(kind, rays, tmp_path, oracle):
    path = tmp_path / "cameras.bin"
    path.write_bytes(colmap_bytes({3: (kind, COLMAP[kind]), 7: (1, COLMAP[1])}))
    result = read_camera(path, name=3).project(rays)
    assert result.valid.all()
    expected = torch.from_numpy(colmap_pixels(kind, COLMAP[kind], rays.numpy())) - 0.5
    oracle("pixels of COLMAP", result.points, expected, 1e-9)


def test_a_folder_of_colmap_is_read_and_the_camera_is_asked_for(tmp_path):
    (tmp_path / "sparse" / "0").mkdir(parents=True)
    path = tmp_path / "sparse" / "0" / "cameras.bin"
    path.write_bytes(colmap_bytes({1: (4, COLMAP[4]), 2: (7, (510.25, 505.75, 323.0, 237.625, 0.9))}))
    assert read_camera(tmp_path, name=1).coefficients == RADIAL  # camera 2, which is refused, is not asked for
    assert read_covariance(tmp_path) is None
    with pytest.raises(ValueError, match=r"name must be one of the cameras in .*: 1, 2; got None"):
        read_camera(tmp_path)
    with pytest.raises(
        ValueError, match=r"path must have a camera model of SIMPLE_PINHOLE, .*, got .* with FOV; reconstr"
    ):
        read_camera(tmp_path, name=2)
    path.with_suffix(".txt").write_text("1 PINHOLE 640 480 510.25 505.75 323.0 237.625\n")
    with pytest.raises(ValueError, match=r"path must be a folder .*cameras.bin, .*cameras.txt; state the file"):
        read_camera(tmp_path)


@pytest.mark.parametrize("kind", COLMAP_REFUSED)
def test_other_models_of_colmap_are_refused_by_name(kind, tmp_path):
    name, count = COLMAP_REFUSED[kind]
    (tmp_path / "cameras.bin").write_bytes(colmap_bytes({1: (kind, (1.0,) * count)}))
    with pytest.raises(ValueError, match=f"got .*cameras.bin with {name}; reconstruct"):
        read_camera(tmp_path / "cameras.bin")


DAMAGED: dict[str, tuple[str, bytes, str]] = {
    "a database": ("database.db", b"SQLite format 3", "got the database .*; export it by colmap model_converter"),
    "cut off": ("cameras.bin", colmap_bytes({1: (1, COLMAP[1])})[:-8], "must hold the cameras that it counts"),
    "longer": (
        "cameras.bin",
        colmap_bytes({1: (1, COLMAP[1])}) + bytes(8),
        "end after its 1 cameras, got .* 8 bytes more",
    ),
    "another number": (
        "cameras.bin",
        colmap_bytes({1: (40, COLMAP[1])}),
        "must have camera models of 0 to 17, got .* 40",
    ),
    "an id twice": ("cameras.txt", b"1 PINHOLE 9 9 5 5 4 4\n" * 2, "must hold each camera once, got .* with 1 twice"),
}


@pytest.mark.quick
@pytest.mark.parametrize("case", DAMAGED)
def test_damaged_files_of_colmap_raise(case, tmp_path):
    name, content, rule = DAMAGED[case]
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ValueError, match=rule):
        read_camera(tmp_path / name)
