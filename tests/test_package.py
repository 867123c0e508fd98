import ast
import email
import inspect
import runpy
import zipfile
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

import torchrefract
from torchrefract._io import CONFIG_DIR
from torchrefract._tensor import assume_constant_result

ROOT = Path(__file__).parents[1]
HEAVY = (
    "PIL",
    "av",
    "cv2",
    "diffusers",
    "hydra",
    "kornia",
    "lightning",
    "matplotlib",
    "omegaconf",
    "pytorch_lightning",
    "rich",
    "scipy",
    "segmentation_models_pytorch",
    "timm",
    "torch._dynamo",
    "torchvision",
    "yaml",
)
LEARNING = ("diffusers", "pytorch_lightning", "segmentation_models_pytorch", "timm", "torch._dynamo", "torchvision")
WITHOUT_MODELS = ("calibrate", "generate", "make_board", "preview", "rectify")
IMPORT = "import sys, {module}; print([name for name in {names} if name in sys.modules])"


def test_the_package_imports_torch_and_numpy_only(spawn, tmp_path):
    outcome = spawn("-W", "error", "-c", IMPORT.format(module="torchrefract", names=HEAVY), cwd=tmp_path)
    assert (outcome.out.strip(), outcome.err) == ("[]", "")


def test_commands_without_a_model_import_neither_the_training_stack_nor_workers_matplotlib(spawn, tmp_path):
    # Workers that generate pairs import the module of their command.
    workers = IMPORT.format(module="torchrefract.generate", names=(*LEARNING, "matplotlib"))
    modules = ", ".join(f"torchrefract.{name}" for name in WITHOUT_MODELS)
    outcome = spawn("-c", f"{workers}; {IMPORT.format(module=modules, names=LEARNING)}", cwd=tmp_path)
    assert (outcome.code, outcome.out.split()) == (0, ["[]", "[]"]), outcome.err


def test_constant_results_are_marked_as_torch_marks_them():
    marked, expected = assume_constant_result(lambda: 1), torch.compiler.assume_constant_result(lambda: 1)
    assert vars(marked) == vars(expected) != {}


def test_all_lists_every_public_name_with_a_docstring():
    public = {name for name, value in vars(torchrefract).items() if name[0] != "_" and not inspect.ismodule(value)}
    assert public == set(torchrefract.__all__)
    assert torchrefract.__all__ == sorted(torchrefract.__all__)
    assert all(getattr(torchrefract, name).__doc__ for name in torchrefract.__all__)


@pytest.mark.quick
@pytest.mark.parametrize("path", sorted((ROOT / "torchrefract").rglob("*.py")), ids=lambda path: path.name)
def test_a_module_has_a_docstring(path):
    text = path.read_text()
    assert not text or ast.get_docstring(ast.parse(text))


@pytest.fixture(scope="module")
def wheel(tmp_path_factory, spawn) -> Iterator[zipfile.ZipFile]:
    folder = tmp_path_factory.mktemp("wheel")
    done = spawn("-m", "hatchling", "build", "-t", "wheel", "-d", str(folder), cwd=ROOT)
    assert done.code == 0, done.err
    (built,) = folder.iterdir()
    with zipfile.ZipFile(built) as archive:
        yield archive


def test_a_wheel_contains_the_configuration(wheel):
    inside, conf = "torchrefract/conf/", ROOT / "conf"
    packed = {name.removeprefix(inside): wheel.read(name) for name in wheel.namelist() if name.startswith(inside)}
    assert packed == {path.relative_to(conf).as_posix(): path.read_bytes() for path in conf.rglob("*.yaml")}


def test_a_wheel_contains_all_modules_the_lens_table_and_nothing_else(wheel):
    names = {name for name in wheel.namelist() if ".dist-info/" not in name and "/conf/" not in name}
    package = ROOT / "torchrefract"
    expected = {path.relative_to(ROOT).as_posix() for path in package.rglob("*.py")}
    table = "torchrefract/cameras/lenses.csv"
    assert names == {*expected, "torchrefract/py.typed", table}
    assert wheel.read(table) == (ROOT / table).read_bytes()


def test_an_installed_wheel_finds_its_configuration(wheel, tmp_path):
    wheel.extractall(tmp_path)
    outcome = runpy.run_path(str(tmp_path / "torchrefract" / "_io.py"))["CONFIG_DIR"]
    assert outcome == str(tmp_path / "torchrefract" / "conf")
    assert Path(CONFIG_DIR) == ROOT / "conf"


def test_the_package_requires_torch_and_numpy_only(wheel):
    (name,) = (name for name in wheel.namelist() if name.endswith(".dist-info/METADATA"))
    metadata = email.message_from_bytes(wheel.read(name))
    required = [line for line in metadata.get_all("Requires-Dist") or [] if "extra ==" not in line]
    assert sorted(line.split(">=")[0] for line in required) == ["numpy", "torch"]
    assert metadata["Requires-Python"] == ">=3.11"
