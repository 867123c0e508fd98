"""Pair sets on disk: generation, files, manifest and datasets."""

from torchrefract.data.pairs.dataset import PairedFolder
from torchrefract.data.pairs.stream import PairStream

__all__ = ["PairStream", "PairedFolder"]
