import math
import os
import platform
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.autograd import forward_ad
from torch.utils.data import DataLoader, Dataset

from torchrefract import DivergenceFree, LensDistortion, OneOf, ThinPlateSpline, warp
from torchrefract import _compiled as compiled
from torchrefract._lanes import LANES
from torchrefract.warping import lattice, sums
from torchrefract.warping.followed import FollowedFlow, followed
from torchrefract.warping.grid import Positions, sampler_grid
from torchrefract.warping.lattice import Lattice, LatticeFlow, StreamFlow
from torchrefract.warping.mixed import Flow, MixedFlow
from torchrefract.warping.warp import sample_image

SIZES = [(1, 1), (1, 7), (9, 1), (3, 4), (37, 53), (131, 127), (270, 481)]
PADDINGS = ["zeros", "border", "reflection"]
LARGE = 140, 180  # as large as is looked up by kernels without being asked


def flows(batch: int, height: int, width: int) -> dict[str, Tensor]:
    """Short ones, ones that leave the frame, ones that lead halfway between pixels, and ones that lead nowhere."""
    noise = torch.rand(batch, 2, height, width, generator=torch.Generator().manual_seed(1)) * 2 - 1
    found = {"short": noise * 4, "far": noise * 3 * max(height, width), "half": (noise * 8).round() / 2}
    nowhere = found["short"].clone()
    for i, poison in enumerate((math.nan, math.inf, -math.inf, 3e38)):
        nowhere.flatten()[i::7] = poison
    return {**found, "nowhere": nowhere}


def image_of(*shape: int, seed: int = 0) -> Tensor:
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed))


def both(image: Tensor, flow: Tensor, **options: str) -> tuple[Tensor, Tensor]:
    found, expected = (warp(image, flow, backend=name, **options)[0] for name in ("numba", "torch"))
    return found, expected


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("padding", PADDINGS)
@pytest.mark.parametrize("channels", [1, 2, 3, 4, 7])
def test_floats_are_those_of_grid_sample_to_the_bit(size, padding, channels):
    image = image_of(2, channels, *size)
    for flow in flows(2, *size).values():
        found, expected = both(image, flow, padding=padding)
        assert torch.equal(found, expected)


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("padding", PADDINGS)
@pytest.mark.parametrize("last", [False, True])
@pytest.mark.parametrize("channels", [1, 3, 4])
def test_bytes_are_those_of_grid_sample(size, padding, last, channels):
    image = (image_of(2, channels, *size) * 256).to(torch.uint8)
    image = image.movedim(1, -1).contiguous().movedim(-1, 1) if last else image
    for flow in flows(2, *size).values():
        found, expected = both(image, flow, padding=padding)
        assert torch.equal(found, expected)
        assert found.stride() == expected.stride()


@pytest.mark.parametrize("padding", PADDINGS)
def test_an_image_in_channels_last_format_stays_in_it(padding):
    image = image_of(2, 3, *LARGE).contiguous(memory_format=torch.channels_last)
    found, expected = both(image, flows(2, *LARGE)["far"], padding=padding)
    assert torch.equal(found, expected)
    assert found.is_contiguous(memory_format=torch.channels_last)


def test_views_are_read_as_they_are():
    large = image_of(2, 5, 2 * LARGE[0], 2 * LARGE[1])
    image = large[:, 1:4, ::2, 3 : 3 + LARGE[1]]
    found, expected = both(image, flows(2, *LARGE)["short"].mT.contiguous().mT)
    assert torch.equal(found, expected)


@pytest.mark.parametrize("padding", PADDINGS)
@pytest.mark.parametrize("poison", [math.nan, math.inf])
def test_pixels_that_are_not_finite_stay_where_they_are(padding, poison):
    image = image_of(1, 3, *LARGE)
    image[0, :, 0, 0] = image[0, 1, -1, 5] = image[0, 2, 60, -1] = image[0, 0, 70, 70] = poison
    for flow in flows(1, *LARGE).values():
        found, expected = both(image, flow, padding=padding)
        assert torch.equal(found.isfinite(), expected.isfinite())
        assert torch.equal(found.nan_to_num(), expected.nan_to_num())


def smooth(kind: type[LatticeFlow], batch: int, stride: int, height: int, width: int) -> LatticeFlow:
    before, channels = (1, 2) if kind is LatticeFlow else (3, 1)
    own = Lattice(height, width, stride, before=before, after=1 if kind is LatticeFlow else 3)
    rows, columns = map(len, own.axes())
    nodes = torch.randn(batch, channels, rows, columns, generator=torch.Generator().manual_seed(2))
    return kind(nodes * (6 if kind is LatticeFlow else 6 * stride), own)


def mixes() -> dict[str, Flow | Positions]:
    """Flows of three rows in all forms."""
    fine, coarse = smooth(LatticeFlow, 1, 5, *LARGE), smooth(LatticeFlow, 2, 16, *LARGE)
    far, alike = flows(3, *LARGE)["far"], fine.with_nodes(fine.nodes.expand(3, -1, -1, -1))
    found: dict[str, Flow | Positions] = {
        "lattice": smooth(LatticeFlow, 3, 12, *LARGE),
        "stream": smooth(StreamFlow, 3, 9, *LARGE),
        "one for all": alike,
        "dense, one for all": far[:1].expand(3, -1, -1, -1),
        "mixed": MixedFlow(((torch.tensor([2, 0]), coarse), (torch.tensor([1]), far[:1]))),
    }
    found["followed"] = FollowedFlow(
        smooth(StreamFlow, 3, 9, *LARGE),
        (coarse.rows(torch.tensor([0, 1, 1])), far),
    )
    found["one for all, followed"] = FollowedFlow(alike, (alike, far[:1].expand(3, -1, -1, -1)))
    curl = smooth(StreamFlow, 3, 12, *LARGE)
    for every in (2, 3, 7):
        seldom = replace(smooth(LatticeFlow, 3, 40, *LARGE), every=every)
        found[f"followed, known every {every} px"] = FollowedFlow(seldom, (alike, curl))
    grid = fine.sampler_grid(torch.float32).expand(3, -1, -1, -1)
    return {**found, "positions": Positions(grid)}


@pytest.mark.parametrize("padding", PADDINGS)
@pytest.mark.parametrize("form", [*mixes()])
def test_flows_in_all_forms_are_followed_to_the_bit(padding, form):
    image, options = image_of(3, 3, *LARGE), {"padding": padding, "interpolation": "bilinear"}
    found = sample_image(image, mixes()[form], **options, backend="numba")
    assert torch.equal(found, sample_image(image, mixes()[form], **options, backend="torch"))
    assert torch.equal(found, sample_image(image, mixes()[form], **options))
    assert not torch.equal(found, image)


def test_rows_that_are_not_there_are_not_read():
    image, flow = image_of(3, 3, *LARGE), flows(2, *LARGE)["short"]
    with pytest.raises(ValueError, match="flow must have a row for each of 3 images, got 2"):
        sample_image(image, flow, padding="zeros", interpolation="bilinear", backend="numba")
    with pytest.raises(ValueError, match="grid must have a row for each of 2 flows, got 3"):
        followed(flow, image[:, :2].movedim(1, -1))


def test_flows_in_a_row_are_those_of_grid_sample(monkeypatch, oracle):
    first, grid = smooth(LatticeFlow, 2, 9, *LARGE), smooth(LatticeFlow, 2, 12, *LARGE).sampler_grid(torch.float32)
    flows = [first, first.dense(), first.with_nodes(first.nodes[:1].expand(2, -1, -1, -1))]
    found = [followed(flow, grid) for flow in flows]
    monkeypatch.setattr(compiled, "kernels", lambda _: None)
    # Grids span 2; a rounding of a position is up to 1.2e-7.
    for one, flow in zip(found, flows, strict=True):
        oracle("grid of two flows, grid_sample", one, followed(flow, grid), 1e-6, unit="")


@pytest.mark.parametrize("stride", [2, 7, 8, 33])
@pytest.mark.parametrize("kind", [LatticeFlow, StreamFlow])
def test_lines_between_nodes_are_those_of_products_of_matrices(stride, kind, monkeypatch, oracle):
    flow = smooth(kind, 2, stride, *LARGE)
    by_kernel = flow.dense()
    monkeypatch.setattr(sums, "obstacle", lambda *_: "for this test")
    oracle("field between nodes, products of matrices", by_kernel, flow.dense(), 2e-5)
    double = flow.with_nodes(flow.nodes.double())
    oracle("field between nodes, float64", by_kernel.double(), double.dense(), 2e-5)


@pytest.mark.parametrize("kind", [LatticeFlow, StreamFlow])
def test_nodes_have_the_gradients_of_products_of_matrices(kind, monkeypatch):
    flow = smooth(kind, 2, 9, *LARGE)
    upstream, found = torch.randn(2, 2, *LARGE), list[Tensor]()
    for why in (None, "for this test"):
        if why:
            monkeypatch.setattr(sums, "obstacle", lambda *_: "for this test")
        nodes = flow.nodes.clone().requires_grad_()
        found.append(torch.autograd.grad(flow.with_nodes(nodes).dense(), nodes, upstream)[0])
    torch.testing.assert_close(*found, rtol=1e-5, atol=1e-4 * found[0].abs().max().item())


def learned(image: Tensor, flow: Tensor, padding: str, backend: str) -> list[Tensor]:
    """Gradients of both, and those of the length of these."""
    image, flow = image.clone().requires_grad_(), flow.clone().requires_grad_()
    found = warp(image, flow, padding=padding, backend=backend)[0]
    upstream = image_of(*found.shape, seed=3)
    first = torch.autograd.grad(found, (image, flow), upstream, create_graph=True)
    second = torch.autograd.grad(torch.stack([value.square().sum() for value in first]).sum(), (image, flow))
    alone = torch.autograd.grad(warp(image, flow.detach(), padding=padding, backend=backend)[0], image, upstream)
    return [*first, *second, *alone]


@pytest.mark.parametrize("padding", PADDINGS)
@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("batch", [1, 3])
def test_gradients_are_those_of_grid_sample(padding, threads, batch, on_threads):
    on_threads(threads)
    image, flow = image_of(batch, 3, *LARGE), flows(batch, *LARGE)["short"]
    found, expected = (learned(image, flow, padding, name) for name in ("numba", "torch"))
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-5, atol=1e-5 * other.abs().max().item())


@pytest.mark.parametrize("padding", PADDINGS)
@pytest.mark.parametrize("threads", [1, 2, 8])
@pytest.mark.parametrize("kind", ["short", "far", "half", "nowhere", "lattice", "positions"])
def test_images_learn_along_flows_of_all_kinds(padding, threads, kind, on_threads):
    on_threads(threads)
    made = flows(2, *LARGE)
    flow = made.get(kind, made["far"])
    path = Positions(sampler_grid(flow)) if kind == "positions" else smooth(LatticeFlow, 2, 9, *LARGE)
    upstream, found = image_of(2, 4, *LARGE, seed=3), list[Tensor]()
    for name in ("numba", "torch"):
        image = image_of(2, 4, *LARGE).requires_grad_()
        looked = sample_image(
            image,
            path if kind in ("lattice", "positions") else flow,
            padding=padding,
            interpolation="bilinear",
            backend=name,
        )
        found.append(torch.autograd.grad(looked, image, upstream)[0])
    torch.testing.assert_close(*found, rtol=1e-5, atol=1e-5 * found[1].abs().max().item())


def test_parameters_learn_through_the_kernels():
    image = image_of(1, 3, *LARGE)
    for effect in (LensDistortion(), ThinPlateSpline(amplitude_range=(3, 3)), DivergenceFree(amplitude_range=(3, 3))):
        params = effect.sample(image, seed=5)
        found = list[list[Tensor]]()
        for name in ("numba", "torch"):
            effect.backend = name
            leaves = [v.clone().requires_grad_() if v.is_floating_point() else v for v in params]
            made = effect.apply(image, type(params)(*leaves)).image
            own = [leaf for leaf in leaves if leaf.requires_grad]
            slopes = torch.autograd.grad(made.square().sum(), own, allow_unused=True)
            found.append([made, *(slope for slope in slopes if slope is not None)])
        assert any(slope.abs().amax() > 0 for slope in found[0][1:])
        for one, other in zip(*found, strict=True):
            assert torch.equal(one, other)


@pytest.mark.parametrize("size", [(131, 127), (301, 263)])
def test_threads_and_batch_change_no_bit(size, on_threads):
    image, flow, results = image_of(3, 3, *size), flows(3, *size)["far"], list[Tensor]()
    for threads in (1, 2, 3, 8):
        on_threads(threads)
        results.append(warp(image, flow, backend="numba")[0])
    alone = torch.cat([warp(image[i : i + 1], flow[i : i + 1], backend="numba")[0] for i in range(3)])
    for result in (*results[1:], alone):
        assert torch.equal(result, results[0])


def test_effects_give_the_same_whatever_looks_them_up():
    image = image_of(3, 3, *LARGE)
    for effect in (LensDistortion(), ThinPlateSpline(), DivergenceFree(), OneOf([LensDistortion(), ThinPlateSpline()])):
        made = list[Tensor]()
        for name in ("auto", "numba", "torch"):
            effect.backend = name
            made.append(effect.degrade(image, seed=11).image)
        assert torch.equal(made[0], made[1])
        assert torch.equal(made[0], made[2])


@pytest.fixture
def asked(monkeypatch) -> list[int]:
    """Grows with each look-up that a kernel does."""
    found, kernels = list[int](), compiled.kernels

    def counted(name: str) -> object:
        found.append(1)
        return kernels(name)

    monkeypatch.setattr(compiled, "kernels", counted)
    return found


def test_small_frames_types_and_looks_that_kernels_lack_go_another_way(asked):
    small, large = image_of(1, 3, 20, 30), image_of(1, 3, *LARGE)
    still = torch.zeros(1, 2, *LARGE)
    warp(small, torch.zeros(1, 2, 20, 30))
    warp(large, still, interpolation="nearest")
    warp(large, still, interpolation="bicubic")
    warp(large.double(), still)
    warp(large, still, backend="torch")
    assert not asked
    warp(large, still)
    assert asked


@pytest.mark.parametrize(
    ("image", "options", "why"),
    [
        (image_of(1, 3, 20, 30), {"interpolation": "bicubic"}, "for bicubic interpolation"),
        (image_of(1, 3, 20, 30), {"interpolation": "nearest"}, "for nearest interpolation"),
        (image_of(1, 3, 20, 30).double(), {}, "for numbers that are torch.float64"),
        (image_of(1, 3, 2, 8193), {}, "for numbers that are torch.float64"),
        (image_of(1, 3, 20, 30).to("meta"), {}, "on meta"),
    ],
)
def test_what_kernels_cannot_do_raises(image, options, why):
    flow = torch.zeros(1, 2, *image.shape[2:], device=image.device)
    with pytest.raises(ValueError, match=f"backend must be auto or grid_sample {why}, got 'numba'"):
        warp(image, flow, backend="numba", **options)


@pytest.mark.filterwarnings("ignore:.torch.jit.script. is deprecated:FutureWarning")  # of torch.func.jvp
def test_forward_gradients_maps_and_graphs_are_pytorchs(asked):
    image, flow = image_of(2, 3, *LARGE), flows(2, *LARGE)["short"]
    with forward_ad.dual_level():
        warp(image, forward_ad.make_dual(flow, flow))
    torch.func.jvp(lambda f: warp(image, f)[0], (flow,), (flow,))
    torch.vmap(warp)(image, flow)
    torch.compile(warp, fullgraph=True, backend="eager")(image, flow)
    assert not asked


def test_under_a_map_or_in_a_graph_numba_raises():
    image, flow = image_of(2, 3, *LARGE), torch.zeros(2, 2, *LARGE)
    with pytest.raises(ValueError, match=r"inside torch\.func"):
        torch.vmap(lambda i, f: warp(i, f, backend="numba"))(image, flow)
    with pytest.raises(Exception, match=r"under torch\.compile"):  # dynamo wraps it in an error of its own
        torch.compile(lambda i, f: warp(i, f, backend="numba"), fullgraph=True, backend="eager")(image, flow)


def test_in_inference_mode_nothing_changes():
    image, flow = image_of(1, 3, *LARGE), flows(1, *LARGE)["short"]
    with torch.inference_mode():
        assert torch.equal(warp(image, flow * 1)[0], warp(image, flow, backend="torch")[0])


def test_without_numba_auto_goes_without_it_and_numba_raises(monkeypatch):
    image, flow = image_of(1, 3, *LARGE), flows(1, *LARGE)["short"]
    effect = ThinPlateSpline()
    before = warp(image, flow)[0], effect.degrade(image, seed=3).image
    monkeypatch.setattr(compiled, "kernels", lambda _: None)
    assert torch.equal(warp(image, flow)[0], before[0])
    # Fields between nodes are then products of matrices, which round in another way.
    torch.testing.assert_close(effect.degrade(image, seed=3).image, before[1], rtol=0, atol=2e-4)
    with pytest.raises(ValueError, match=r"without numba \(pip install 'torchrefract\[fast\]'\), got 'numba'"):
        warp(image, flow, backend="numba")


@pytest.mark.parametrize("fault", ["NUMBA_DISABLE_JIT", "numba"])
def test_numba_that_does_not_work_is_numba_that_is_missing(fault):
    broken = "import os, sys\nos.environ['NUMBA_DISABLE_JIT'] = '1'\n"
    if fault == "numba":
        broken = "import sys\nsys.modules['numba'] = None\n"
    program = (
        f"{broken}import torch\nfrom torchrefract import ThinPlateSpline, invert_flow\n"
        "from torchrefract import _compiled as compiled\n"
        "d = ThinPlateSpline().degrade(torch.rand(1, 3, 140, 180), seed=0)\n"
        "assert invert_flow(d.flow)[1].double().mean() > 0.9 and compiled.kernels('warping.kernels.look_up') is None\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


# The names that numba and LLVM give, what they are told of registers, and how many lanes there are then.
PROCESSORS = {"haswell": ("+avx,+avx2,+fma", 8), "generic": ("", 0), "x86-64-v3": ("+avx2", 0)}

LOOK_UPS = """
noise = torch.rand(2, 2, 140, 181, generator=torch.Generator().manual_seed(1)) * 2 - 1
image = torch.rand(2, 3, 140, 181, generator=torch.Generator().manual_seed(2))
across = image.movedim(1, -1).contiguous().movedim(-1, 1)
for flow in (noise, noise * 30, torch.nn.functional.avg_pool2d(noise, 9, 1, 4) * 60):
    for source in (image, across, (image * 256).to(torch.uint8), (across * 256).to(torch.uint8)):
        for padding in ("zeros", "border", "reflection"):
            a, b = (warp(source, flow, padding=padding, backend=name)[0] for name in ("numba", "torch"))
            assert torch.equal(a, b), (source.dtype, padding)
"""
FLOWS = """
def smooth(stride):
    lattice = Lattice(140, 181, stride)
    size = [len(axis) for axis in lattice.axes()]
    return SmoothFlow(torch.randn(2, 2, *size, generator=torch.Generator().manual_seed(stride)), lattice)
rough = smooth(2).with_nodes(9 * smooth(2).nodes)
flow = FollowedFlow(replace(smooth(30), every=3), (smooth(20), rough, smooth(7).dense()))
found.append(flow.sampler_grid(torch.float32))
"""
FOG = """
fog = HeterogeneousFog(mode="ray", decorrelation_range=(5.0, 9.0))
found += [fog.degrade(torch.zeros(2, 2, 1, 131, width), seed=3).extinction for width in (70, 256)]
depth = 300 * torch.rand(2, 1, 131, 70, generator=torch.Generator().manual_seed(1))
found.append(fog.degrade(torch.zeros(2, 1, 131, 70), depth=depth, seed=3).extinction)
for width in (7, 256, 300):
    for linear in (False, True):
        leaf = torch.linspace(0, 1, 244 * width).view(2, 2, 1, 61, width).requires_grad_()
        degraded = HeterogeneousFog(linear_light=linear, tolerance=0.3).degrade(leaf, seed=3)
        found += [degraded.extinction, degraded.image.detach(), *torch.autograd.grad(degraded.image.sum(), leaf)]
"""
OF = {"haswell": (FLOWS, FOG), "generic": (FLOWS, FOG), "x86-64-v3": (FLOWS,)}
PROGRAM = """
from dataclasses import replace
import torch
from torchrefract import HeterogeneousFog, warp
from torchrefract.warping.followed import FollowedFlow
from torchrefract.warping.lattice import Lattice, SmoothFlow
found = []
"""


@pytest.fixture(scope="module")
def here() -> dict[str, list[Tensor]]:
    """What this processor finds, once its look-ups are those of PyTorch, too."""
    exec(PROGRAM + LOOK_UPS, {})
    found = dict[str, list[Tensor]]()
    for part in (FLOWS, FOG):
        names = dict[str, Any]()
        exec(PROGRAM + part, names)
        found[part] = names["found"]
    return found


@pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="the names are those of x86 processors")
# With as many lanes as this processor has itself, `here` asks the same.
@pytest.mark.parametrize("name", [name for name, (_, lanes) in PROCESSORS.items() if lanes == 0 or lanes != LANES])
def test_every_processor_finds_the_same(name, here, tmp_path):
    features, lanes = PROCESSORS[name]
    told = {"NUMBA_CPU_NAME": name, "NUMBA_CPU_FEATURES": features, "NUMBA_CACHE_DIR": str(tmp_path)}
    check = f"from torchrefract._lanes import LANES\nassert LANES == {lanes}, LANES"
    program = "\n".join((PROGRAM, check, LOOK_UPS, *OF[name], f"torch.save(found, {str(tmp_path / 'found.pt')!r})"))
    words = [sys.executable, "-c", program]
    done = subprocess.run(words, env=os.environ | told, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    expected = [value for part in OF[name] for value in here[part]]
    assert all(torch.equal(*both) for both in zip(torch.load(tmp_path / "found.pt"), expected, strict=True))


@pytest.mark.parametrize("layer", ["fields", "warping"])
def test_what_is_kept_is_of_the_very_sources(layer, tmp_path, monkeypatch):
    jit = pytest.importorskip("torchrefract._jit", reason="needs numba")
    shutil.copytree(Path(jit.__file__).parent, tmp_path / "torchrefract", ignore=shutil.ignore_patterns("__pycache__"))
    monkeypatch.setattr(jit, "__file__", str(tmp_path / "torchrefract" / "_jit.py"))
    monkeypatch.setattr(jit.numba.config, "CACHE_DIR", "")
    before = jit._folder.__wrapped__()
    assert Path(before).parent == tmp_path / "torchrefract" / "__pycache__"
    with (tmp_path / "torchrefract" / layer / "kernels" / "groups.py").open("a") as source:
        source.write("# another version\n")
    assert jit._folder.__wrapped__() != before
    monkeypatch.setattr(jit.os, "access", lambda *_: False)
    monkeypatch.delenv("HOME", raising=False)
    monkeypatch.setattr("os.path.expanduser", lambda path: path)  # as where a user has no home
    assert jit._folder.__wrapped__() == ""
    monkeypatch.setattr(jit.numba.config, "CACHE_DIR", str(tmp_path / "new" / "one"))
    assert Path(jit._folder.__wrapped__()).parent == tmp_path / "new" / "one"


class Warped(Dataset[Tensor]):
    """Frames that are looked up where they are asked for."""

    def __len__(self) -> int:
        return 4

    def __getitem__(self, i: int) -> Tensor:
        return warp(image_of(3, *LARGE, seed=i), flows(1, *LARGE)["far"][0], backend="numba")[0]


@pytest.mark.parametrize("start", ["fork", "spawn"])
def test_workers_of_any_start_find_the_same(start, on_threads):
    on_threads(2)
    here = torch.stack([Warped()[i] for i in range(4)])  # whose threads a fork does not have
    loader = DataLoader(Warped(), batch_size=2, num_workers=1, multiprocessing_context=start)
    assert torch.equal(torch.cat(list(loader)), here)


def test_where_nothing_can_be_kept_functions_are_compiled_all_the_same(monkeypatch):
    jit = pytest.importorskip("torchrefract._jit", reason="needs numba")
    njit = jit.numba.njit

    def refuse(**options: bool) -> Callable[..., object]:
        if options.pop("cache", False):
            raise RuntimeError("cannot cache function: no locator available")
        return njit(**options)

    monkeypatch.setattr(jit.numba, "njit", refuse)
    assert jit.jit(lambda a: a + 1)(2) == 3


@pytest.mark.parametrize("width", [16, 240, 1920])
def test_between_nodes_every_second_pixel_has_the_bits_of_any_stride(width):
    across = compiled.kernels("warping.kernels.across")
    taps = lattice.lagrange_weights(2, 4, dtype=torch.float32, device=torch.device("cpu"))
    weights = taps.reshape(2, 4).T.contiguous().numpy()
    nodes = image_of(width // 2 + 3 + 2 * across.GROUP).sub(0.5).numpy()
    found, expected = (torch.empty(width) for _ in range(2))
    across.along_every_second(nodes, weights, found.numpy())
    across.along_nodes(nodes, across.nodes_across(weights, width), expected.numpy())
    assert torch.equal(found, expected)
    assert torch.equal(found[::2], torch.from_numpy(nodes)[1 : width // 2 + 1])
