import json
import sys
from collections.abc import Callable
from typing import Any

import pytest


@pytest.fixture
def write_module(tmp_path, monkeypatch) -> Callable[[str, str], None]:
    """Return a function that writes a module of models, which the test alone can import."""
    monkeypatch.syspath_prepend(tmp_path)

    def write(name: str, text: str) -> None:
        (tmp_path / f"{name}.py").write_text(text)
        monkeypatch.delitem(sys.modules, name, raising=False)

    return write


@pytest.fixture
def score(call) -> Callable[..., Any]:
    """Return a function that scores a model on the folder `frames`."""
    return lambda *words, out="out": call("robustness.__main__", "data=frames", f"out={out}", *words)


@pytest.fixture
def results(tmp_path) -> Callable[..., Any]:
    """Return a function that reads the results of a run."""
    return lambda out="out": json.loads((tmp_path / out / "results.json").read_text())
