"""Re-export `Camera` under its former module name, for modules that have not moved yet."""

from torchrefract.cameras.camera import Camera

__all__ = ["Camera"]
