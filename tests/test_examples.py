import importlib.util
import re
import runpy
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

EXAMPLES = Path(__file__).parents[1] / "examples"
SCRIPTS = sorted(EXAMPLES.glob("[0-9]*.py"))
# That no extra of this package installs for tests.
LIBRARIES = {"07_train_yolo.py": ("albumentations", "ultralytics"), "10_map_a_dataset.py": ("datasets",)}


@pytest.mark.filterwarnings("default")  # of other libraries, which a script shows
@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.name)
def test_an_example_is_short_and_draws_its_picture(script: Path, tmp_path: Path, monkeypatch):
    assert len(script.read_text().splitlines()) <= 60
    for library in LIBRARIES.get(script.name, ()):
        if importlib.util.find_spec(library) is None:
            pytest.skip(f"{library} is not installed")
    picture = tmp_path / "picture.png"
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", [str(script), str(picture)])
    runpy.run_path(str(script), run_name="__main__")
    pixels = np.asarray(Image.open(picture).convert("RGB"))
    assert min(pixels.shape[:2]) >= 200
    assert pixels.std() > 20


@pytest.mark.quick
def test_the_guide_links_every_example_and_only_existing_files():
    links = set(re.findall(r"\]\(([^)]+)\)", (EXAMPLES / "README.md").read_text()))
    assert {script.name for script in SCRIPTS} <= links
    assert all((EXAMPLES / link).is_file() for link in links)


@pytest.mark.quick
def test_the_example_of_datasets_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "datasets", None)
    with pytest.raises(SystemExit, match="this example needs datasets: pip install datasets"):
        runpy.run_path(str(EXAMPLES / "10_map_a_dataset.py"), run_name="__main__")
