import json
import os
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest
import torch

from torchrefract import DivergenceFree, LensDistortion, ThinPlateSpline, Turbulence
from torchrefract.effects.lattice_warp import LatticeWarp
from torchrefract.warping import on_gpu
from torchrefract.warping.lattice import Lattice, LatticeFlow

SEED = 4  # has some of six samples moved and some not
on_a_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
MAKERS = {
    "lens": lambda **more: LensDistortion(
        k1_range=(-0.25, -0.25), k2_range=(0.09, 0.09), focal_range=(0.9, 0.9), **more
    ),
    "plate": ThinPlateSpline,
    "air": lambda **more: Turbulence(covariance="gaussian", length_range=(40.0, 60.0), **more),
    "swirls": lambda **more: DivergenceFree(length_range=(40.0, 60.0), **more),
}


@pytest.mark.skipif(find_spec("triton") is None, reason="needs triton")
def test_the_kernels_find_what_grid_sample_and_the_cpu_do():
    words = [sys.executable, str(Path(__file__).with_name("interpreted.py"))]
    done = subprocess.run(
        words, env=os.environ | {"TRITON_INTERPRET": "1"}, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert len(found["look_up"]) == 5
    for case, errors in found["look_up"].items():
        for name in ("image", "source", "nodes"):
            assert errors[name] <= 2 * errors[f"{name} by PyTorch"] < 1e-4, (case, name)


def test_the_cpu_and_other_types_are_not_served():
    lattice = Lattice(64, 64, 16)
    flow = LatticeFlow(torch.zeros(1, 2, *map(len, lattice.axes())), lattice)
    far = torch.zeros(1, 3, 64, 64, device="meta")
    assert not on_gpu.serves(torch.zeros(1, 3, 64, 64), flow, torch.float32)
    assert not on_gpu.serves(far, flow, torch.float32)


def drawn(name: str, **more) -> tuple[LatticeWarp, LatticeWarp]:
    return MAKERS[name](tolerance_px=0.05, **more), MAKERS[name](tolerance_px=0.05, backend="torch", **more)


@on_a_gpu
@pytest.mark.parametrize("name", MAKERS)
@pytest.mark.parametrize("padding", ["zeros", "border", "reflection"])
@pytest.mark.parametrize("kind", [torch.float32, torch.float16, torch.uint8])
def test_an_effect_on_a_gpu_is_that_by_grid_sample(name, padding, kind):
    image = torch.rand(6, 3, 270, 480, device="cuda")
    image = image.mul(255).to(kind) if kind is torch.uint8 else image.to(kind)
    ours, plain = drawn(name, padding=padding, p=0.5)
    params = ours.sample(image, seed=SEED)
    assert params.applied.any()
    assert not params.applied.all()
    found, expected = ours.apply(image, params).image, plain.apply(image, params).image
    assert found.dtype is kind
    assert torch.equal(found[~params.applied], image[~params.applied])
    apart = (found.double() - expected.double()).abs().max().item()
    assert apart <= {torch.float32: 2e-4, torch.float16: 1e-3, torch.uint8: 1}[kind]


@on_a_gpu
@pytest.mark.parametrize("name", MAKERS)
def test_gradients_on_a_gpu_are_those_by_grid_sample(name):
    found = []
    for effect in drawn(name):
        image = torch.rand(2, 3, 270, 480, generator=torch.Generator().manual_seed(3)).cuda().requires_grad_()
        effect.apply(image, effect.sample(image, seed=1)).image.square().sum().backward()
        found.append(image.grad)
    torch.testing.assert_close(*found, rtol=1e-3, atol=1e-3)


@on_a_gpu
@pytest.mark.parametrize("kind", ["highest", "high", "medium"])
@pytest.mark.parametrize("name", MAKERS)
def test_flows_on_a_gpu_keep_all_digits_whatever_products_a_training_asks_for(name, kind):
    effect = drawn(name)[0]
    image = torch.rand(2, 3, 540, 960)
    params = effect.sample(image, seed=1)
    expected = effect.apply(image, params)
    torch.set_float32_matmul_precision(kind)
    try:
        found = effect.apply(image.cuda(), params.to("cuda"))
        assert (found.flow.cpu() - expected.flow).abs().max() < 1e-3
        assert (found.image.cpu() - expected.image).abs().max() < 1e-3
    finally:
        torch.set_float32_matmul_precision("highest")


@on_a_gpu
@pytest.mark.filterwarnings("ignore:TensorFloat32 tensor cores:UserWarning")  # inductor's advice, not taken on purpose
@pytest.mark.filterwarnings("ignore:.torch.jit.script_method. is deprecated:DeprecationWarning")  # PyTorch's own code
def test_a_compiled_effect_on_a_gpu_is_the_eager_one():
    effect, image = drawn("lens")[0], torch.rand(4, 3, 270, 480, device="cuda")
    compiled = torch.compile(effect, fullgraph=True)
    torch.manual_seed(5)
    expected = effect(image)
    torch.manual_seed(5)
    assert (compiled(image) - expected).abs().max() < 2e-4
