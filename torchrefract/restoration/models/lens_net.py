"""A small network that tells a lens by the lines of the frame, which a lens bends and its inverse straightens."""

import math
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from torchrefract._tensor import pad_to_multiple, without_autocast
from torchrefract._validation import check_count, check_rgb
from torchrefract.restoration.models.coordconv import PolynomialFlowHead, cell_axes, pixel_coordinates

_CELL = 4  # px
_SOBEL = torch.outer(torch.tensor([1.0, 4.0, 6.0, 4.0, 1.0]), torch.tensor([-1.0, -2.0, 0.0, 2.0, 1.0])) / 128
_WEAK = 0.03  # of the range of an image, per px: the gradient that counts half
_BLACK = 1.5 / 255  # the most that the padding of an image may have in all channels
_CANDIDATES = 0.2, -0.8  # lambda of the first and the last lens: a weak pincushion and a strong barrel
_ANGLE_BIN, _OFFSET_BIN = math.radians(3), 0.015  # rad; widths
_NUM_ANGLES, _NUM_OFFSETS = 60, 100  # lines farther than 0.75 widths from the center vote for the last bin
_SCALE = 0.1  # of predictions, as the flow of a lens is some hundredths of the frame
LENS_FEATURES = 128  # of a frame
EDGE_FEATURES = 12  # of a cell


class Edges(NamedTuple):
    """The edge in each cell of 4 x 4 px, (B, N); lengths are in widths of the frame."""

    x: Tensor  # from the center of the frame
    y: Tensor
    angle: Tensor  # of the normal, rad
    strength: Tensor  # in [0, 1), the less the more directions a cell has


class LensEncoder(nn.Module):
    """Describe an image by how straight each of several lenses makes its lines.

        undistorted(p) = p / (1 + lambda |p|^2),  lambda = 0.2 … -0.8,  p in widths from the center of the frame
        concentration = log sum over lines (share of the votes for the line)^2, minus its mean over the lenses

    The edges of the frame, moved and turned by each lens, vote for lines in a Hough transform. Votes for straight lines
    concentrate on few bins. A convolutional network gives each edge several weights, and so learns which edges belong
    to straight things, as lanes and poles do, and crowns and clouds do not.

    Args:
        weightings: number of weights of an edge.
        lenses: number of lenses that are compared, at least 2.
        edges: number of edges that vote, the strongest ones.

    Raises:
        ValueError: a number is too small.

    Source: Alemán-Flores, Alvarez, Gomez, Santana-Cedrés, "Automatic lens distortion correction using one-parameter
    division models", IPOL 4 (2014), for the Hough transform of several lenses, there without learning.
    """

    def __init__(self, *, weightings: int = 8, lenses: int = 11, edges: int = 1024):
        super().__init__()
        self.num_edges, count = check_count("edges", edges), check_count("weightings", weightings)
        self.lenses = torch.linspace(*_CANDIDATES, check_count("lenses", lenses, low=2)).tolist()
        self.weights = nn.Sequential(
            *_convolution(EDGE_FEATURES, 16, dilation=1),
            *_convolution(16, 16, dilation=2),
            nn.Conv2d(16, count, 3, padding=1),
        )
        self.norm = nn.BatchNorm2d(count, affine=False)
        self.hidden = nn.Sequential(nn.Linear(count * lenses, LENS_FEATURES), nn.SiLU())

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor]:
        """Return features of the frame (B, 128, 1, 1), and those of its cells as of `find_edges`, both float32.

        Args:
            image: (B, 3, H, W), in [0, 1].

        Raises:
            ValueError: the image has another shape.
        """
        check_rgb("image", image)
        with without_autocast(image.device):
            edges, features = find_edges(image.float())
            weights = F.softplus(self.weights(features)).flatten(2) * edges.strength[:, None]
            strongest = edges.strength.topk(min(self.num_edges, edges.strength.shape[1]), sorted=False).indices
            edges = Edges(*(value.gather(1, strongest) for value in edges))
            weights = weights.gather(2, strongest[:, None].expand(-1, weights.shape[1], -1))
            concentrations = torch.stack([concentration(edges, weights, lens) for lens in self.lenses], dim=2)
            relative = concentrations - concentrations.mean(dim=2, keepdim=True)
            return self.hidden(self.norm(relative[..., None]).flatten(1))[:, :, None, None], features


class LensNet(nn.Module):
    """Predict smooth maps of the whole frame from the straightness of its lines.

    A `PolynomialFlowHead`, which starts at zero, turns the features of a `LensEncoder` into maps. A network that has to
    find curvature by convolutions alone needs many times more frames.

    Args:
        channels: number of maps.
        weightings, lenses, edges: see `LensEncoder`.
        smooth: must be True, as for the flow of a lens.

    Raises:
        ValueError: a number is too small, or `smooth` is False.
    """

    def __init__(
        self, channels: int, *, weightings: int = 8, lenses: int = 11, edges: int = 1024, smooth: bool = False
    ):
        super().__init__()
        if not smooth:
            raise ValueError("task must predict a flow for lens_net, as undistort does: add model=resunet")
        self.encoder = LensEncoder(weightings=weightings, lenses=lenses, edges=edges)
        self.head = PolynomialFlowHead(LENS_FEATURES, channels)

    def forward(self, image: Tensor) -> Tensor:
        """Predict the maps (B, channels, ceil(H / 4), ceil(W / 4)), float32, for images (B, 3, H, W) in [0, 1]."""
        return _SCALE * self.head(self.encoder(image)[0], *cell_axes(image, _CELL))


def find_edges(image: Tensor) -> tuple[Edges, Tensor]:
    """Find the edge of each cell of an image.

    The gradients of a cell, as the mean of their structure tensor, give one direction; their position is the mean over
    the pixels, weighted by the squared gradient. Black counts as padding: cells next to it have no edge.

    Args:
        image: (B, 3, H, W), in [0, 1].

    Returns:
        The edges, (B, N), and inputs for a network, (B, 12, ceil(H / 4), ceil(W / 4)): strength, direction, position in
        the cell, direction relative to the center of the frame, color, coordinates.

    Source: Bigün, Granlund, "Optimal orientation detection of linear symmetry", ICCV 1987.
    """
    height, width = image.shape[2:]
    image = pad_to_multiple(image, _CELL)
    gray = F.pad(image.mean(dim=1, keepdim=True), (2, 2, 2, 2), mode="replicate")
    filters = _SOBEL.to(image)
    # Gradients that need pixels outside the frame would have the direction of the padding.
    inner = torch.zeros_like(image[:1, :1])
    inner[:, :, 2 : max(2, height - 2), 2 : max(2, width - 2)] = 1
    gx, gy = (inner * F.conv2d(gray, torch.stack([filters, filters.T])[:, None])).split(1, dim=1)
    energy, within = gx * gx + gy * gy, 2 * (torch.arange(_CELL).to(image) + 0.5) / _CELL - 1
    along_x = energy * within.repeat(image.shape[3] // _CELL)
    along_y = energy * within.repeat(image.shape[2] // _CELL)[:, None]
    maps = torch.cat([energy, gx * gx - gy * gy, 2 * gx * gy, along_x, along_y, image], dim=1)
    moments, color = F.avg_pool2d(maps, _CELL).split((5, 3), dim=1)
    padding = F.max_pool2d((image.amax(dim=1, keepdim=True) < _BLACK).to(image), _CELL)
    energy, cosine, sine, right, down = (moments * (1 - F.max_pool2d(padding, 3, 1, 1))).split(1, dim=1)
    share = 1 / energy.clamp(min=1e-8)
    cosine, sine, right, down = (value * share for value in (cosine, sine, right, down))  # of twice the angle
    gradient = energy.clamp(min=1e-12).sqrt()
    strength = gradient / (gradient + _WEAK)
    x, y = (axis / 2 for axis in cell_axes(image[:, :, :height, :width], _CELL))
    position_x = x + right * _CELL / (2 * width)
    position_y = (y[:, None] * height + down * _CELL / 2) / width
    polar = 2 * torch.atan2(position_y, position_x)
    toward = cosine * polar.cos() + sine * polar.sin(), sine * polar.cos() - cosine * polar.sin()
    directed = (strength * value for value in (cosine, sine, right, down, *toward))
    features = torch.cat([strength, *directed, 4 * color - 2, pixel_coordinates(color)], dim=1)
    coherence = cosine.square() + sine.square()
    angle = torch.atan2(sine, cosine) / 2
    return Edges(*(value.flatten(1) for value in (position_x, position_y, angle, strength * coherence))), features


def concentration(edges: Edges, weights: Tensor, strength: float) -> Tensor:
    """Compute how much the votes of undistorted edges concentrate on few lines.

    Args:
        edges: (B, N).
        weights: (B, K, N), at least 0, of the votes.
        strength: lambda of the lens.

    Returns:
        (B, K), log sum over lines (share of the votes)^2.
    """
    with torch.no_grad():  # positions of edges have no parameters
        angle, offset = undistorted_lines(edges, strength)
        row = (angle / _ANGLE_BIN).clamp(0.0, _NUM_ANGLES - 1e-3)
        column = (offset / _OFFSET_BIN + _NUM_OFFSETS / 2).clamp(0.0, _NUM_OFFSETS - 1e-3)
        first = row.floor() * (_NUM_OFFSETS + 1) + column.floor()
        down, right = row.frac(), column.frac()
        corners = torch.cat([first, first + 1, first + _NUM_OFFSETS + 1, first + _NUM_OFFSETS + 2], dim=1).long()
        shares = torch.cat([(1 - down) * (1 - right), (1 - down) * right, down * (1 - right), down * right], dim=1)
    votes = weights.repeat(1, 1, 4) * shares[:, None]
    bins = votes.new_zeros(*votes.shape[:2], (_NUM_ANGLES + 1) * (_NUM_OFFSETS + 1))
    bins = bins.scatter_add(2, corners[:, None].expand_as(votes), votes)
    total = weights.sum(dim=2).clamp(min=1e-6)
    return bins.square().sum(dim=2).clamp(min=1e-12).log() - 2 * total.log()


def undistorted_lines(edges: Edges, strength: float) -> tuple[Tensor, Tensor]:
    """Return the angle of the normal, in [0, pi], and the offset from the center of the lines of undistorted edges.

    The tangent t of an edge at p turns into J t with the Jacobian J of p g, g = 1 / (1 + lambda |p|^2):

        J t = g t - 2 lambda g^2 (p t) p
    """
    x, y = edges.x, edges.y
    g = 1 / (1 + strength * (x * x + y * y))
    along_x, along_y = -edges.angle.sin(), edges.angle.cos()
    pull = 2 * strength * g * g * (x * along_x + y * along_y)
    along_x, along_y = g * along_x - pull * x, g * along_y - pull * y
    angle = torch.atan2(along_y, along_x) - math.pi / 2  # in [-3 pi / 2, pi / 2]
    offset = g * (x * angle.cos() + y * angle.sin())
    turns = torch.floor(angle / math.pi)
    return angle - turns * math.pi, torch.where(turns % 2 == 0, offset, -offset)


def _convolution(inputs: int, outputs: int, *, dilation: int) -> list[nn.Module]:
    convolution = nn.Conv2d(inputs, outputs, 3, padding=dilation, dilation=dilation, bias=False)
    return [convolution, nn.BatchNorm2d(outputs), nn.SiLU()]
