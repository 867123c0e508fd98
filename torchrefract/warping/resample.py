"""Looking an image up along a flow, by what is fastest and gives what F.grid_sample gives."""

from collections.abc import Iterable
from typing import cast

import torch
from torch import Tensor

from torchrefract._compiled import SMALLEST
from torchrefract._tensor import cat_bands, has_memory_format, is_channels_last, round_to_dtype, rows_at_once
from torchrefract._validation import check_choice, check_flow, check_tensor, requires_grad
from torchrefract.warping import fused, on_gpu
from torchrefract.warping.grid import Positions, field_dtype, inside, sampler_grids
from torchrefract.warping.grid_sample import INTERPOLATIONS, PADDINGS, WHOLE, by_grid_sample
from torchrefract.warping.lattice import LatticeFlow
from torchrefract.warping.mixed import Flow, grid_of, known
from torchrefract.warping.opencv import obstacle, remapped

BACKENDS = ("auto", "torch", "numba", "opencv")
# Above this, float32 coordinates of the sampler are off by more than 1/1000 px.
_LARGEST_FLOAT32_SIDE = 8192
_CACHED = 1 << 18  # positions of a grid that stay in a core's cache


def warp(
    image: Tensor,
    flow: Tensor,
    *,
    padding: str = "zeros",
    interpolation: str = "bilinear",
    backend: str = "auto",
) -> tuple[Tensor, Tensor]:
    """The image looked up along a backward flow, and where that look-up stays on the image.

        out(p) = image(p + flow(p)),  valid(p) = 0 <= p + flow(p) <= size - 1

    Coordinates are float32 (float64 for a float64 image) whatever the type of the image; flow that is not finite is
    looked up outside and is not valid.

    Args:
        image: (B, C, H, W) or (C, H, W), floating or integer; integers are converted, rounded and clamped.
        flow: (B, 2, H, W) or (1, 2, H, W), px, u (right) and v (down); (2, H, W) for an unbatched image.
        padding: what lies outside: "zeros", "border" or "reflection" (of positions up to 3/2 frames off the center).
        interpolation: "nearest", "bilinear" or "bicubic" (a = -3/4, clamped to the range of the image's values).
        backend: "torch", of PyTorch; "numba", for float32 or uint8 on the CPU, bilinear, to the bits of
            "torch" and with its gradients; "opencv", for float32 or uint8 of 1, 3 or 4 channels on the CPU,
            without gradients, not for bicubic; or "auto": numba for frames from 2^14 pixels on, where it is installed,
            else OpenCV from version 5 on, where that is, for uint8 in channels_last format, on as many threads as
            cv2.setNumThreads says. OpenCV agrees to 1e-6 of the range of the values before these are rounded: bytes
            differ, by one level, where they lie so near to a half. On a GPU "auto" has effects that know their flow on
            a lattice read float32, bilinear, by a kernel of Triton, where that is.

    Returns:
        image of the same shape, type and memory format, and valid, (B, 1, H, W) or (1, H, W), bool.

    Raises:
        ValueError: shapes that do not fit, an unknown padding, interpolation or backend, what a backend cannot do.
        TypeError: an argument that is no tensor, a flow of integers.
    """
    check_tensor("image", image)
    check_tensor("flow", flow)
    if image.ndim == 3 and flow.ndim == 3:
        options = {"padding": padding, "interpolation": interpolation, "backend": backend}
        warped, valid = warp(image[None], flow[None], **options)
        return warped[0], valid[0]
    _check_fit(image, flow)
    check_choice("padding", padding, PADDINGS)
    check_choice("interpolation", interpolation, INTERPOLATIONS)
    check_choice("backend", backend, BACKENDS)
    flow = flow.to(field_dtype(image.dtype)).expand(image.shape[0], -1, -1, -1)
    found = sample_image(image, flow, padding=padding, interpolation=interpolation, backend=backend)
    return found, inside(flow)


def sample_image(
    image: Tensor,
    flow: Flow | Positions,
    *,
    padding: str,
    interpolation: str,
    backend: str = "auto",
    active: Tensor | None = None,
) -> Tensor:
    """The image (B, C, H, W) at p + flow(p), flow being (B, 2, H, W) in px; the arguments are taken as checked.

    active: (B,), bool: the other samples come back as they are; None is all.
    """
    if image.numel() == 0:
        return image.clone()
    dtype = sampler_dtype(image, flow.dtype)
    if backend == "auto" and interpolation == "bilinear" and on_gpu.serves(image, flow, dtype):
        found = on_gpu.looked_up(image.to(dtype), cast(LatticeFlow, flow), padding=padding, active=active)
        return _laid_out(_in_type(found, image), image)
    found = _looked_up(image, flow, dtype, padding=padding, interpolation=interpolation, backend=backend)
    return found if active is None else torch.where(active.view(-1, 1, 1, 1), found, image)


def _looked_up(
    image: Tensor, flow: Flow | Positions, dtype: torch.dtype, *, padding: str, interpolation: str, backend: str
) -> Tensor:
    """`look_up` of all samples, at positions of a type, by what serves a CPU or by F.grid_sample."""
    options = {"padding": padding, "interpolation": interpolation}
    # Bytes go as they are where nothing is learned from them; the kernels make them numbers as they read them.
    source = image if image.dtype is torch.uint8 and not requires_grad((flow,)) else image.to(dtype)
    if backend == "numba" or (backend == "auto" and image.shape[2] * image.shape[3] >= SMALLEST):
        why = fused.obstacle(source, flow, interpolation=interpolation)
        if why is None:
            return _laid_out(_in_type(fused.looked_up(source, flow, padding=padding), image), image)
        _refuse(backend, "numba", why)
    if backend == "opencv" or (backend == "auto" and _suits_opencv(image)):
        positions = flow.grid if isinstance(flow, Positions) else known(flow)
        why = obstacle(image, positions, interpolation=interpolation, positions=dtype)
        if why is None:
            return _laid_out(remapped(image, _grids(image, flow, dtype, whole=False), **options), image)
        _refuse(backend, "opencv", why)
    source = source.to(dtype)

    def looked_up(grid: Tensor) -> Tensor:
        found = by_grid_sample(source, grid, padding=padding, interpolation=interpolation)
        # What bicubics overshoot is cut first.
        return found if interpolation == "bicubic" else _in_type(found, image)

    bands = map(looked_up, _grids(image, flow, dtype, whole=(interpolation, padding) == WHOLE))
    warped = cat_bands(bands, dim=2, length=image.shape[2])
    if interpolation == "bicubic":
        warped = _in_type(_clamped(warped, source, padding), image)
    return _laid_out(warped, image)


def sampler_dtype(image: Tensor, dtype: torch.dtype) -> torch.dtype:
    """The type that an image is looked up in along a flow of a type."""
    large = max(image.shape[2:]) > _LARGEST_FLOAT32_SIDE
    # The CPU sampler of half types is wrong above 2^15 pixels, and no type of 16 bits holds a coordinate.
    return torch.float64 if large else torch.promote_types(field_dtype(image.dtype), dtype)


def sampled(source: Tensor, grid: Tensor, *, padding: str, interpolation: str) -> Tensor:
    """What F.grid_sample reads of a source (B, C, H, W) along its grid (B, n, m, 2), finite, by what is fastest."""
    positions = Positions(grid)
    if (
        grid.shape[1] * grid.shape[2] >= SMALLEST
        and fused.obstacle(source, positions, interpolation=interpolation) is None
    ):
        return fused.looked_up(source, positions, padding=padding)
    return by_grid_sample(source, grid, padding=padding, interpolation=interpolation)


def _check_fit(image: Tensor, flow: Tensor) -> None:
    check_flow("flow", flow)
    if image.ndim != 4:
        raise ValueError(f"image must have shape (B, C, H, W) beside a batched flow, got {tuple(image.shape)}")
    if image.is_complex():
        raise TypeError(f"image must be real, got {image.dtype}")
    if image.shape[2:] != flow.shape[2:] or flow.shape[0] not in (1, image.shape[0]):
        raise ValueError(
            f"flow must have the batch and the size of the image, {tuple(image.shape)}, got {tuple(flow.shape)}"
        )


def _suits_opencv(image: Tensor) -> bool:
    """Whether OpenCV is faster: for bytes that lie in memory as it has them."""
    # Of floats PyTorch is. One sample is asked, so that the batch around it changes nothing.
    return image.dtype is torch.uint8 and is_channels_last(image[:1])


def _refuse(backend: str, name: str, why: str) -> None:
    """Raise if it was asked for by its name."""
    if backend == name:
        raise ValueError(f"backend must be auto or grid_sample {why}, got {name!r}")


def _in_type(warped: Tensor, image: Tensor) -> Tensor:
    """Values in the type of the image; those of whole numbers are rounded."""
    if warped.dtype is image.dtype:
        return warped
    return warped if image.is_floating_point() else round_to_dtype(warped, image.dtype).to(image.dtype)


def _laid_out(warped: Tensor, image: Tensor) -> Tensor:
    """The warped image in the type and the memory format of the image."""
    layout = torch.channels_last if is_channels_last(image) and has_memory_format(warped) else torch.contiguous_format
    # `to` with a format copies what has the type and the format already.
    if warped.dtype is image.dtype:
        return warped.contiguous(memory_format=layout)
    return warped.to(image.dtype, memory_format=layout)


def _clamped(warped: Tensor, source: Tensor, padding: str) -> Tensor:
    # Pixels that are not finite must stay where they are: as bounds they would spread over the whole image.
    known, source = source.isfinite(), source.detach()
    low = torch.where(known, source, torch.inf).amin(dim=(2, 3), keepdim=True)
    high = torch.where(known, source, -torch.inf).amax(dim=(2, 3), keepdim=True)
    if padding == "zeros":
        low, high = low.clamp(max=0), high.clamp(min=0)
    return torch.where(warped.isfinite(), warped.clamp(low, high), warped)


def _grids(image: Tensor, flow: Flow | Positions, dtype: torch.dtype, *, whole: bool) -> Iterable[Tensor]:
    batch, _, rows, width = image.shape
    # The backward pass keeps one gradient image a band.
    if not (whole or requires_grad((image,))):
        rows = rows_at_once(image.device, rows, each=batch * width, cached=_CACHED)
    if isinstance(flow, Tensor):
        return sampler_grids(flow.to(dtype), rows=rows)
    grid = flow.grid if isinstance(flow, Positions) else grid_of(flow, dtype)
    # What is looked up in bands is still in the cache when it is rounded; of numbers nothing would be faster.
    return [grid] if image.is_floating_point() else grid.split(rows, dim=1)
