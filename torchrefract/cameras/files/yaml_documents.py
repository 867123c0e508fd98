"""YAML, as OpenCV, ROS and Kalibr write it."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

try:
    import yaml
except ModuleNotFoundError as missing:
    raise ModuleNotFoundError(
        'cameras in YAML files need PyYAML: pip install "torchrefract[calibration]"', name=missing.name
    ) from missing


class _Loader(yaml.SafeLoader):
    """Plain values only, and OpenCV's matrices as mappings."""


def _matrix(loader: yaml.SafeLoader, node: yaml.MappingNode) -> dict[Any, Any]:
    return loader.construct_mapping(node, deep=True)


_Loader.add_constructor("tag:yaml.org,2002:opencv-matrix", _matrix)


def parse_yaml(path: Path, text: str) -> Mapping[str, Any]:
    """The mapping that a YAML text holds; `path` is for the errors.

    Raises:
        ValueError: no YAML, or no mapping.
    """
    try:
        document = yaml.load(text, Loader=_Loader)
    except yaml.YAMLError as error:
        raise ValueError(f"path must hold YAML, got {path}: {' '.join(str(error).split())}") from error
    if not isinstance(document, Mapping):
        raise ValueError(f"path must hold a mapping of names to values, got {path} with {type(document).__name__}")
    return document


def dump_yaml(document: Mapping[str, Any]) -> str:
    """A YAML text with lists on one line, in the order given."""
    return yaml.safe_dump(document, sort_keys=False, default_flow_style=None, width=1000)
