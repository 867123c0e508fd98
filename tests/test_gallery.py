"""The gallery shows what the library draws."""

import importlib.util
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

EXAMPLES = Path(__file__).parents[1] / "examples"
PAGE = (EXAMPLES / "gallery.md").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def gallery() -> Any:
    """Import the script."""
    spec = importlib.util.spec_from_file_location("gallery", EXAMPLES / "gallery.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_gallery_has_each_scene_and_effect_with_the_parameters_that_are_drawn(gallery):
    assert re.findall(r"^### (\w+)$", PAGE, re.MULTILINE) == gallery.choices()
    files = list((EXAMPLES / "gallery").iterdir())
    assert {file.name for file in files} == {f"{choice}.webp" for choice in gallery.choices()}
    assert sum(file.stat().st_size for file in files) < 1.5e6
    assert {*gallery.SETTINGS} <= {*gallery.choices()}
    assert PAGE.startswith(gallery.HEAD)
    for choice in gallery.choices():
        assert f"(gallery/{choice}.webp)\n\n{gallery.drawn_parameters(choice)}" in PAGE


@pytest.mark.parametrize("choice", ["cape_town_fog", "LensDistortion", "Vignetting"])
def test_a_picture_of_the_gallery_is_that_of_today(gallery, choice):
    drawn, maps = gallery.draw(choice)
    assert gallery.section(choice, maps) in PAGE
    stored = np.asarray(Image.open(EXAMPLES / "gallery" / f"{choice}.webp"), float)
    assert np.abs(np.asarray(drawn, float) - stored).mean() < 4  # of WebP
