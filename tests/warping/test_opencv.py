import importlib
import io
import math
import types

import cv2
import numpy as np
import pytest
import torch
import torch.nn.functional as F
from torch import Tensor
from torch.autograd import forward_ad
from torch.utils.data import DataLoader, Dataset

from torchrefract import Compose, LensDistortion, OneOf, ThinPlateSpline, UniformFog, warp
from torchrefract.warping import opencv
from torchrefract.warping.grid import sampler_grid

SIZES = [(1, 1), (1, 7), (9, 1), (3, 4), (37, 53), (270, 481), (7, 8192)]
PADDINGS = ["zeros", "border", "reflection"]
INTERPOLATIONS = ["nearest", "bilinear"]
# Of the range of the values; what was found is 1.8e-7.
CLOSE = 1e-6


def levels(*shape: int, seed: int = 0) -> Tensor:
    """Bytes (..., C, H, W) that lie in memory as (..., H, W, C)."""
    image = torch.randint(0, 256, shape, generator=torch.Generator().manual_seed(seed), dtype=torch.uint8)
    return image.movedim(-3, -1).contiguous().movedim(-1, -3)


def flows(batch: int, height: int, width: int) -> dict[str, Tensor]:
    """Short ones, ones that leave the frame, and ones that lead halfway between pixels."""
    noise = torch.rand(batch, 2, height, width, generator=torch.Generator().manual_seed(1)) * 2 - 1
    return {"short": noise * 4, "far": noise * 3 * max(height, width), "half": (noise * 8).round() / 2}


def same_but_for_halves(found: Tensor, expected: Tensor, unrounded: Tensor) -> None:
    """Levels are one apart at most, and only where the value before rounding is that near to a half."""
    other = found != expected
    assert ((found.int() - expected.int()).abs() <= 1).all()
    assert (((unrounded - unrounded.floor()) - 0.5).abs()[other] <= 255 * CLOSE).all()


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("padding", PADDINGS)
@pytest.mark.parametrize("interpolation", INTERPOLATIONS)
@pytest.mark.parametrize("channels", [1, 3, 4])
def test_floats_are_those_of_grid_sample(size, padding, interpolation, channels, oracle):
    image = levels(2, channels, *size).float() / 255
    for flow in flows(2, *size).values():
        options = {"padding": padding, "interpolation": interpolation}
        found = warp(image, flow, backend="opencv", **options)[0]
        expected = warp(image, flow, backend="torch", **options)[0]
        if interpolation == "nearest":
            assert torch.equal(found, expected)
        oracle("remap in float32, grid_sample", found, expected, CLOSE, unit="")


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("padding", PADDINGS)
@pytest.mark.parametrize("interpolation", INTERPOLATIONS)
@pytest.mark.parametrize("channels", [3, 4])
def test_bytes_are_those_of_grid_sample_but_for_halves(size, padding, interpolation, channels):
    image = levels(2, channels, *size)
    for flow in flows(2, *size).values():
        options = {"padding": padding, "interpolation": interpolation}
        found = warp(image, flow, backend="opencv", **options)[0]
        unrounded = warp(image.float(), flow, backend="torch", **options)[0]
        same_but_for_halves(found, warp(image, flow, backend="torch", **options)[0], unrounded)


@pytest.mark.parametrize("padding", PADDINGS)
def test_bytes_of_real_frames_differ_in_few_values_in_a_million(padding, shared_data):
    differing = 0.0
    for path in sorted((shared_data / "fullres").glob("*.jpg"))[:6]:
        pixels = cv2.imread(str(path))
        assert pixels is not None
        image = torch.from_numpy(np.asarray(pixels)[:1080, :1920]).permute(2, 0, 1)
        lens = LensDistortion(padding=padding, tolerance_px=0.05)
        flow = lens.degrade(image, seed=0).flow
        assert flow is not None
        found, expected = (warp(image, flow, padding=padding, backend=name)[0] for name in ("opencv", "torch"))
        unrounded = warp(image.float(), flow, padding=padding, backend="torch")[0]
        same_but_for_halves(found, expected, unrounded)
        share = (found != expected).double().mean().item()
        assert share < 5e-5
        differing += share
    # A handful in each frame, but chance may leave none in one of them; none in all, and OpenCV was not asked.
    assert differing > 0


def test_bytes_are_the_nearest_to_what_opencv_finds_in_floats():
    image, flow = levels(1, 3, 270, 481), flows(1, 270, 481)["short"]
    found, floats = (warp(value, flow, backend="opencv")[0] for value in (image, image.float()))
    assert torch.equal(found, floats.round().to(torch.uint8))


def test_the_sampler_looks_where_its_positions_in_px_say():
    # On a ramp the value is the position; a fused rounding more or less would be 6e-5 px here.
    height, width = 3, 1921
    grid = sampler_grid(flows(1, height, width)["short"])
    x, _ = opencv.pixel_positions(grid[0], height=height, width=width, out=torch.empty(2, height, width))
    expected = ((grid[0, ..., 0].double() + 1).float().double() * (width / 2) - 0.5).float()
    assert torch.equal(x, expected)
    noise = torch.rand(1, 1, height, width, generator=torch.Generator().manual_seed(3))
    by_map = cv2.remap(noise[0, 0].numpy(), x.numpy(), np.ones_like(x.numpy()), cv2.INTER_LINEAR)
    grid[..., 1] = 0  # the middle row
    sampled = F.grid_sample(noise, grid, align_corners=False)[0, 0]
    assert (torch.from_numpy(by_map) - sampled).abs().max() <= CLOSE


@pytest.mark.parametrize("poison", [math.nan, math.inf, -math.inf, 3e38])
@pytest.mark.parametrize("padding", PADDINGS)
def test_flow_that_is_not_finite_leads_outside(poison, padding):
    image, flow = levels(1, 3, 9, 11), torch.zeros(1, 2, 9, 11)
    flow[0, 0, 4, 5] = flow[0, 1, 2, 3] = poison
    found, valid = warp(image, flow, padding=padding)
    expected, seen = warp(image, flow, padding=padding, backend="torch")
    assert torch.equal(found, expected)
    assert torch.equal(valid, seen)
    assert not valid[0, 0, 4, 5]


@pytest.fixture
def on_opencv_threads():
    """Sets the number of OpenCV's threads, for the length of a test."""
    before = cv2.getNumThreads()
    yield cv2.setNumThreads
    cv2.setNumThreads(before)


@pytest.mark.parametrize("size", [(131, 127), (301, 263)])
@pytest.mark.parametrize("channels", [3, 4])
def test_threads_and_batch_change_no_bit(size, channels, on_threads, on_opencv_threads):
    image, flow = levels(3, channels, *size), flows(3, *size)["short"]
    results = []
    for threads in (1, 2, 3):
        on_threads(threads)
        on_opencv_threads(threads)
        results.append(warp(image, flow, padding="border", backend="opencv")[0])
    options = {"padding": "border", "backend": "opencv"}
    alone = torch.cat([warp(image[i : i + 1], flow[i : i + 1], **options)[0] for i in range(3)])
    for result in (*results[1:], alone, warp(image[::2], flow[::2], **options)[0]):
        assert torch.equal(result, results[0][:: 2 if len(result) == 2 else 1])


def test_opencvs_own_threads_stay_as_they_were(on_threads):
    on_threads(1)
    before = cv2.getNumThreads()
    warp(levels(1, 3, 301, 263), flows(1, 301, 263)["short"], backend="opencv")
    assert cv2.getNumThreads() == before


@pytest.fixture
def calls(monkeypatch) -> list[int]:
    """The channels of every image that OpenCV is asked for."""
    found = []
    original = cv2.remap
    monkeypatch.setattr(cv2, "remap", lambda source, *a, **k: (found.append(source.ndim), original(source, *a, **k))[1])
    return found


FRAME = (3, 20, 30)


@pytest.mark.parametrize(
    ("image", "asked"),
    [
        (levels(2, *FRAME), True),
        (levels(*FRAME), True),
        (levels(2, *FRAME).contiguous(), False),
        (levels(2, 4, 20, 30), True),
        (levels(2, 2, 20, 30), False),
        (levels(2, 1, 20, 30), False),
        (levels(2, *FRAME).float(), False),
        (levels(2, *FRAME).half(), False),
        (levels(2, *FRAME).double(), False),
        (levels(2, *FRAME).short(), False),
        (levels(1, 3, 2, 8193), False),
    ],
)
def test_auto_asks_opencv_for_bytes_in_its_own_layout_alone(image, asked, calls):
    size = image.shape[-2:]
    flow = torch.zeros(2, *size) if image.ndim == 3 else torch.zeros(1, 2, *size)
    warp(image, flow)
    assert bool(calls) == asked


@pytest.mark.parametrize("options", [{"padding": padding, "interpolation": "bicubic"} for padding in PADDINGS])
def test_auto_leaves_to_pytorch_what_opencv_does_otherwise(options, calls):
    image, flow = levels(1, *FRAME), flows(1, *FRAME[1:])["short"]
    assert torch.equal(warp(image, flow, **options)[0], warp(image, flow, backend="torch", **options)[0])
    assert not calls


def test_gradients_are_pytorchs(calls):
    image, flow = levels(1, *FRAME), flows(1, *FRAME[1:])["short"].requires_grad_()
    warp(image, flow)
    assert not calls
    with torch.no_grad():
        warp(image, flow)
    assert calls


@pytest.mark.filterwarnings("ignore:.torch.jit.script. is deprecated:FutureWarning")  # of torch.func.jvp
def test_forward_gradients_maps_and_graphs_are_pytorchs(calls):
    image, flow = levels(2, *FRAME), flows(2, *FRAME[1:])["short"]
    with forward_ad.dual_level():
        warp(image, forward_ad.make_dual(flow, flow))
    torch.func.jvp(lambda f: warp(image, f)[0].float(), (flow,), (flow,))
    torch.vmap(warp)(image, flow)
    torch.compile(warp, fullgraph=True, backend="eager")(image, flow)
    assert not calls


def test_in_inference_mode_nothing_changes(on_threads):
    on_threads(2)
    image, flow = levels(1, 3, 301, 263), flows(1, 301, 263)["short"]
    expected = warp(image, flow, backend="opencv")[0]
    with torch.inference_mode():
        assert torch.equal(warp(image, flow * 1, backend="opencv")[0], expected)


@pytest.mark.parametrize(
    ("image", "options", "why"),
    [
        (levels(1, *FRAME), {"interpolation": "bicubic"}, "for bicubic interpolation"),
        (levels(1, 2, 20, 30), {}, "for an image of 2 channels, torch.uint8"),
        (levels(1, *FRAME).half(), {}, "for an image of 3 channels, torch.float16"),
        (levels(1, *FRAME).double(), {}, "for an image of 3 channels, torch.float64"),
        (levels(1, 3, 2, 8193), {}, "for positions that are torch.float64"),
        (levels(1, *FRAME).float().requires_grad_(), {}, "where a gradient is asked for"),
        (levels(1, *FRAME).to("meta"), {}, "on meta"),
    ],
)
def test_what_opencv_cannot_do_raises(image, options, why):
    flow = torch.zeros(1, 2, *image.shape[2:], device=image.device)
    with pytest.raises(ValueError, match=f"backend must be auto or grid_sample {why}, got 'opencv'"):
        warp(image, flow, backend="opencv", **options)


def test_under_a_map_or_in_a_graph_opencv_raises():
    image, flow = levels(2, *FRAME), torch.zeros(2, 2, *FRAME[1:])
    with pytest.raises(ValueError, match=r"inside torch\.func"):
        torch.vmap(lambda i, f: warp(i, f, backend="opencv"))(image, flow)
    with pytest.raises(Exception, match=r"under torch\.compile"):  # dynamo wraps it in an error of its own
        torch.compile(lambda i, f: warp(i, f, backend="opencv"), fullgraph=True, backend="eager")(image, flow)


@pytest.mark.parametrize("found", [None, "4.12.0"])
def test_without_opencv_5_auto_goes_without_it_and_opencv_raises(found, monkeypatch, calls):
    def load(name: str) -> types.SimpleNamespace:
        assert name == "cv2"
        if found is None:
            raise ImportError("no module")
        return types.SimpleNamespace(__version__=found)

    image, flow = levels(1, *FRAME), flows(1, *FRAME[1:])["short"]
    expected = warp(image, flow, backend="torch")[0]
    opencv._opencv.cache_clear()
    monkeypatch.setattr(importlib, "import_module", load)
    try:
        assert torch.equal(warp(image, flow)[0], expected)
        assert not calls
        with pytest.raises(ValueError, match=r"without OpenCV 5 or later \(pip install"):
            warp(image, flow, backend="opencv")
    finally:
        opencv._opencv.cache_clear()


def test_an_unknown_resampler_raises():
    rule = "backend must be one of auto, grid_sample, numba, opencv, got 'pil'"
    with pytest.raises(ValueError, match=rule):
        warp(torch.zeros(1, 1, 2, 2), torch.zeros(1, 2, 2, 2), backend="pil")
    with pytest.raises(ValueError, match=rule):
        LensDistortion(backend="pil")
    with pytest.raises(ValueError, match=rule):
        OneOf([LensDistortion()], backend="pil")


@pytest.mark.parametrize("tolerance", [None, 0.05])
def test_an_effect_on_a_frame_of_opencv_makes_no_detour(tolerance, calls):
    pixels = levels(*FRAME).permute(1, 2, 0).numpy()
    frame = torch.from_numpy(pixels).permute(2, 0, 1)
    lens = LensDistortion(k1_range=(-0.3, -0.3), tolerance_px=tolerance)
    result = lens.degrade(frame, seed=3)
    assert calls
    assert result.image.permute(1, 2, 0).is_contiguous()
    assert result.flow is not None
    expected = warp(frame.float(), result.flow, backend="torch")[0]
    # A flow on a lattice leads to positions that are rounded otherwise: to 1/1000 px, a quarter of a level here.
    assert (result.image.float() - expected).abs().max() <= 0.5 + (0.0 if tolerance is None else 0.26) + 255 * CLOSE


def test_a_composition_takes_the_resampler_of_its_last_warp_or_its_own(calls):
    frame = levels(1, *FRAME)
    opencv_lens = LensDistortion(k1_range=(-0.3, -0.3), backend="opencv")
    plate = ThinPlateSpline(padding="border", backend="torch")
    by_sampler = Compose([opencv_lens, plate])(frame)
    assert by_sampler.dtype is torch.uint8
    assert not calls
    Compose([plate, opencv_lens])(frame)
    assert len(calls) == 1
    Compose([opencv_lens, plate], backend="opencv")(frame)
    assert len(calls) == 2
    Compose([opencv_lens, UniformFog()])(frame)  # light has floats, and OpenCV them too
    assert len(calls) == 3


class Frames(Dataset):
    """Frames as OpenCV reads them, degraded where they are loaded."""

    def __len__(self) -> int:
        return 3

    def __getitem__(self, i: int) -> Tensor:
        lens = LensDistortion(k1_range=(-0.3, -0.3), tolerance_px=0.05, backend="opencv")
        return lens.degrade(levels(3, 151, 263, seed=i), seed=7, keys=[i]).image


@pytest.mark.filterwarnings("ignore:.*multi-threaded, use of fork:DeprecationWarning")  # it is what is tested
@pytest.mark.parametrize("context", ["fork", "spawn"])
def test_workers_of_a_loader_find_the_same(context):
    expected = torch.stack([Frames()[i] for i in range(3)])
    (found,) = DataLoader(Frames(), batch_size=3, num_workers=1, multiprocessing_context=context)
    assert torch.equal(found, expected)


def test_a_model_with_a_resampler_is_saved_whole():
    buffer = io.BytesIO()
    torch.save(LensDistortion(backend="opencv"), buffer)
    buffer.seek(0)
    assert torch.load(buffer, weights_only=False).backend == "opencv"
