"""Colors of light, one number for each channel."""

from collections.abc import Sequence

from torchrefract._checks import check_number


def check_color(name: str, color: float | Sequence[float], *, high: float) -> tuple[float, ...]:
    """A color of one number or several, each in [0, high]."""
    values = color if isinstance(color, Sequence) else [color]
    if not values:
        raise ValueError(f"{name} must have at least one number, got none")
    return tuple(check_number(name, value, low=0.0, high=high) for value in values)


def each_channel(name: str, color: Sequence[float], channels: int) -> Sequence[float]:
    """The color with a number for each channel."""
    if len(color) not in (1, channels):
        raise ValueError(f"{name} must have 1 number or {channels}, one for each channel, got {tuple(color)}")
    return color if len(color) == channels else [color[0]] * channels
