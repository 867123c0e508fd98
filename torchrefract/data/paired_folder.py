"""Old path of `torchrefract.data.pairs.dataset`, until its callers have moved."""

from torchrefract.data.pairs.dataset import PairedFolder, PairStream

__all__ = ["PairStream", "PairedFolder"]
