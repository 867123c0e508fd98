"""Re-export functions of `projection` under their former module name, for modules that have not moved yet."""

from torchrefract.cameras.projection import columns, image_of, on_plane, radius_within, ray_of

__all__ = ["columns", "image_of", "on_plane", "radius_within", "ray_of"]
