from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import torch
from scipy import special
from torch import Tensor
from torch.autograd import forward_ad

from torchrefract import _compiled as compiled
from torchrefract import random
from torchrefract.fields import perlin_drawn
from torchrefract.fields.perlin import perlin_noise
from torchrefract.fields.perlin_drawn import Coarse, Drawn, drawn_noise
from torchrefract.fields.perlin_lattice import octave
from torchrefract.warping.lattice import Lattice

pytest.importorskip("torchrefract._jit", reason="needs numba")
LONG = (4.0, 8.0, 16.0, 32.0, 64.0, 128.0)
SHORT = tuple(period / 7.5 for period in LONG)  # as in a frame 256 px wide
BAR = 3e-7  # of noise in float32, whose weights have the sum 1


def frames(count: int, *, seed: int = 5, still: bool = False) -> Drawn:
    """Of samples that differ in all, the first at rest."""
    each = torch.arange(count).double()
    key = random.noise_key(random.stream(seed, torch.arange(count)))
    wind = torch.stack([1.3 - each, 0.2 * each - 0.1], dim=1)
    return Drawn(key, 0 * each if still else 3.5 * each, wind, 40 + each)


def alone(drawn: Drawn, rows: list[int]) -> Drawn:
    return Drawn(*(value[rows] for value in drawn))


def weights_of(count: int, octaves: int, dtype: torch.dtype = torch.float32) -> Tensor:
    found = 0.1 + torch.rand(count, octaves, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    return (found / found.sum(dim=1, keepdim=True)).to(dtype)


def noise_of(
    drawn: Drawn, periods: tuple[float, ...], size: tuple[int, int], dtype=torch.float32, coarse: Coarse | None = None
) -> Tensor:
    weights = weights_of(len(drawn.key), len(periods)).to(dtype)
    if coarse is not None:
        coarse = coarse._replace(weights=coarse.weights.to(dtype))
    return drawn_noise(drawn, list(enumerate(periods)), weights, height=size[0], width=size[1], coarse=coarse)


def coarse_of(count: int, size: tuple[int, int], stride: int) -> Coarse:
    return Coarse([(7, 60.0), (8, 4.3 * stride)], weights_of(count, 2).flip(1), Lattice(*size, stride))


def in_pytorch(drawn: Drawn, periods: tuple[float, ...], size: tuple[int, int], weights: Tensor) -> Tensor:
    motion: Any = {**drawn._asdict(), "height": size[0], "width": size[1], "dtype": weights.dtype}
    key = motion.pop("key")
    return perlin_noise([octave(key, i, period=period, **motion) for i, period in enumerate(periods)], weights)


@pytest.fixture
def asked(monkeypatch) -> list[str]:
    """The kernels that are called."""
    found, kernels = list[str](), compiled.kernels

    def counted(name: str) -> object:
        found.append(name)
        return kernels(name)

    monkeypatch.setattr(perlin_drawn, "kernels", counted)
    return found


@pytest.mark.parametrize("still", [True, False])
@pytest.mark.parametrize(
    ("periods", "size"),
    [
        (LONG, (211, 1397)),
        (SHORT, (256, 256)),
        ((7.3, 2.5, 1.1, 1.0), (41, 29)),
        ((0.5, 0.013), (31, 27)),
        ((0.501, 0.7), (33, 4100)),
        ((300.0, 1e9), (19, 140)),
        ((3.0,), (1, 1)),
        ((3.0, 0.2), (700, 3)),
    ],
)
def test_the_noise_is_that_of_float64(periods, size, still, asked, oracle):
    drawn = frames(3, still=still)
    found, exact = (noise_of(drawn, periods, size, dtype) for dtype in (torch.float32, torch.float64))
    assert asked == ["fields.kernels.drifts"]
    assert found.dtype == torch.float32
    assert exact.abs().max() > 1e-3
    oracle("Perlin noise by a kernel, float64", found, exact, BAR, unit="")


@pytest.mark.parametrize("frame", [1e4, -1e6])
def test_late_frames_are_those_of_float64(frame, oracle):
    drawn = frames(2)._replace(frame=torch.full((2,), frame).double())
    found, exact = (noise_of(drawn, LONG, (97, 130), dtype) for dtype in (torch.float32, torch.float64))
    oracle("Perlin noise by a kernel, late in a clip", found, exact, BAR, unit="")


@pytest.mark.parametrize("stride", [2, 3, 7, 16, 20, 100])
@pytest.mark.parametrize("size", [(75, 131), (9, 5), (1, 1), (40, 700)])
def test_coarse_octaves_are_those_of_float64(size, stride, asked, oracle):
    drawn, coarse = frames(2), coarse_of(2, size, stride)
    found, exact = (noise_of(drawn, (5.0, 9.0), size, dtype, coarse) for dtype in (torch.float32, torch.float64))
    assert asked == ["fields.kernels.drifts"]
    oracle("Perlin noise and a lattice by a kernel, float64", found, exact, 2 * BAR, unit="")
    alone = noise_of(drawn, (), size, torch.float32, coarse)
    expected = noise_of(drawn, (), size, torch.float64, coarse)
    oracle("a lattice of Perlin noise by a kernel, float64", alone, expected, BAR, unit="")
    assert expected.abs().max() > 1e-3


@pytest.mark.parametrize(
    ("periods", "size", "stride"), [(SHORT, (150, 256), 3), (LONG, (270, 481), 5), ((2.7, 0.3), (401, 90), 8)]
)
def test_batch_and_threads_change_no_bit(periods, size, stride, on_threads):
    drawn, weights, whole = frames(4), weights_of(4, len(periods)), coarse_of(4, size, stride)

    def made(rows: list[int], coarse: Coarse | None) -> Tensor:
        place: Any = {"height": size[0], "width": size[1], "coarse": coarse}
        return drawn_noise(alone(drawn, rows), list(enumerate(periods)), weights[rows], **place)

    for coarse in (None, whole):
        together = made([0, 1, 2, 3], coarse)
        for threads in (1, 2, 3, 8):
            on_threads(threads)
            for rows in ([0, 1, 2, 3], [1], [3], [3, 1, 0], [2, 2]):
                own = None if coarse is None else coarse._replace(weights=coarse.weights[rows])
                assert torch.equal(made(rows, own), together[rows])


@pytest.mark.parametrize("coarse", [None, coarse_of(3, (61, 100), 4)])
def test_any_part_of_the_rows_is_made_as_in_the_whole(coarse, monkeypatch):
    drawn, ends = frames(3), [0, 1, 2, 17, 61, 62, 130, 183]
    whole = noise_of(drawn, SHORT, (61, 100), coarse=coarse)

    def in_pieces(work: Any, count: int, *, least: int) -> None:
        assert count == ends[-1]
        assert least > 0
        for start, stop in reversed(list(pairwise(ends))):
            work(start, stop)

    monkeypatch.setattr(perlin_drawn, "share", in_pieces)
    assert torch.equal(noise_of(drawn, SHORT, (61, 100), coarse=coarse), whole)


@pytest.mark.parametrize("shape", [(0, 5, 7), (2, 0, 7), (2, 5, 0)])
def test_of_nothing_there_is_nothing(shape):
    count, height, width = shape
    assert noise_of(alone(frames(2), list(range(count))), (3.0,), (height, width)).shape == (count, 1, *shape[1:])


@pytest.mark.parametrize("which", ["weights", "frame", "wind", "decorrelation", "coarse"])
def test_what_learns_has_the_gradients_of_pytorch(which, asked):
    size: Any = {"height": 20, "width": 30}
    inputs = {"weights": weights_of(2, 2), "coarse": weights_of(2, 2), **frames(2)._asdict()}
    inputs[which].requires_grad_()
    drawn, coarse = Drawn(*(inputs[name] for name in Drawn._fields)), coarse_of(2, (20, 30), 4)
    coarse = coarse._replace(weights=inputs["coarse"])
    found = drawn_noise(drawn, [(0, 3.0), (1, 9.0)], inputs["weights"], **size, coarse=coarse)
    slope = torch.autograd.grad(found.square().sum(), inputs[which])[0]
    assert slope.isfinite().all()
    assert slope.abs().max() > 0
    assert not asked
    with torch.no_grad():
        again = drawn_noise(drawn, [(0, 3.0), (1, 9.0)], inputs["weights"], **size, coarse=coarse)
    assert asked
    torch.testing.assert_close(again, found.detach(), rtol=0, atol=1e-6)


@pytest.mark.filterwarnings("ignore:.torch.jit.script. is deprecated:FutureWarning")  # of torch.func.jvp
def test_maps_graphs_and_forward_gradients_are_pytorchs(asked):
    drawn, weights, size = frames(2), weights_of(2, 2), (20, 30)

    def made(weights: Tensor, *drawn: Tensor) -> Tensor:
        return drawn_noise(Drawn(*drawn), [(0, 3.0), (1, 9.0)], weights, height=size[0], width=size[1])

    expected = in_pytorch(drawn, (3.0, 9.0), size, weights)
    assert torch.equal(torch.compile(made, fullgraph=True, backend="eager")(weights, *drawn), expected)
    assert noise_of(drawn, (3.0, 9.0), size, torch.float64).dtype == torch.float64
    mapped = torch.vmap(lambda w, *d: made(w[None], *(value[None] for value in d))[0])(weights, *drawn)
    torch.testing.assert_close(mapped, expected, rtol=0, atol=1e-6)
    with forward_ad.dual_level():
        made(forward_ad.make_dual(weights, weights), *drawn)
    assert not asked


def test_the_inverse_of_the_error_function_has_no_error_of_its_own():
    kernels = compiled.kernels("fields.kernels.nodes")
    words = np.unique(np.concatenate([np.arange(3000), np.geomspace(1, 2**22, 3000).astype(np.int64)]))
    words = np.concatenate([words, 2**23 - 1 - words])
    x = 2 * (words + 0.5) / 2**23 - 1
    found = np.array([kernels.inverse_error(value) for value in x])
    np.testing.assert_allclose(found, special.erfinv(x), rtol=4e-15, atol=0)


def test_without_numba_the_noise_is_pytorchs(monkeypatch):
    drawn, size = frames(2), (40, 50)
    monkeypatch.setattr(compiled, "kernels", lambda _: None)
    expected = in_pytorch(drawn, SHORT, size, weights_of(2, len(SHORT)))
    assert torch.equal(noise_of(drawn, SHORT, size), expected)
