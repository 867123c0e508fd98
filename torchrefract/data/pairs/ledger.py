"""Old path of `torchrefract.data.pairs.output`, until its callers have moved."""

from torchrefract.data.pairs.output import claim

__all__ = ["claim"]
