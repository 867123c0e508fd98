import itertools
import math

import cv2
import numpy as np
import pytest
import torch
import torch.nn.functional as F
from scipy import ndimage
from torch import Tensor
from torch.testing import assert_close

from torchrefract import warp
from torchrefract.warping.lattice import Lattice, LatticeFlow
from torchrefract.warping.warp import INTERPOLATIONS, PADDINGS, sample_image, sees_only_valid

# The flow reaches 4 px. Positions beyond 1.5 frames from the center are not reflected any further.
SIZES = [(1, 1), (1, 7), (9, 1), (3, 4), (37, 53)]
# Names of the paddings of F.grid_sample(align_corners=False) in SciPy.
SCIPY_MODES = {"zeros": "grid-constant", "border": "nearest", "reflection": "reflect"}
CV2_BORDERS = {"zeros": cv2.BORDER_CONSTANT, "border": cv2.BORDER_REPLICATE}


def noise(*shape: int, seed: int = 0) -> Tensor:
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def random_flow(batch: int, height: int, width: int, reach: float = 4.0) -> Tensor:
    return (2 * noise(batch, 2, height, width, seed=1) - 1) * reach


def positions(flow: Tensor) -> tuple[np.ndarray, np.ndarray]:
    """Return x and y of p + flow(p), each (B, H, W)."""
    y, x = np.mgrid[: flow.shape[2], : flow.shape[3]]
    return x + flow[:, 0].numpy(), y + flow[:, 1].numpy()


def by_scipy(image: Tensor, flow: Tensor, order: int, padding: str) -> Tensor:
    x, y = positions(flow)
    planes = [
        [ndimage.map_coordinates(c.numpy(), [y[i], x[i]], order=order, mode=SCIPY_MODES[padding]) for c in image[i]]
        for i in range(len(image))
    ]
    return torch.from_numpy(np.array(planes))


def by_opencv(image: Tensor, flow: Tensor, interpolation: int, border: int = cv2.BORDER_REPLICATE) -> Tensor:
    """Warp the first sample of a batch by cv2.remap with maps in float32."""
    x, y = (position[0].astype(np.float32) for position in positions(flow))
    source = np.ascontiguousarray(image[0].movedim(0, -1).numpy())
    return torch.from_numpy(cv2.remap(source, x, y, interpolation, borderMode=border)).movedim(-1, 0)[None]


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("padding", PADDINGS)
@pytest.mark.parametrize(("interpolation", "order"), [("bilinear", 1), ("nearest", 0)])
def test_float64_agrees_with_scipy(size, padding, interpolation, order, oracle):
    image, flow = noise(2, 3, *size), random_flow(2, *size)
    warped, _ = warp(image, flow, padding=padding, interpolation=interpolation)
    oracle("sampling, map_coordinates, fp64", warped, by_scipy(image, flow, order, padding), 1e-12, unit="")


@pytest.mark.parametrize("padding", CV2_BORDERS)
def test_bilinear_float32_agrees_with_opencv(padding, oracle):
    image, flow = noise(1, 3, 270, 480).float(), random_flow(1, 270, 480).float()
    expected = by_opencv(image, flow, cv2.INTER_LINEAR, CV2_BORDERS[padding])
    oracle("sampling, cv2.remap, fp32", warp(image, flow, padding=padding)[0], expected, 5e-4, unit="")


def test_bicubic_agrees_with_opencv_up_to_the_clamp():
    image, flow = noise(1, 3, 270, 480).float(), random_flow(1, 270, 480).float()
    low, high = image.amin(dim=(2, 3), keepdim=True), image.amax(dim=(2, 3), keepdim=True)
    expected = by_opencv(image, flow, cv2.INTER_CUBIC).clamp(low, high)
    warped, _ = warp(image, flow, padding="border", interpolation="bicubic")
    assert_close(warped, expected, rtol=0, atol=5e-4)


def test_uint8_agrees_with_opencv_within_one_level():
    image = (noise(1, 3, 120, 160) * 255).round().to(torch.uint8)
    flow = random_flow(1, 120, 160).float()
    warped, _ = warp(image, flow, padding="border")
    expected = by_opencv(image, flow, cv2.INTER_LINEAR)
    assert warped.dtype == torch.uint8
    assert (warped.int() - expected.int()).abs().max() <= 1


@pytest.mark.parametrize("padding", PADDINGS)
def test_whole_shifts_move_pixels_unchanged(padding):
    image = noise(1, 2, 12, 17).float()
    flow = torch.tensor([3.0, -2.0]).view(1, 2, 1, 1).expand(-1, -1, 12, 17)
    warped, valid = warp(image, flow, padding=padding)
    # out(x, y) = image(x + 3, y - 2) where that is on the frame.
    assert_close(warped[:, :, 2:, :-3], image[:, :, :-2, 3:], rtol=0, atol=1e-5)
    expected = torch.zeros(1, 1, 12, 17, dtype=torch.bool)
    expected[:, :, 2:, :-3] = True
    assert torch.equal(valid, expected)


def test_only_positions_within_the_outermost_pixel_centers_are_valid():
    flow = random_flow(2, 19, 23, reach=30)
    x, y = positions(flow)
    expected = torch.from_numpy((x >= 0) & (x <= 22) & (y >= 0) & (y <= 18))[:, None]
    assert torch.equal(warp(noise(2, 1, 19, 23), flow)[1], expected)


@pytest.mark.parametrize(
    ("dtype", "largest"),
    [(torch.int64, 2**40), (torch.int32, 2**31 - 1), (torch.int16, 2**15 - 1), (torch.uint8, 255)],
)
def test_nearest_keeps_the_values_of_integer_masks(dtype, largest):
    # The sampler works in float64, so integers are exact up to 2^53.
    image = torch.randint(largest - 50, largest + 1, (2, 1, 31, 29), generator=torch.Generator().manual_seed(0))
    flow = random_flow(2, 31, 29)
    warped, _ = warp(image.to(dtype), flow.float(), padding="border", interpolation="nearest")
    assert warped.dtype == dtype
    assert torch.equal(warped.long(), by_scipy(image.double(), flow, 0, "border").long())


def test_nearest_keeps_boolean_masks():
    image, flow = noise(2, 1, 31, 29) > 0.5, random_flow(2, 31, 29)
    warped, _ = warp(image, flow.float(), padding="border", interpolation="nearest")
    assert torch.equal(warped, by_scipy(image.double(), flow, 0, "border") > 0.5)


def test_bilinear_rounds_integers_to_the_nearest():
    image = torch.tensor([0, 10, 21], dtype=torch.int32).view(1, 1, 1, 3)
    flow = torch.tensor([0.24, 0.5, 0.0]).view(1, 1, 1, 3)
    warped, _ = warp(image, torch.cat([flow, torch.zeros_like(flow)], dim=1))
    assert warped.flatten().tolist() == [2, 16, 21]


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_types_are_sampled_in_float32(dtype):
    image = noise(1, 1, 1080, 1920).to(dtype)
    flow = torch.tensor([0.25, -0.5]).view(1, 2, 1, 1).expand(-1, -1, 1080, 1920)
    warped, _ = warp(image, flow, padding="border")
    assert warped.dtype == dtype
    # The bilinear weights are 3/4 and 1/4 along a row, and 1/2 and 1/2 of this row and the one above.
    exact = image.double()
    rows = 0.5 * exact[..., 1:, :] + 0.5 * exact[..., :-1, :]
    expected = 0.75 * rows[..., :-1] + 0.25 * rows[..., 1:]
    # Half a unit in the last place of 1, plus the rounding of float32 coordinates.
    tolerance = torch.finfo(dtype).eps / 2 + 1e-3
    assert_close(warped[..., 1:, :-1].double(), expected, rtol=0, atol=tolerance)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_a_half_flow_is_converted_to_float32(dtype):
    image, flow = noise(1, 1, 31, 300).float(), random_flow(1, 31, 300).to(dtype)
    assert torch.equal(warp(image, flow)[0], warp(image, flow.float())[0])


@pytest.mark.parametrize("shift", [1e6, -1e6])
@pytest.mark.parametrize("interpolation", INTERPOLATIONS)
def test_positions_a_million_pixels_away_get_the_padding(shift, interpolation):
    image = noise(1, 1, 8, 9).float()
    flow = torch.full((1, 2, 8, 9), shift)
    corner = image[..., -1, -1] if shift > 0 else image[..., 0, 0]
    for padding, expected in (("zeros", torch.zeros(1, 1)), ("border", corner)):
        warped, valid = warp(image, flow, padding=padding, interpolation=interpolation)
        assert_close(warped, expected[..., None, None].expand_as(warped), rtol=0, atol=1e-6)
        assert not valid.any()


@pytest.mark.parametrize("value", [torch.nan, torch.inf, -torch.inf])
@pytest.mark.parametrize(("interpolation", "support"), [("nearest", 0.5), ("bilinear", 1), ("bicubic", 2)])
def test_invalid_pixels_affect_only_their_neighbors(value, interpolation, support):
    image, flow = noise(2, 2, 40, 30).float() > 0.5, random_flow(2, 40, 30).float()
    image = image * 0.6 + 0.2
    changed = image.clone()
    changed[0, 1, 20, 10] = value
    clean, _ = warp(image, flow, padding="border", interpolation=interpolation)
    warped, _ = warp(changed, flow, padding="border", interpolation=interpolation)
    x, y = positions(flow[:1])
    near = torch.from_numpy((np.abs(x - 10) < support + 1e-3) & (np.abs(y - 20) < support + 1e-3))
    assert torch.equal(warped[1], clean[1])
    assert torch.equal(warped[0, 0], clean[0, 0])
    assert torch.equal(warped[0, 1][~near[0]], clean[0, 1][~near[0]])
    assert not warped[0, 1][near[0]].isfinite().all()


@pytest.mark.parametrize("interpolation", INTERPOLATIONS)
@pytest.mark.parametrize("shape", [(3, 1, 1, 1), (2, 4, 1, 13), (2, 4, 13, 1), (1, 12, 31, 37), (2, 1, 16, 16)])
def test_each_channel_and_sample_is_warped_alone(shape, interpolation):
    image, flow = noise(*shape).float(), random_flow(shape[0], *shape[2:]).float()
    warped, valid = warp(image, flow, interpolation=interpolation)
    for i, channel in itertools.product(range(shape[0]), range(shape[1])):
        alone, mask = warp(image[i : i + 1, [channel]], flow[i : i + 1], interpolation=interpolation)
        assert torch.equal(alone[0, 0], warped[i, channel])
        assert torch.equal(mask[0], valid[i])


def test_the_memory_format_is_kept_and_changes_no_value():
    image, flow = noise(2, 3, 12, 16).float(), random_flow(2, 12, 16).float()
    expected, _ = warp(image, flow)
    last, _ = warp(image.contiguous(memory_format=torch.channels_last), flow)
    assert torch.equal(last, expected)
    assert last.is_contiguous(memory_format=torch.channels_last)
    strided = torch.stack([image, image], dim=-1)[..., 0]
    flipped = flow.mT.contiguous().mT
    assert torch.equal(warp(strided, flipped)[0], expected)
    assert warp(strided, flipped)[0].is_contiguous()


@pytest.mark.parametrize("layout", [torch.contiguous_format, torch.channels_last])
def test_vmap_over_flows_warps_one_image_along_each(layout):
    image = noise(1, 3, 6, 8).float().contiguous(memory_format=layout)
    flows = random_flow(4, 6, 8).float()[:, None]
    warped, valid = torch.vmap(lambda flow: warp(image, flow))(flows)
    for i, flow in enumerate(flows):
        expected, expected_valid = warp(image, flow)
        assert_close(warped[i], expected, rtol=0, atol=1e-6)
        assert torch.equal(valid[i], expected_valid)


def test_an_unbatched_image_is_a_batch_of_one():
    image, flow = noise(3, 12, 16).float(), random_flow(1, 12, 16)[0].float()
    warped, valid = warp(image, flow)
    batched, mask = warp(image[None], flow[None])
    assert torch.equal(warped, batched[0])
    assert torch.equal(valid, mask[0])


def test_one_flow_serves_a_whole_batch():
    image, flow = noise(3, 2, 12, 16).float(), random_flow(1, 12, 16).float()
    assert torch.equal(warp(image, flow)[0], warp(image, flow.expand(3, -1, -1, -1))[0])


@pytest.mark.parametrize("size", [(3, 7680), (4320, 3), (2, 8192), (1, 40000), (40000, 1)])
@pytest.mark.parametrize("padding", PADDINGS)
def test_positions_in_large_frames_are_exact_to_a_thousandth_of_a_pixel(size, padding):
    # A triangle wave has slope 1 and small values, so its change is the error in px; its rounding is 1e-5.
    position = torch.arange(max(size))
    wave = ((position % 128) - 64).abs().float()
    image = (wave if size[1] > size[0] else wave[:, None]).expand(1, 1, *size)
    flow = torch.zeros(1, 2, *size)
    for shift in (0.0, 3.0, 3.37):
        flow[:, 0 if size[1] > size[0] else 1] = shift
        warped, valid = warp(image, flow, padding=padding)
        dim, share = 3 if size[1] > size[0] else 2, shift % 1
        expected = (1 - share) * image.roll(-int(shift), dims=dim) + share * image.roll(-int(shift) - 1, dims=dim)
        assert_close(warped[valid], expected[valid], rtol=0, atol=1e-3 - 1e-5)
        assert valid.sum() == valid.numel() // max(size) * (max(size) - math.ceil(shift))


@pytest.mark.parametrize("padding", PADDINGS)
def test_bilinear_gradients_are_those_of_finite_differences(padding):
    image = noise(2, 2, 4, 5).requires_grad_()
    # Bilinear sampling has no derivative at whole pixels. Parts of the flow lead outside.
    flow = (torch.randint(-2, 3, (2, 2, 4, 5), generator=torch.Generator().manual_seed(3)) + 0.37).double()
    assert torch.autograd.gradcheck(lambda i, f: warp(i, f, padding=padding)[0], [image, flow.requires_grad_()])


@pytest.mark.parametrize("padding", ["zeros", "border", "reflection"])
def test_bicubic_gradients_are_those_of_finite_differences_also_where_values_are_clamped(padding):
    image = noise(1, 2, 7, 8)
    image = 0.9 * image.round() + 0.1 * image  # two levels overshoot
    flow = (torch.randint(-2, 3, (1, 2, 7, 8), generator=torch.Generator().manual_seed(3)) + 0.37).double()
    sampled = warp(image, flow, padding=padding, interpolation="bicubic")[0]
    is_clamped = sampled == image.amax(dim=(2, 3), keepdim=True)
    assert is_clamped.any()

    def warped(image: Tensor, flow: Tensor) -> Tensor:
        return warp(image, flow, padding=padding, interpolation="bicubic")[0]

    assert torch.autograd.gradcheck(warped, [image.requires_grad_(), flow.requires_grad_()])


@pytest.mark.parametrize(
    ("image", "flow", "rule"),
    [
        ((3, 8, 9), (1, 2, 8, 9), r"image must have shape \(B, C, H, W\) with a batched flow"),
        ((1, 3, 8, 9), (2, 8, 9), r"flow must have shape \(B, 2, H, W\)"),
        ((1, 3, 8, 9), (1, 3, 8, 9), r"flow must have shape \(B, 2, H, W\)"),
        ((1, 3, 8, 9), (1, 2, 9, 8), "flow must have the batch and the size of the image"),
        ((3, 1, 8, 9), (2, 2, 8, 9), "flow must have the batch and the size of the image"),
        ((8, 9), (1, 2, 8, 9), "image must have shape"),
    ],
)
def test_shapes_that_do_not_match_raise(image, flow, rule):
    with pytest.raises(ValueError, match=rule):
        warp(torch.zeros(image), torch.zeros(flow))


@pytest.mark.parametrize(
    ("options", "rule"),
    [
        ({"padding": "wrap"}, "padding must be one of zeros, border, reflection, got 'wrap'"),
        ({"interpolation": "lanczos"}, "interpolation must be one of nearest, bilinear, bicubic, got 'lanczos'"),
    ],
)
def test_an_unknown_option_raises(options, rule):
    with pytest.raises(ValueError, match=rule):
        warp(torch.zeros(1, 1, 2, 2), torch.zeros(1, 2, 2, 2), **options)


@pytest.mark.parametrize(
    ("image", "flow", "rule"),
    [
        (torch.zeros(1, 1, 2, 2), torch.zeros(1, 2, 2, 2, dtype=torch.int64), "flow must be of a floating type"),
        (torch.zeros(1, 1, 2, 2, dtype=torch.complex64), torch.zeros(1, 2, 2, 2), "image must be real"),
        (np.zeros((1, 1, 2, 2)), torch.zeros(1, 2, 2, 2), "image must be a tensor"),
        (torch.zeros(1, 1, 2, 2), None, "flow must be a tensor"),
    ],
)
def test_types_that_are_not_supported_raise(image, flow, rule):
    with pytest.raises(TypeError, match=rule):
        warp(image, flow)


def smooth_flow(seed: int, size: tuple[int, int], px: float) -> Tensor:
    """Return a flow (2, 2, H, W) with displacements of about `px`."""
    nodes = torch.randn(2, 2, 4, 5, generator=torch.Generator().manual_seed(seed))
    return px * F.interpolate(nodes, size=size, mode="bilinear")


@pytest.mark.quick
def test_a_pixel_sees_only_valid_pixels_if_all_with_a_weight_are_valid():
    valid = torch.ones(1, 1, 20, 30, dtype=torch.bool)
    valid[..., 8, 12] = False
    flow = smooth_flow(1, (20, 30), 2.0)[:1]
    x, y = positions(flow)
    # The bilinear weight of the invalid pixel, and the share of the 2 x 2 pixels that is on the frame.
    weight = np.clip(1 - np.abs(x - 12), 0, 1) * np.clip(1 - np.abs(y - 8), 0, 1)
    share = np.clip(np.minimum(x + 1, 30 - x), 0, 1) * np.clip(np.minimum(y + 1, 20 - y), 0, 1)
    expected = torch.from_numpy(share - weight)[:, None]
    is_clear = (expected - 0.999).abs() > 1e-4
    result = sees_only_valid(valid, flow)
    assert torch.equal(result[is_clear], (expected > 0.999)[is_clear])
    assert 0 < (~result).sum() < result.numel()


@pytest.mark.parametrize("backend", ["auto", "torch"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.uint8])
def test_a_lattice_flow_warps_like_its_dense_flow(backend, dtype):
    lattice = Lattice(150, 140, stride=16, margin=2)
    flow = LatticeFlow(3 * torch.randn(2, 2, *lattice.num_nodes, generator=torch.Generator().manual_seed(0)), lattice)
    image = (255 * noise(2, 3, 150, 140)).to(dtype) if dtype is torch.uint8 else noise(2, 3, 150, 140).to(dtype)
    options = {"padding": "zeros", "interpolation": "bilinear", "backend": backend}
    result, expected = sample_image(image, flow, **options), sample_image(image, flow.dense(), **options)
    difference = (result.double() - expected.double()).abs().max()
    assert difference <= (1 if dtype is torch.uint8 else 1e-4)
