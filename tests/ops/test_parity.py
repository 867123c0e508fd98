import json
import multiprocessing
import os
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from torchrefract.ops.sampling import PADDINGS, grid_sample, sample

SIZES = [(1, 40), (40, 1), (2, 2), (150, 131)]
needs_numba = pytest.mark.skipif(find_spec("numba") is None, reason="needs numba")


def random_image(*shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
    image = torch.rand(shape, generator=torch.Generator().manual_seed(0))
    return (image * 255).to(dtype) if dtype is torch.uint8 else image.to(dtype)


def random_flow(*shape: int, reach: float = 15.0) -> Tensor:
    return (2 * torch.rand(shape, generator=torch.Generator().manual_seed(1)) - 1) * reach


def random_nodes(batch: int, height: int, width: int, stride: int, margin: int = 1) -> Tensor:
    rows, columns = (-(-size // stride) + 1 + 2 * margin for size in (height, width))
    return random_flow(batch, 2, rows, columns)


def assert_agree(result: Tensor, image: Tensor, reference: Tensor) -> None:
    assert result.dtype is image.dtype
    # Positions in float32 are off by up to 1e-5 px on these sizes.
    tolerance = 1 if image.dtype is torch.uint8 else 3e-5
    assert (result.double() - reference.double()).abs().max() <= tolerance


@needs_numba
@pytest.mark.quick
@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("padding", PADDINGS)
def test_numba_agrees_with_torch_along_dense_flows(size, padding):
    image, flow = random_image(2, 3, *size), random_flow(2, 2, *size)
    options = {"padding": padding, "interpolation": "bilinear"}
    for still in (0, size[0] // 3):  # rows that do not move
        flow[:, :, :still] = 0
        reference = sample(image.double(), flow, backend="torch", **options)
        assert_agree(sample(image, flow, backend="numba", **options), image, reference)


@needs_numba
@pytest.mark.parametrize("stride", [3, 32])
@pytest.mark.parametrize("padding", PADDINGS)
def test_numba_agrees_with_torch_along_flows_on_lattices(stride, padding):
    image = random_image(2, 3, 150, 131)
    for margin in (1, 2):
        nodes = random_nodes(2, 150, 131, stride, margin)
        options = {"stride": stride, "margin": margin, "padding": padding, "interpolation": "bilinear"}
        reference = sample(image.double(), nodes, backend="torch", **options)
        assert_agree(sample(image, nodes, backend="numba", **options), image, reference)


@needs_numba
@pytest.mark.parametrize("dtype", [torch.float32, torch.uint8])
@pytest.mark.parametrize("channels", [1, 3, 4, 7])
def test_numba_reads_images_of_any_layout(dtype, channels):
    image, flow = random_image(1, channels, 60, 50, dtype=dtype), random_flow(1, 2, 60, 50)
    flow[:, :, 20:30] = 0
    options: dict[str, Any] = {"padding": "border", "interpolation": "bilinear"}
    reference = sample(image, flow, backend="torch", **options)
    interleaved = image[0].movedim(0, -1).contiguous().movedim(-1, 0)[None]
    cropped = torch.nn.functional.pad(image, (3, 4, 5, 6))[..., 5:-6, 3:-4]
    for layout in (image, interleaved, image.mT.contiguous().mT, cropped):
        result = sample(layout, flow, backend="numba", **options)
        assert_agree(result, image, reference)
        assert result.is_contiguous() or result.is_contiguous(memory_format=torch.channels_last)
    if channels > 1:
        last = sample(interleaved, flow, backend="numba", **options)
        assert last.is_contiguous(memory_format=torch.channels_last)


@needs_numba
@pytest.mark.parametrize("poison", [torch.nan, torch.inf, -torch.inf, 1e10])
@pytest.mark.parametrize("padding", PADDINGS)
def test_numba_reads_invalid_flow_as_torch_does(poison, padding):
    image, flow = random_image(1, 2, 40, 50), random_flow(1, 2, 40, 50)
    flow[:, :, 4] = 0
    flow[0, 0, 4, 5] = flow[0, 1, 20, 30] = poison
    options = {"padding": padding, "interpolation": "bilinear"}
    reference = sample(image.double(), flow, backend="torch", **options)
    assert_agree(sample(image, flow, backend="numba", **options), image, reference)


@pytest.mark.quick
@pytest.mark.parametrize("backend", ["torch", pytest.param("numba", marks=needs_numba)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.uint8])
def test_inactive_samples_are_copied(backend, dtype):
    image, nodes = random_image(3, 2, 40, 50, dtype=dtype), random_nodes(1, 40, 50, 8)
    active = torch.tensor([False, True, False])
    options = {"stride": 8, "margin": 1, "padding": "zeros", "interpolation": "bilinear", "backend": backend}
    result, full = sample(image, nodes, active=active, **options), sample(image, nodes, **options)
    assert torch.equal(result[[0, 2]], image[[0, 2]])
    assert torch.equal(result[1], full[1])
    assert not torch.equal(result[1], image[1])


@needs_numba
@pytest.mark.parametrize("threads", [1, 3])
def test_numba_gives_the_same_image_on_any_number_of_threads(on_threads, threads):
    image, nodes = random_image(1, 3, 300, 280), random_nodes(1, 300, 280, 16)
    options = {"stride": 16, "margin": 1, "padding": "zeros", "interpolation": "bilinear", "backend": "numba"}
    on_threads(2)
    expected = sample(image, nodes, **options)
    on_threads(threads)
    assert torch.equal(sample(image, nodes, **options), expected)


def _sample_in_child(connection, image: Tensor, flow: Tensor) -> None:
    connection.send(sample(image, flow, padding="zeros", interpolation="bilinear", backend="numba").numpy())


@needs_numba
@pytest.mark.filterwarnings("ignore:.*use of fork.*:DeprecationWarning")
def test_a_forked_process_samples_with_threads_of_its_own(on_threads):
    on_threads(2)
    image, flow = random_image(1, 3, 300, 280), random_flow(1, 2, 300, 280)
    expected = sample(image, flow, padding="zeros", interpolation="bilinear", backend="numba").numpy()
    context = multiprocessing.get_context("fork")
    receiver, sender = context.Pipe()
    process = context.Process(target=_sample_in_child, args=(sender, image, flow))
    process.start()
    assert receiver.poll(20)
    assert (receiver.recv() == expected).all()
    process.join()


@pytest.mark.skipif(find_spec("triton") is None, reason="needs triton")
def test_triton_agrees_with_torch_in_its_interpreter():
    run = subprocess.run(
        [sys.executable, str(Path(__file__).with_name("triton_errors.py"))],
        env=os.environ | {"TRITON_INTERPRET": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.returncode == 0, run.stderr
    errors = json.loads(run.stdout)
    assert len(errors) == 3
    assert max(errors) < 3e-5


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
@pytest.mark.parametrize("padding", PADDINGS)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float16, torch.uint8])
def test_triton_agrees_with_torch_on_a_gpu(padding, dtype):
    image, nodes = random_image(6, 3, 270, 480, dtype=dtype).cuda(), random_nodes(6, 270, 480, 16).cuda()
    options = {"stride": 16, "margin": 1, "padding": padding, "interpolation": "bilinear"}
    difference = sample(image, nodes, backend="triton", **options).double()
    difference -= sample(image, nodes, backend="torch", **options).double()
    assert difference.abs().max() <= {torch.float32: 2e-4, torch.float16: 1e-3, torch.uint8: 1}[dtype]


@pytest.mark.quick
def test_torch_serves_where_a_gradient_is_needed():
    image, nodes = random_image(1, 2, 130, 140), random_nodes(1, 130, 140, 8).requires_grad_()
    for backend in ("auto", "numba"):
        options = {"stride": 8, "margin": 1, "padding": "border", "interpolation": "bilinear", "backend": backend}
        sample(image, nodes, **options).sum().backward()
        assert nodes.grad is not None
        assert nodes.grad.abs().sum() > 0


@needs_numba
@pytest.mark.quick
@pytest.mark.parametrize(
    ("backend", "dtype", "interpolation", "why"),
    [
        ("numba", torch.float64, "bilinear", r"float64 of \(8, 9\) px"),
        ("numba", torch.float32, "bicubic", "bicubic interpolation"),
        ("triton", torch.float32, "bilinear", "a dense flow"),
    ],
)
def test_a_backend_that_does_not_support_the_arguments_raises(backend, dtype, interpolation, why):
    image, flow = random_image(1, 1, 8, 9, dtype=dtype), random_flow(1, 2, 8, 9)
    with pytest.raises(ValueError, match=rf"backend='{backend}' supports .*, got {why}.*; use backend='auto'"):
        sample(image, flow, padding="zeros", interpolation=interpolation, backend=backend)


@pytest.mark.parametrize("threads", [1, 2, 3])
def test_bands_of_rows_give_the_image_and_gradients_of_one_call(on_threads, threads):
    image, grid = random_image(1, 2, 131, 127).double(), random_flow(1, 131, 127, 2, reach=1.2).double()
    image.requires_grad_()
    grid.requires_grad_()
    on_threads(threads)
    sampled = grid_sample(image, grid, padding="reflection", interpolation="bilinear")
    expected = torch.nn.functional.grid_sample(image, grid, padding_mode="reflection", align_corners=False)
    torch.testing.assert_close(sampled, expected, rtol=0, atol=1e-12)
    gradients = [torch.autograd.grad((value * value).sum(), (image, grid)) for value in (sampled, expected)]
    torch.testing.assert_close(*gradients, rtol=0, atol=1e-10)
