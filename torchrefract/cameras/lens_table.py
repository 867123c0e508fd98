"""Re-export the lens database under its former module name, for modules that have not moved yet."""

from torchrefract.cameras.lens_database import COLUMNS, read_lenses

__all__ = ["COLUMNS", "read_lenses"]
