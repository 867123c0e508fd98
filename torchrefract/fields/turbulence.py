"""Turbulence: a flow of two independent random fields."""

from torch import Tensor

from torchrefract.fields.random_field import FieldParams, Frequencies, node_positions, sample_field
from torchrefract.warping.lattice import Lattice

_SMALLEST_SHARE = 1e-8  # of the path


def turbulence_flow(
    params: FieldParams,
    amplitude: Tensor,
    *,
    covariance: str,
    frequencies: Frequencies,
    lattice: Lattice,
    normalize: str = "theory",
) -> tuple[Tensor, Tensor]:
    """Compute the flow of turbulent air at the nodes of a lattice.

        flow = amplitude (R_1, R_2),  Var R = 1,  Cov(R(p), R(q)) = C(|p - q| / length), smoothed by the aperture

    Args:
        params: of N fields.
        amplitude: (N,), px, standard deviation of each component.
        covariance: one of COVARIANCES.
        frequencies: of the domain; all of them, or the lowest ones.
        lattice: where the flow is computed.
        normalize: "theory" gives the amplitude to the fields of all draws together; "image" subtracts from each field
            its mean over the frame and divides by its standard deviation there, which needs a lattice of stride 1.

    Returns:
        flow: (N, 2, h, w), px.
        clipped: (N,), share of the spectrum that is negative and was set to 0.

    Source: Dietrich and Newsam, SIAM J. Sci. Comput. 18 (1997), for the sampling; Taylor, "The spectrum of turbulence",
    Proc. Royal Society A 164 (1938), for air that the wind carries.
    """
    rows, columns = node_positions(lattice)
    field, clipped = sample_field(params, frequencies, rows, columns, kind=covariance, dtype=amplitude.dtype)
    if normalize == "image":
        first = lattice.margin
        frame = field[:, :, first : first + lattice.height, first : first + lattice.width]
        mean = frame.mean(dim=(2, 3), keepdim=True)
        variance = (frame - mean).square().mean(dim=(2, 3), keepdim=True)
        field = (field - mean) / variance.clamp(min=1e-12).sqrt()
    return amplitude[:, None, None, None] * field, clipped


def share_at_depth(depth: Tensor, reference_distance: float) -> Tensor:
    """Return the share of the displacement that the air up to a depth causes: sqrt(min(d, D) / D).

    The variance of the angle of arrival grows with the length of the path through air of one strength.

    Args:
        depth: m, of any shape, inf for the sky.
        reference_distance: m, D.

    Source: Fried, "Optical resolution through a randomly inhomogeneous medium", JOSA 56 (1966).
    """
    # The root of 0 would have an infinite gradient.
    return (depth / reference_distance).clamp(min=_SMALLEST_SHARE, max=1).sqrt()
