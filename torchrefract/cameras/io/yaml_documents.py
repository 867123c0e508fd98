"""YAML as OpenCV, ROS and Kalibr write it; the only module here that needs PyYAML."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

try:
    import yaml
except ModuleNotFoundError as missing:
    raise ModuleNotFoundError(
        'cameras in YAML files need PyYAML: pip install "torchrefract[calibration]"', name=missing.name
    ) from missing


_MAX_MESSAGE = 400  # characters of PyYAML's error to repeat


class _Loader(yaml.SafeLoader):
    """Load plain values only, and OpenCV's matrices as mappings."""

    def flatten_mapping(self, node: yaml.MappingNode) -> None:
        """Raise for merge keys: no camera file has them, and a few lines of them can fill the memory."""
        for key, _ in node.value:
            if key.tag == "tag:yaml.org,2002:merge":
                raise yaml.constructor.ConstructorError(None, None, "found a merge key", key.start_mark)
        super().flatten_mapping(node)


def _matrix(loader: yaml.SafeLoader, node: yaml.MappingNode) -> dict[Any, Any]:
    return loader.construct_mapping(node, deep=True)


_Loader.add_constructor("tag:yaml.org,2002:opencv-matrix", _matrix)


def parse_yaml(path: Path, text: str) -> Mapping[str, Any]:
    """Parse a YAML text that holds a mapping.

    Args:
        path: of the file, for errors.
        text: to parse.

    Raises:
        ValueError: the text is not YAML or not a mapping.
    """
    try:
        document = yaml.load(text, Loader=_Loader)
    except Exception as error:  # malformed scalars and keys raise many types besides YAMLError
        raise ValueError(f"path must hold YAML, got {path}: {' '.join(str(error).split())[:_MAX_MESSAGE]}") from error
    if not isinstance(document, Mapping):
        raise ValueError(f"path must hold a mapping of names to values, got {path} with {type(document).__name__}")
    return document


def dump_yaml(document: Mapping[str, Any]) -> str:
    """Return a mapping as YAML, in its order, with each list on one line."""
    return yaml.safe_dump(document, sort_keys=False, default_flow_style=None, width=1000)
