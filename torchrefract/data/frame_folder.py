"""Old path of `torchrefract.data.frames`, until its callers have moved."""

from torchrefract.data.frames import FrameFolder, walk

__all__ = ["FrameFolder", "walk"]
