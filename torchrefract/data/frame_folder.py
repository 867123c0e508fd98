"""Old path of `torchrefract.data.frames`, until its callers have moved."""

from torchrefract.data.frames import FrameFolder, list_files

walk = list_files

__all__ = ["FrameFolder", "walk"]
