"""Old path of `torchrefract.data.pairs.manifest`, until its callers have moved."""

from torchrefract.data.pairs.manifest import PairRow, StoredFile, read_row

Stored = StoredFile

__all__ = ["PairRow", "Stored", "read_row"]
