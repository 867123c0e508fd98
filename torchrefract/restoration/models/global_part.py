"""What a network says of a frame as a whole: few numbers, which stand for smooth maps."""

import torch
from torch import Tensor, nn

_DEGREE = 5  # a lens with k1 and k2 has terms of the third and of the fifth
_HIDDEN = 256


class GlobalPart(nn.Module):
    """Smooth maps of a whole frame, from its features at the coarsest scale.

        map(x, y) = sum over i + j <= 5 of c_ij T_i(x) T_j(y),  T_n(x) = cos(n arccos(x)),  x and y as of `places`,

    with 21 coefficients c_ij for each channel, which two layers make of the mean and the largest of each feature. They
    start at zero.

    What a lens does to a frame is one such map, of which every pixel tells a little.

    Args:
        features: how many there are.
        channels: how many maps.
    """

    def __init__(self, features: int, channels: int):
        super().__init__()
        self.channels = channels
        self.terms = [(i, j) for i in range(_DEGREE + 1) for j in range(_DEGREE + 1 - i)]
        last = nn.Linear(_HIDDEN, channels * len(self.terms))
        for parameter in last.parameters():
            nn.init.zeros_(parameter)
        self.layers = nn.Sequential(nn.Linear(2 * features, _HIDDEN), nn.SiLU(), last)

    def forward(self, features: Tensor, x: Tensor, y: Tensor) -> Tensor:
        """(B, channels, H, W), float32.

        Args:
            features: (B, F, h, w).
            x, y: (W,) and (H,), in [-1, 1], where the maps are wanted.
        """
        flat = features.float().flatten(2)
        pooled = torch.cat([flat.mean(dim=2), flat.amax(dim=2)], dim=1)
        basis = torch.stack([_chebyshev(y, j)[:, None] * _chebyshev(x, i) for i, j in self.terms])
        if torch.is_autocast_enabled(features.device.type):
            # A flow of 100 px in 8 bits would be off by a quarter of one.
            with torch.autocast(features.device.type, enabled=False):
                return self._maps(pooled, basis)
        return self._maps(pooled, basis)

    def _maps(self, pooled: Tensor, basis: Tensor) -> Tensor:
        coefficients = self.layers(pooled).unflatten(1, (self.channels, len(self.terms)))
        return torch.einsum("bct,thw->bchw", coefficients, basis)


def _chebyshev(x: Tensor, degree: int) -> Tensor:
    return torch.cos(degree * torch.acos(x.float().clamp(-1, 1)))
