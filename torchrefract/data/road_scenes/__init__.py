"""Rendered road scenes with their true depth."""

from torchrefract.data.road_scenes.render import RoadScenes, render_road_scenes

__all__ = ["RoadScenes", "render_road_scenes"]
