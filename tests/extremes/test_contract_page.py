"""CONTRACT.md and the tests name each other."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


def ids_in(path: Path) -> set[str]:
    """Return the ids of all test functions of a file."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    names = {node.name for node in tree.body if isinstance(node, ast.FunctionDef) and node.name.startswith("test_")}
    return {f"{path.relative_to(ROOT).as_posix()}::{name}" for name in names}


@pytest.mark.quick
def test_every_row_names_a_test_and_every_test_of_this_folder_has_a_row():
    rows = re.findall(r"^\|.*\| `(tests/[^`]+)` \|$", (ROOT / "CONTRACT.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert len(rows) > 80
    existing = {test for path in {row.partition("::")[0] for row in rows} for test in ids_in(ROOT / path)}
    assert set(rows) <= existing
    extremes = {test for path in Path(__file__).parent.glob("test_*.py") for test in ids_in(path)}
    assert extremes - set(rows) <= ids_in(Path(__file__)) | {
        "tests/extremes/test_properties.py::test_every_public_effect_has_a_domain"
    }
