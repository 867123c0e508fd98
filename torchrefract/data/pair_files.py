"""Old path of `torchrefract.data.pairs.files`, until its callers have moved."""

from torchrefract.data.pairs.files import FORMATS, DamagedPairError, PairArrays, encode_pair

__all__ = ["FORMATS", "DamagedPairError", "PairArrays", "encode_pair"]
