"""Warp images along backward flows."""

from torch import Tensor

from torchrefract._validation import check_choice, check_flow, check_tensor
from torchrefract.ops.sampling import BACKENDS, INTERPOLATIONS, PADDINGS, sample
from torchrefract.warping.grid import field_dtype, inside
from torchrefract.warping.lattice import LatticeFlow


def warp(
    image: Tensor,
    flow: Tensor,
    *,
    padding: str = "zeros",
    interpolation: str = "bilinear",
    backend: str = "auto",
) -> tuple[Tensor, Tensor]:
    """Warp an image along a backward flow.

        out(p) = image(p + flow(p)),  valid(p) = 0 <= p + flow(p) <= size - 1

    Coordinates are float32, or float64 for a float64 image. A position that is NaN or infinite lies outside and is not
    valid.

    Args:
        image: (B, C, H, W) or (C, H, W), floating or integer. Integers are converted, rounded and clamped.
        flow: (B, 2, H, W) or (1, 2, H, W), px, u (right) and v (down); (2, H, W) for an unbatched image.
        padding: values outside of the image: "zeros", "border" (the nearest pixel) or "reflection" (of positions up to
            3/2 frames off the center).
        interpolation: "nearest", "bilinear" or "bicubic" (a = -3/4, clamped to the range of the image's values).
        backend: "torch"; "numba", for bilinear sampling on the CPU in float32 or of uint8; "triton", which samples
            only flows on lattices; or "auto", the fastest one for the arguments. Backends agree to 1e-5 of the range
            of the values, and to one level for uint8. Where a gradient is needed, torch serves.

    Returns:
        The warped image, of the shape, type and memory format of the image, and valid, (B, 1, H, W) or (1, H, W),
        bool.

    Raises:
        ValueError: shapes that do not match, an unknown padding, interpolation or backend, or a backend that does not
            support the arguments.
        TypeError: an argument that is not a tensor, a complex image, or a flow of integers.
    """
    check_tensor("image", image)
    check_tensor("flow", flow)
    if image.ndim == 3 and flow.ndim == 3:
        options = {"padding": padding, "interpolation": interpolation, "backend": backend}
        warped, valid = warp(image[None], flow[None], **options)
        return warped[0], valid[0]
    _check_match(image, flow)
    check_choice("padding", padding, PADDINGS)
    check_choice("interpolation", interpolation, INTERPOLATIONS)
    check_choice("backend", backend, BACKENDS)
    flow = flow.to(field_dtype(image.dtype))
    warped = sample_image(image, flow, padding=padding, interpolation=interpolation, backend=backend)
    return warped, inside(flow).expand(image.shape[0], -1, -1, -1)


def sample_image(
    image: Tensor,
    flow: Tensor | LatticeFlow,
    *,
    padding: str,
    interpolation: str,
    backend: str = "auto",
    active: Tensor | None = None,
) -> Tensor:
    """Sample an image at p + flow(p), without checks.

    Args:
        image: (N, C, H, W).
        flow: (N or 1, 2, H, W), px, or at the nodes of a lattice over the image.
        padding, interpolation, backend: as for `warp`.
        active: (N,), bool, samples to warp; the others come back bit for bit. None for all.

    Returns:
        (N, C, H, W), of the type and the memory format of the image.
    """
    options = {"padding": padding, "interpolation": interpolation, "backend": backend, "active": active}
    if isinstance(flow, Tensor):
        return sample(image, flow, **options)
    return sample(image, flow.nodes, stride=flow.lattice.stride, margin=flow.lattice.margin, **options)


def sees_only_valid(valid: Tensor, flow: Tensor) -> Tensor:
    """Return True where bilinear sampling along a flow mixes valid pixels only, up to weights of 1/1000.

    Args:
        valid: (B, 1, H, W), bool. Pixels outside of the frame are not valid.
        flow: (B, 2, H, W), px.

    Returns:
        (B, 1, H, W), bool.
    """
    share = valid.to(flow.dtype)
    return sample_image(share, flow.detach(), padding="zeros", interpolation="bilinear") > 0.999


def _check_match(image: Tensor, flow: Tensor) -> None:
    check_flow("flow", flow)
    if image.ndim != 4:
        raise ValueError(f"image must have shape (B, C, H, W) with a batched flow, got {tuple(image.shape)}")
    if image.is_complex():
        raise TypeError(f"image must be real, got {image.dtype}")
    if image.shape[2:] != flow.shape[2:] or flow.shape[0] not in (1, image.shape[0]):
        raise ValueError(
            f"flow must have the batch and the size of the image, {tuple(image.shape)}, got {tuple(flow.shape)}"
        )
