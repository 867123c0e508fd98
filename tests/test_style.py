"""Names and docstrings follow the rules of the project."""

import ast
import io
import keyword
import re
import tokenize
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
# Pronouns, participles and metaphors say nothing about a value.
NOT_NAMES = {
    *("own", "found", "known", "here", "there", "beside", "behind", "some", "most", "told", "asked", "room", "whole"),
    *("Undrawn", "widened", "Walk", "stirs", "gated", "fitted", "covers", "swirls", "plates", "drifts", "veil"),
    *("draw_sparingly", "at_rest", "look_up", "looked_up", "obstacle"),
}
OPENINGS = re.compile(r"(What|Whether|How|Where|Of|Those|The same|As)\b")


def files_in(*folders: str) -> list[Path]:
    """Return the Python files of folders of the repository."""
    return sorted(path for folder in folders for path in (ROOT / folder).rglob("*.py"))


def names_in(path: Path) -> Iterator[tuple[str, int]]:
    """Yield the identifiers of a file with their lines."""
    for token in tokenize.generate_tokens(io.StringIO(path.read_text(encoding="utf-8")).readline):
        if token.type == tokenize.NAME and not keyword.iskeyword(token.string):
            yield token.string, token.start[0]


def docstrings_in(path: Path) -> Iterator[tuple[str, int]]:
    """Yield the docstrings of a file with the lines of what they document."""
    kinds = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, kinds) and (text := ast.get_docstring(node)):
            yield text, getattr(node, "lineno", 1)


@pytest.mark.quick
def test_names_say_what_values_are():
    wrong = [
        f"{path.relative_to(ROOT)}:{line}: {name}"
        for path in files_in("torchrefract", "benchmarks")
        for name, line in names_in(path)
        if name.strip("_") in NOT_NAMES
    ]
    assert not wrong, "\n".join(wrong)


@pytest.mark.quick
def test_docstrings_open_with_a_verb_or_a_noun():
    wrong = [
        f"{path.relative_to(ROOT)}:{line}: {text.splitlines()[0]}"
        for path in files_in("torchrefract", "benchmarks", "examples", "tests/extremes")
        + list(ROOT.rglob("conftest.py"))
        for text, line in docstrings_in(path)
        if OPENINGS.match(text)
    ]
    assert not wrong, "\n".join(wrong)
