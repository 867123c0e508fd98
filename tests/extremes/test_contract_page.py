"""The page of the contract, and that its tests are there."""

import ast
from pathlib import Path

from contract import LETTERS, PAGE, ROWS, page

ROOT = PAGE.parent


def test_the_page_is_that_of_the_table():
    assert PAGE.read_text(encoding="utf-8") == page(), "python tests/extremes/contract.py makes the page anew"


def test_every_row_names_a_test_that_is_run(spawn):
    named = {row.test for row in ROWS}
    files = sorted({test.partition("::")[0] for test in named})
    done = spawn("-m", "pytest", "--collect-only", "-p", "no:cacheprovider", *files, cwd=ROOT)
    assert done.code == 0, done.out + done.err
    collected = {line.partition("[")[0] for line in done.out.splitlines()}
    assert named <= collected, named - collected


def test_every_test_of_the_contract_is_in_a_row():
    named = {row.test for row in ROWS}
    for name in ("test_rows.py", "test_properties.py", "test_truth.py"):
        tree = ast.parse((Path(__file__).parent / name).read_text(encoding="utf-8"))
        here = {node.name for node in tree.body if isinstance(node, ast.FunctionDef) and node.name[:5] == "test_"}
        unnamed = {test for test in here if f"tests/extremes/{name}::{test}" not in named}
        assert unnamed <= {"test_every_public_effect_has_a_domain"}, name


def test_letters_are_told_and_cases_have_names_of_their_own():
    assert {letter for row in ROWS for letter in row.letters} == set(LETTERS)
    cases = [(row.test, row.effect, name) for row in ROWS for name in row.cases]
    assert len(cases) == len(set(cases))
