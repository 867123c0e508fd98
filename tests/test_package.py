import email
import importlib
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


def test_the_layer_needs_no_training_stack(spawn, tmp_path):
    found = spawn("-W", "error", "-c", IMPORT.format(module="torchrefract", names=HEAVY), cwd=tmp_path)
    assert (found.out.strip(), found.err) == ("[]", "")


def test_commands_without_a_model_do_not_wait_for_the_training_stack(spawn, tmp_path):
    modules = ", ".join(
        f"torchrefract.{name}" for name in ("calibrate", "generate", "make_board", "preview", "rectify")
    )
    found = spawn("-c", IMPORT.format(module=modules, names=LEARNING), cwd=tmp_path)
    assert (found.code, found.out.strip()) == (0, "[]"), found.err


def test_workers_that_make_pairs_do_not_wait_for_what_draws(spawn, tmp_path):
    found = spawn("-c", IMPORT.format(module="torchrefract.generate", names=("matplotlib",)), cwd=tmp_path)
    assert (found.code, found.out.strip()) == (0, "[]"), found.err


def test_compilers_see_the_same_in_a_constant_as_in_one_of_torch():
    ours, theirs = assume_constant_result(lambda: 1), torch.compiler.assume_constant_result(lambda: 1)
    assert vars(ours) == vars(theirs) != {}


def test_all_is_what_the_package_imports_by_name():
    public = {name for name, value in vars(torchrefract).items() if name[0] != "_" and not inspect.ismodule(value)}
    assert public == set(torchrefract.__all__)
    assert torchrefract.__all__ == sorted(torchrefract.__all__)
    assert all(getattr(torchrefract, name).__doc__ for name in torchrefract.__all__)


@pytest.mark.parametrize("path", sorted((ROOT / "torchrefract").rglob("*.py")), ids=lambda path: path.name)
def test_a_module_has_at_most_300_lines_and_says_what_it_is_for(path):
    text = path.read_text()
    assert len(text.splitlines()) <= 300
    name = ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
    assert not text or importlib.import_module(name).__doc__


@pytest.fixture(scope="module")
def wheel(tmp_path_factory, spawn) -> Iterator[zipfile.ZipFile]:
    folder = tmp_path_factory.mktemp("wheel")
    done = spawn("-m", "hatchling", "build", "-t", "wheel", "-d", str(folder), cwd=ROOT)
    assert done.code == 0, done.err
    (built,) = folder.iterdir()
    with zipfile.ZipFile(built) as archive:
        yield archive


def test_a_wheel_carries_conf_as_it_lies(wheel):
    inside, conf = "torchrefract/conf/", ROOT / "conf"
    packed = {name.removeprefix(inside): wheel.read(name) for name in wheel.namelist() if name.startswith(inside)}
    assert packed == {path.relative_to(conf).as_posix(): path.read_bytes() for path in conf.rglob("*.yaml")}


def test_a_wheel_holds_every_module_the_table_of_lenses_and_nothing_else(wheel):
    names = {name for name in wheel.namelist() if ".dist-info/" not in name and "/conf/" not in name}
    package = ROOT / "torchrefract"
    expected = {path.relative_to(ROOT).as_posix() for path in package.rglob("*.py")}
    table = "torchrefract/cameras/lenses.csv"
    assert names == {*expected, "torchrefract/py.typed", table}
    assert wheel.read(table) == (ROOT / table).read_bytes()


def test_an_installed_wheel_finds_its_own_conf(wheel, tmp_path):
    wheel.extractall(tmp_path)
    found = runpy.run_path(str(tmp_path / "torchrefract" / "_config.py"))["CONFIG_DIR"]
    assert found == str(tmp_path / "torchrefract" / "conf")
    assert Path(CONFIG_DIR) == ROOT / "conf"


def test_the_layer_depends_on_torch_and_numpy_alone(wheel):
    (name,) = (name for name in wheel.namelist() if name.endswith(".dist-info/METADATA"))
    metadata = email.message_from_bytes(wheel.read(name))
    needed = [line for line in metadata.get_all("Requires-Dist") or [] if "extra ==" not in line]
    assert sorted(line.split(">=")[0] for line in needed) == ["numpy", "torch"]
    assert metadata["Requires-Python"] == ">=3.11"
