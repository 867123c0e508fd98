import sys
from collections.abc import Callable
from types import ModuleType

import pytest
import timing


@pytest.fixture
def run_program(monkeypatch, capsys) -> Callable[..., str]:
    """Return a function that runs a program with words, measuring as short as it can, and returns what it prints."""
    monkeypatch.setattr(timing, "_STRETCH_S", 0.0)

    def run(program: ModuleType, *words: object) -> str:
        monkeypatch.setattr(sys, "argv", [f"{program.__name__}.py", *map(str, words)])
        program.main()
        return capsys.readouterr().out

    return run
