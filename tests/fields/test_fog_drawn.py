import math
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.autograd import forward_ad

from torchrefract import _compiled as compiled
from torchrefract import random
from torchrefract.fields import fog_drawn, fog_volume
from torchrefract.fields.fog_volume import path_mean

pytest.importorskip("torchrefract._jit", reason="needs numba")
FOUR, REACH = (12.0, 24.0, 48.0, 96.0), 400.0
BAR = 2e-6  # of means around 1


def view(height: int, width: int) -> dict[str, Any]:
    longer = 0.9 * max(height, width)
    return {"height": height, "width": width, "focal": (longer, longer), "center": ((width - 1) / 2, (height - 1) / 2)}


def fogs(count: int, scales: int = 4) -> dict[str, Tensor]:
    """Each moves and changes in its own way, the first is at rest; of the second, an octave has no weight."""
    each = torch.arange(count).double()
    weights = 0.1 + torch.rand(count, scales, generator=torch.Generator().manual_seed(1))
    weights[1:2, : scales // 2] = 0
    return {
        "key": random.noise_key(random.stream(5, torch.arange(count))),
        "weights": weights,
        "contrast": 0.6 + 0.1 * each.float(),
        "frame": 3.5 * each,
        "wind": torch.stack([1.3 - each, 0.2 * each - 0.1, 0.5 - 2 * each], dim=1),
        "decorrelation": 40 + each,
    }


def far(count: int, height: int, width: int) -> Tensor:
    """Distances from 0 on, some infinite, without order; of the same in a row, 1 wide."""
    found = 900 * torch.rand(count, 1, height, width, generator=torch.Generator().manual_seed(2)) ** 2
    found.flatten()[::7], found.flatten()[3::11] = 0.0, math.inf
    return found


def ground(height: int, *, horizon: float = 0.5) -> Tensor:
    """Distances by row, as those of a road."""
    below = (torch.arange(height) + 0.5) / height - horizon
    return torch.where(below > 0, 1.3 * 0.9 / below.clamp(min=1e-9), 200.0).clamp(max=200.0)[None, None, :, None]


def field(fog: dict[str, Tensor], distance: Tensor, dtype: torch.dtype = torch.float32, **options: Any) -> Tensor:
    options = {"scales": FOUR, "reach": REACH, **options}
    fog = {name: value.to(dtype) if name in ("weights", "contrast") else value for name, value in fog.items()}
    return path_mean(distance=distance.to(dtype), dtype=dtype, **fog, **options)


def only(fog: dict[str, Tensor], rows: list[int]) -> dict[str, Tensor]:
    return {name: value[rows] for name, value in fog.items()}


@pytest.fixture(autouse=True)
def frames_of_all_sizes(monkeypatch) -> None:
    """By kernels, too, where they are small."""
    monkeypatch.setattr(fog_volume, "_FEWEST", 0)


@pytest.fixture
def asked(monkeypatch) -> list[str]:
    """The kernels that are called."""
    found, kernels = list[str](), compiled.kernels

    def counted(name: str) -> object:
        found.append(name)
        return kernels(name)

    monkeypatch.setattr(fog_drawn, "kernels", counted)
    return found


SIZES = [(256, 256), (1080, 1920), (1, 1), (700, 3), (3, 700), (300, 170), (41, 29)]


@pytest.mark.parametrize("size", SIZES)
def test_means_are_those_of_float64(size, asked, oracle):
    fog, place = fogs(3), view(*size)
    for distance in (far(3, size[0], 1), far(1, size[0], 1), ground(size[0])):
        found, exact = (field(fog, distance, dtype, **place) for dtype in (torch.float32, torch.float64))
        assert found.dtype == torch.float32
        assert found.min() >= 0
        assert (exact - 1).abs().max() > 0.02
        oracle("fog in space by a kernel, distances by row, float64", found, exact, BAR, unit="")
    assert "fields.kernels.volumes" in asked


@pytest.mark.parametrize("size", SIZES[:1] + SIZES[2:])
def test_means_at_distances_by_pixel_are_those_of_float64(size, asked, oracle):
    fog, place = fogs(2), view(*size)
    for distance in (far(2, *size), far(1, *size), ground(size[0]).expand(-1, -1, -1, size[1])):
        found, exact = (field(fog, distance, dtype, **place) for dtype in (torch.float32, torch.float64))
        oracle("fog in space by a kernel, distances by pixel, float64", found, exact, BAR, unit="")
    assert "fields.kernels.volumes" in asked


@pytest.mark.parametrize("columns", [13, 29, 45])
@pytest.mark.parametrize("by_pixel", [False, True])
def test_rays_that_fill_whole_groups_reach_the_last_pixel(columns, by_pixel, monkeypatch, oracle):
    height, width = 192, 4 * columns  # and with the three that lie beyond them rays are 16, 32 or 48
    empty = np.empty

    def garbage(shape: Any, dtype: Any = np.float64, **options: Any) -> np.ndarray:
        made = empty(shape, dtype, **options)
        if np.issubdtype(dtype, np.floating):
            made.fill(np.nan)
        return made

    fog, distance = fogs(2), far(2, height, width if by_pixel else 1)
    expected = field(fog, distance, torch.float64, **view(height, width))
    monkeypatch.setattr(np, "empty", garbage)
    found = field(fog, distance, **view(height, width))
    oracle("means along rays in whole groups, float64", found, expected, BAR, unit="")


@pytest.mark.parametrize(
    ("scales", "reach"),
    [
        ((30.0,), 400.0),
        ((10.0, 0.01), 400.0),
        ((1e-3,), 400.0),
        ((1e9, 20.0), 400.0),
        ((9.0, 5.0, 17.0, 31.0, 8.0, 3.0), 200.0),
        (FOUR, 1.0),
        (FOUR, 1e5),
        ((300.0, 9000.0), 1e5),
    ],
)
def test_means_of_other_scales_are_those_of_float64(scales, reach, oracle):
    fog, place = fogs(2, len(scales)), view(90, 160)
    fog["weights"][1] = 1
    for distance in (far(2, 90, 1) * (reach / 400), ground(90)):
        found, exact = (
            field(fog, distance, dtype, scales=scales, reach=reach, **place) for dtype in (torch.float32, torch.float64)
        )
        oracle("fog in space of other scales by a kernel, float64", found, exact, BAR, unit="")


@pytest.mark.parametrize(
    "camera",
    [
        {"focal": (40.0, 55.0), "center": (31.0, 40.0)},
        {"focal": (900.0, 900.0), "center": (80.0, 40.0)},
        {"focal": (90.0, 90.0), "center": (-400.0, 300.0)},
    ],
    ids=["wide", "narrow", "of a part of a frame"],
)
def test_means_before_any_camera_are_those_of_float64(camera, oracle):
    fog, place = fogs(2), view(90, 160) | camera
    for distance in (far(2, 90, 1), ground(90)):
        found, exact = (field(fog, distance, dtype, **place) for dtype in (torch.float32, torch.float64))
        oracle("fog in space before any camera by a kernel, float64", found, exact, BAR, unit="")


@pytest.mark.parametrize(("contrast", "bar"), [(0.0, 0.0), (2.0, 4 * BAR), (30.0, 1e-3)])
def test_means_of_any_contrast_are_those_of_float64(contrast, bar, oracle):
    fog, place = fogs(2) | {"contrast": torch.full((2,), contrast)}, view(90, 160)
    found, exact = (field(fog, far(2, 90, 1), dtype, **place) for dtype in (torch.float32, torch.float64))
    oracle(f"fog in space by a kernel, contrast {contrast:g}, float64", found, exact, bar, unit="")


@pytest.mark.parametrize("frame", [1e4, -1e6])
def test_late_frames_are_those_of_float64(frame, oracle):
    fog, place = fogs(2) | {"frame": torch.full((2,), frame).double()}, view(90, 160)
    found, exact = (field(fog, far(2, 90, 1), dtype, **place) for dtype in (torch.float32, torch.float64))
    oracle("fog in space by a kernel, late in a clip", found, exact, BAR, unit="")


@pytest.mark.parametrize("contrast", [0.6, 2.0])
def test_a_kernel_is_as_near_to_float64_as_pytorch_in_float32(contrast, monkeypatch):
    fog, place, distance = fogs(4) | {"contrast": torch.full((4,), contrast)}, view(256, 256), far(4, 256, 1)
    found, exact = (field(fog, distance, dtype, **place) for dtype in (torch.float32, torch.float64))
    monkeypatch.setattr(compiled, "kernels", lambda _: None)
    plain = field(fog, distance, **place)
    error, usual = ((one - exact).abs() for one in (found, plain))
    assert error.max() < 1.5 * usual.max()
    assert error.square().mean() < 1.5 * usual.square().mean()


@pytest.mark.parametrize("size", [(150, 256), (27, 48), (9, 5)])
@pytest.mark.parametrize("columns", [False, True])
def test_batch_and_threads_change_no_bit(size, columns, on_threads):
    fog, place, distance = fogs(4), view(*size), far(4, size[0], size[1] if columns else 1)
    together = field(fog, distance, **place)
    for threads in (1, 2, 3):
        on_threads(threads)
        for rows in ([0, 1, 2, 3], [1], [3], [3, 1, 0], [2, 2]):
            assert torch.equal(field(only(fog, rows), distance[rows], **place), together[rows])


def test_of_many_frames_each_is_as_it_is_alone():
    fog, place = fogs(37), view(20, 30)
    for distance in (far(37, 20, 1), far(1, 20, 30), far(37, 20, 30)):
        together = field(fog, distance, **place)
        for row in (0, 15, 16, 36):
            own = distance[row : row + 1] if len(distance) > 1 else distance
            assert torch.equal(field(only(fog, [row]), own, **place), together[row : row + 1])


@pytest.mark.parametrize("columns", [1, 100])
def test_any_part_is_made_as_in_the_whole(columns, monkeypatch):
    fog, place, distance = fogs(3), view(61, 100), far(3, 61, columns)
    whole = field(fog, distance, **place)

    def in_pieces(work: Any, count: int, *, least: int) -> None:
        assert least > 0
        ends = [0, 1, 2, 17, 32, 33, 47, 61, count] if count > 61 else range(count + 1)
        for start, stop in reversed(list(pairwise(ends))):
            work(start, stop)

    monkeypatch.setattr(fog_drawn, "share", in_pieces)
    assert torch.equal(field(fog, distance, **place), whole)


@pytest.mark.parametrize("columns", [1, 160])
def test_what_is_not_asked_for_changes_no_bit(columns):
    fog, place = fogs(1), view(90, 160)
    for distance in (
        far(1, 90, columns) / 3,
        ground(90).expand(-1, -1, -1, columns),
        torch.full((1, 1, 90, columns), 7.0),
    ):
        near, deep = distance.clamp(max=150), distance.clamp(max=150)
        # One row sees to the end of the fog.
        deep[:, :, 40] = math.inf
        some, all_of_it = (field(fog, one, **place) for one in (near, deep))
        same = [y for y in range(90) if y != 40]
        assert torch.equal(some[:, :, same], all_of_it[:, :, same])


def test_what_learns_has_the_gradients_of_pytorch(asked):
    place = view(20, 30)
    for name in ("weights", "contrast", "frame", "wind", "decorrelation", "distance"):
        inputs = fogs(2) | {"distance": far(2, 20, 1).clamp(1, 300)}
        inputs[name].requires_grad_()
        found = field(distance=inputs.pop("distance"), fog=inputs, **place) if name != "distance" else None
        if found is None:
            distance = inputs.pop("distance")
            found, inputs = field(inputs, distance, **place), {"distance": distance}
        slope = torch.autograd.grad(found.square().sum(), inputs[name])[0]
        assert slope.isfinite().all()
        assert slope.abs().max() > 0
    assert not asked
    with torch.no_grad():
        field(fogs(2), far(2, 20, 1).requires_grad_(), **place)
    assert asked


@pytest.mark.filterwarnings("ignore:.torch.jit.script. is deprecated:FutureWarning")  # of torch.func.jvp
def test_maps_graphs_and_forward_gradients_are_pytorchs(asked, monkeypatch):
    fog, distance, place = fogs(2), far(2, 20, 1), view(20, 30)

    def made(distance: Tensor, *values: Tensor) -> Tensor:
        return field(dict(zip(fog, values, strict=True)), distance, **place)

    compiled_ = torch.compile(made, fullgraph=True, backend="eager")(distance, *fog.values())
    mapped = torch.vmap(lambda d, *values: made(d[None], *(value[None] for value in values))[0])(
        distance, *fog.values()
    )
    with forward_ad.dual_level():
        made(forward_ad.make_dual(distance, distance), *fog.values())
    assert field(fog, distance, torch.float64, **place).dtype == torch.float64
    assert not asked
    found = made(distance, *fog.values())
    assert asked
    for other in (compiled_, mapped):
        torch.testing.assert_close(found, other, rtol=0, atol=2e-5)
    monkeypatch.setattr(compiled, "kernels", lambda _: None)
    assert torch.equal(made(distance, *fog.values()), mapped)


def test_small_frames_are_pytorchs(asked, monkeypatch):
    monkeypatch.undo()
    monkeypatch.setattr(fog_drawn, "kernels", lambda _: asked.append("any"))
    field(fogs(1), far(1, 27, 1), **view(27, 48))
    assert not asked


def test_the_exponential_has_no_error_of_its_own():
    kernels = compiled.kernels("fields.kernels.volumes")
    x = np.concatenate([np.linspace(-100, 89.5, 30001), np.geomspace(1e-30, 1, 3000), -np.geomspace(1e-30, 1, 3000)])
    x = x.astype(np.float32)
    with np.errstate(over="ignore"):
        exact = np.expm1(x.astype(np.float64))
        found, expected = np.array([kernels.less_one(value) for value in x]), exact.astype(np.float32)
    assert np.array_equal(np.isinf(found), np.isinf(expected))
    finite = np.isfinite(expected)
    np.testing.assert_allclose(found[finite], exact[finite], rtol=2e-7, atol=0)
    assert kernels.less_one(np.float32(0)) == 0
