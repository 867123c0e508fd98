"""Pair sets on disk: generation, files, manifest and datasets."""

from torchrefract.data.pairs.dataset import PairedFolder, PairStream

__all__ = ["PairStream", "PairedFolder"]
