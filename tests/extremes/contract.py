"""The stability contract: every extreme, what must happen, and the test that shows it.

The tests of this folder are parametrized by its rows, and CONTRACT.md is made of them:

    python tests/extremes/contract.py
"""

from itertools import groupby
from pathlib import Path

import promises_of_all
import promises_of_light
import promises_of_warps

PAGE = Path(__file__).parents[2] / "CONTRACT.md"
LETTERS = {
    "E": "an error that names the parameter, the rule and the value",
    "I": "the image itself, bit for bit",
    "M": "a finite result, and a mask that says where it holds",
    "C": "a finite result, clamped",
    "W": "one warning",
    "=": "the same as without the extreme, exactly or within the bound that is told",
}
ROWS = (*promises_of_all.ROWS, *promises_of_warps.ROWS, *promises_of_light.ROWS)


def page() -> str:
    """CONTRACT.md."""
    lines = [
        "# The stability contract",
        "",
        "What each extreme does. A test shows every row, and fails when this page and the tests differ;",
        "`python -m pytest tests/extremes` tries a part in minutes, `--extremes=full` many more cases and large",
        "frames. This page is made by `python tests/extremes/contract.py`.",
        "",
        *(f"- **{letter}**: {meaning}" for letter, meaning in LETTERS.items()),
    ]
    for effect, rows in groupby(ROWS, key=lambda row: row.effect):
        lines += ["", f"## {effect.capitalize()}", "", "| extreme | | promise | test |", "|---|---|---|---|"]
        lines += [f"| {row.extreme} | {row.letters} | {row.promise} | `{row.test}` |" for row in rows]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
