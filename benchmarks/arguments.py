"""What the commands of this folder are told."""

import argparse
from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

from torchrefract.data.images import fit, read_image


def frame_of(path: Path | None, size: tuple[int, int]) -> Tensor:
    """A picture cut to a size, or without one noise: (1, 3, H, W)."""
    return torch.rand(1, 3, *size) if path is None else fit(read_image(path), size)[None]


def size(text: str) -> tuple[int, int]:
    """HEIGHTxWIDTH, px."""
    height, cross, width = text.partition("x")
    if not (cross and height.isdecimal() and width.isdecimal() and int(height) and int(width)):
        raise argparse.ArgumentTypeError(f"must be HEIGHTxWIDTH in px, got {text!r}")
    return int(height), int(width)


def count(low: int) -> Callable[[str], int]:
    """A reader of whole numbers from `low` on."""

    def read(text: str) -> int:
        if not text.isdecimal() or int(text) < low:
            raise argparse.ArgumentTypeError(f"must be a whole number of at least {low}, got {text!r}")
        return int(text)

    return read


def shape(text: str) -> tuple[int, ...]:
    """BATCHxCHANNELSxHEIGHTxWIDTH."""
    sides = text.split("x")
    if len(sides) != 4 or not all(side.isdecimal() and int(side) for side in sides):
        raise argparse.ArgumentTypeError(f"must be BATCHxCHANNELSxHEIGHTxWIDTH, got {text!r}")
    return tuple(int(side) for side in sides)
