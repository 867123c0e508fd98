import os
import platform
import subprocess
import sys
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import torch
from scipy import special
from torch import Tensor
from torch.autograd import forward_ad

from torchrefract import _compiled as compiled
from torchrefract import draws
from torchrefract.fields import perlin_drawn
from torchrefract.fields.perlin import Nodes, perlin_noise
from torchrefract.fields.perlin_drawn import Drawn, Pixels, drawn_noise
from torchrefract.fields.perlin_lattice import octave
from torchrefract.warping.lattice import Lattice, between_nodes

pytest.importorskip("torchrefract._jit", reason="needs numba")
LONG = (4.0, 8.0, 16.0, 32.0, 64.0, 128.0)
SHORT = tuple(period / 7.5 for period in LONG)  # as in a frame 256 px wide
BAR = 3e-7  # of noise in float32, whose weights have the sum 1


def frames(count: int, *, seed: int = 5, still: bool = False) -> Drawn:
    """Of samples that differ in all, the first at rest."""
    each = torch.arange(count).double()
    key = draws.noise_key(draws.stream(seed, torch.arange(count)))
    wind = torch.stack([1.3 - each, 0.2 * each - 0.1], dim=1)
    return Drawn(key, 0 * each if still else 3.5 * each, wind, 40 + each)


def alone(drawn: Drawn, rows: list[int]) -> Drawn:
    return Drawn(*(value[rows] for value in drawn))


def weights_of(count: int, octaves: int, dtype: torch.dtype = torch.float32) -> Tensor:
    found = 0.1 + torch.rand(count, octaves, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    return (found / found.sum(dim=1, keepdim=True)).to(dtype)


def noise_of(drawn: Drawn, periods: tuple[float, ...], pixels: Pixels, dtype=torch.float32, **more: Any) -> Tensor:
    weights = weights_of(len(drawn.key), len(periods)).to(dtype)
    return drawn_noise(drawn, list(enumerate(periods)), weights, pixels=pixels, **more)


def in_pytorch(drawn: Drawn, periods: tuple[float, ...], pixels: Pixels, weights: Tensor) -> Tensor:
    motion: Any = {**drawn._asdict(), **pixels._asdict(), "dtype": weights.dtype}
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
    ("periods", "pixels"),
    [
        (LONG, Pixels(211, 1397)),
        (SHORT, Pixels(256, 256)),
        ((7.3, 2.5, 1.1, 1.0), Pixels(41, 29)),
        ((0.5, 0.013), Pixels(31, 27)),
        ((0.501, 0.7), Pixels(33, 4100)),
        ((300.0, 1e9), Pixels(19, 140)),
        ((300.0, 40.0), Pixels(30, 24, stride=12, start=-12)),
        ((3.0,), Pixels(1, 1)),
        ((3.0, 0.2), Pixels(700, 3)),
    ],
)
def test_the_noise_is_that_of_float64(periods, pixels, still, asked, oracle):
    drawn = frames(3, still=still)
    found, exact = (noise_of(drawn, periods, pixels, dtype) for dtype in (torch.float32, torch.float64))
    assert asked == ["fields.kernels.drifts"]
    assert found.dtype == torch.float32
    assert exact.abs().max() > 1e-3
    oracle("Perlin noise by a kernel, float64", found, exact, BAR, unit="")


@pytest.mark.parametrize("frame", [1e4, -1e6])
def test_late_frames_are_those_of_float64(frame, oracle):
    drawn = frames(2)._replace(frame=torch.full((2,), frame).double())
    found, exact = (noise_of(drawn, LONG, Pixels(97, 130), dtype) for dtype in (torch.float32, torch.float64))
    oracle("Perlin noise by a kernel, late in a clip", found, exact, BAR, unit="")


def test_what_is_known_at_nodes_is_added(oracle):
    lattice = Lattice(75, 131, 6)
    nodes = torch.randn(2, 1, *map(len, lattice.axes()), generator=torch.Generator().manual_seed(3))
    drawn, pixels = frames(2), Pixels(75, 131)
    found = noise_of(drawn, (5.0, 9.0), pixels, nodes=Nodes(nodes, lattice))
    exact = noise_of(drawn, (5.0, 9.0), pixels, torch.float64) + between_nodes(nodes.double(), lattice)
    oracle("Perlin noise and a lattice by a kernel, float64", found, exact, 2e-6, unit="")
    nothing = drawn_noise(drawn, [], torch.ones(2, 0), pixels=pixels, nodes=Nodes(nodes, lattice))
    oracle("a lattice by a kernel, float64", nothing, between_nodes(nodes.double(), lattice), 2e-6, unit="")


@pytest.mark.parametrize(
    ("periods", "pixels"), [(SHORT, Pixels(150, 256)), (LONG, Pixels(270, 481)), ((2.7, 0.3), Pixels(401, 90))]
)
def test_batch_and_threads_change_no_bit(periods, pixels, on_threads):
    drawn, weights = frames(4), weights_of(4, len(periods))
    lattice = Lattice(pixels.height, pixels.width, 5)
    values = torch.randn(4, 1, *map(len, lattice.axes()), generator=torch.Generator().manual_seed(3))

    def made(rows: list[int]) -> Tensor:
        nodes = Nodes(values[rows], lattice)
        return drawn_noise(alone(drawn, rows), list(enumerate(periods)), weights[rows], pixels=pixels, nodes=nodes)

    together = made([0, 1, 2, 3])
    for threads in (1, 2, 3, 8):
        on_threads(threads)
        for rows in ([0, 1, 2, 3], [1], [3], [3, 1, 0], [2, 2]):
            assert torch.equal(made(rows), together[rows])


def test_any_part_of_the_rows_is_made_as_in_the_whole(monkeypatch):
    drawn, pixels = frames(3), Pixels(61, 100)
    whole = noise_of(drawn, SHORT, pixels)
    ends = [0, 1, 2, 17, 61, 62, 130, 183]

    def in_pieces(work: Any, count: int, *, least: int) -> None:
        assert count == ends[-1]
        for start, stop in reversed(list(pairwise(ends))):
            work(start, stop)

    monkeypatch.setattr(perlin_drawn, "share", in_pieces)
    assert torch.equal(noise_of(drawn, SHORT, pixels), whole)


@pytest.mark.parametrize("shape", [(0, 5, 7), (2, 0, 7), (2, 5, 0)])
def test_of_nothing_there_is_nothing(shape):
    count, height, width = shape
    assert noise_of(alone(frames(2), list(range(count))), (3.0,), Pixels(height, width)).shape == (count, 1, *shape[1:])


@pytest.mark.parametrize("which", ["weights", "frame", "wind", "decorrelation", "nodes"])
def test_what_learns_has_the_gradients_of_pytorch(which, asked):
    pixels, lattice = Pixels(20, 30), Lattice(20, 30, 4)
    values = torch.randn(2, 1, *map(len, lattice.axes()), generator=torch.Generator().manual_seed(3))
    inputs = {"weights": weights_of(2, 2), "nodes": values, **frames(2)._asdict()}
    inputs[which].requires_grad_()
    drawn, nodes = Drawn(*(inputs[name] for name in Drawn._fields)), Nodes(inputs["nodes"], lattice)
    found = drawn_noise(drawn, [(0, 3.0), (1, 9.0)], inputs["weights"], pixels=pixels, nodes=nodes)
    slope = torch.autograd.grad(found.square().sum(), inputs[which])[0]
    assert slope.isfinite().all()
    assert slope.abs().max() > 0
    assert not asked
    with torch.no_grad():
        drawn_noise(drawn, [(0, 3.0), (1, 9.0)], inputs["weights"], pixels=pixels, nodes=nodes)
    assert asked


@pytest.mark.filterwarnings("ignore:.torch.jit.script. is deprecated:FutureWarning")  # of torch.func.jvp
def test_maps_graphs_and_forward_gradients_are_pytorchs(asked):
    drawn, weights, pixels = frames(2), weights_of(2, 2), Pixels(20, 30)

    def made(weights: Tensor, *drawn: Tensor) -> Tensor:
        return drawn_noise(Drawn(*drawn), [(0, 3.0), (1, 9.0)], weights, pixels=pixels)

    expected = in_pytorch(drawn, (3.0, 9.0), pixels, weights)
    assert torch.equal(torch.compile(made, fullgraph=True, backend="eager")(weights, *drawn), expected)
    assert torch.equal(drawn_noise(drawn, [(0, 3.0)], weights[:, :1].double(), pixels=pixels).float() * 0, expected * 0)
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
    drawn, pixels = frames(2), Pixels(40, 50)
    monkeypatch.setattr(compiled, "kernels", lambda _: None)
    expected = in_pytorch(drawn, SHORT, pixels, weights_of(2, len(SHORT)))
    assert torch.equal(noise_of(drawn, SHORT, pixels), expected)


SAME_ON_ALL = """
import sys
import torch
from torchrefract import HeterogeneousFog
from torchrefract._lanes import LANES
assert {lanes} in (None, LANES), LANES
made = [HeterogeneousFog().degrade(torch.zeros(2, 2, 1, 61, width), seed=3).extinction for width in (7, 256, 300)]
torch.save(made, sys.argv[1])
"""


@pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="the names are those of x86 processors")
def test_every_processor_finds_the_same(tmp_path):
    found = []
    for name, features, lanes in (("haswell", "+avx,+avx2,+fma", 8), ("generic", "", 0), ("own", "", None)):
        told = {"NUMBA_CPU_NAME": name, "NUMBA_CPU_FEATURES": features} if lanes is not None else {}
        told["NUMBA_CACHE_DIR"] = str(tmp_path / name)
        words = [sys.executable, "-c", SAME_ON_ALL.format(lanes=lanes), str(tmp_path / f"{name}.pt")]
        done = subprocess.run(words, env=os.environ | told, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        found.append(torch.load(tmp_path / f"{name}.pt"))
    for others in found[1:]:
        assert all(torch.equal(one, other) for one, other in zip(found[0], others, strict=True))
