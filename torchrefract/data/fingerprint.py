"""Old path of `torchrefract.data.module.fingerprint`, until its callers have moved."""

from torchrefract.data.module import fingerprint

__all__ = ["fingerprint"]
