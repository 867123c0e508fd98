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


_SHOWN = 400  # letters of an error
# What PyYAML makes of a scalar that is not what its tag or its look says, of keys that are lists, and of deep nesting.
_BROKEN = (yaml.YAMLError, ValueError, TypeError, ArithmeticError, LookupError, AttributeError, RecursionError)


class _Loader(yaml.SafeLoader):
    """Plain values only, and OpenCV's matrices as mappings."""

    def flatten_mapping(self, node: yaml.MappingNode) -> None:
        """Raise for merge keys, which no program writes, and by which a few lines can fill the memory."""
        for key, _ in node.value:
            if key.tag == "tag:yaml.org,2002:merge":
                raise yaml.constructor.ConstructorError(None, None, "found a merge key", key.start_mark)
        super().flatten_mapping(node)


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
    except _BROKEN as error:
        raise ValueError(f"path must hold YAML, got {path}: {' '.join(str(error).split())[:_SHOWN]}") from error
    if not isinstance(document, Mapping):
        raise ValueError(f"path must hold a mapping of names to values, got {path} with {type(document).__name__}")
    return document


def dump_yaml(document: Mapping[str, Any]) -> str:
    """A YAML text with lists on one line, in the order given."""
    return yaml.safe_dump(document, sort_keys=False, default_flow_style=None, width=1000)
