"""The snippets of the page on adapters run."""

import re
from pathlib import Path

import pytest

PAGE = Path(__file__).parents[2] / "torchrefract/adapters/README.md"
# The example in examples/ runs what is left out: it needs a set of pictures.
SNIPPETS = [code for code in re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.S) if "ultralytics" not in code]


@pytest.mark.parametrize("code", SNIPPETS, ids=lambda code: code.split()[1])
def test_a_snippet_of_the_page_runs(code, tmp_path, monkeypatch):
    for library in re.findall(r"^(?:import|from) (\w+)", code, re.M):
        pytest.importorskip(library, reason=f"{library} is not installed")
    monkeypatch.chdir(tmp_path)
    exec(code, {"__name__": "page"})


def test_the_page_has_a_snippet_for_each_library():
    libraries = {code.split()[1] for code in SNIPPETS}
    assert libraries == {"albumentations", "kornia.augmentation", "pytorch_lightning", "numpy"}
    assert sum("maite.tasks" in code for code in SNIPPETS) == 1
    assert sum("datasets" in code for code in SNIPPETS) == 1
