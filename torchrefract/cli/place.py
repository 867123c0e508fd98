"""The options `camera=` and `horizon=` of commands, which say how the frames were taken."""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from torchrefract._validation import UsageError, check_number
from torchrefract.cameras.camera import Camera
from torchrefract.cameras.io import read_camera
from torchrefract.cli.command import naming
from torchrefract.data.images import center_crop


def read_place(cfg: DictConfig) -> dict[str, Any]:
    """Return the arguments of scenes that the options `camera=` and `horizon=` give: a `Camera` and a number."""
    place: dict[str, Any] = {}
    if cfg.camera is not None:
        with naming("camera"):
            place["camera"] = read_camera(Path(str(cfg.camera)).expanduser())
    if cfg.horizon is not None:
        with naming("horizon"):
            place["horizon"] = check_number("horizon", cfg.horizon, low=-10, high=10)  # as the effects
    return place


def place_scene(cfg: DictConfig, *, size: Sequence[int] | None = None) -> Camera | None:
    """Write the camera, by its numbers, and the horizon that options give into the configuration of the scene.

    Args:
        cfg: has `scene`, `camera` and `horizon`; the scene changes.
        size: (height, width) to which the command crops and reduces frames, as `fit` does; the camera that the scene
            gets is that of the cropped frames.

    Returns:
        The camera of the frames as they are stored; None if none is given.

    Raises:
        UsageError: there is no scene, or it takes no such argument.
    """
    place = read_place(cfg)
    name = HydraConfig.get().runtime.choices.get("scene")
    for option in place:
        if cfg.scene is None or option not in cfg.scene:
            raise UsageError(
                f"{option} must be given with a scene that takes it, got scene={name}; leave {option} out, or choose "
                "another scene"
            )
    camera: Camera | None = place.get("camera")
    if camera is not None:
        if size is not None:
            top, left, height, width = center_crop((camera.height, camera.width), size)
            place["camera"] = camera.cropped(left=left, top=top, width=width, height=height)
        place["camera"] = {"_target_": "torchrefract.Camera"} | asdict(place["camera"])
    for option, value in place.items():
        cfg.scene[option] = value
    return camera
