import ast
import email
import inspect
import re
import runpy
import tomllib
import zipfile
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

import torchrefract
from torchrefract._io import CONFIG_DIR
from torchrefract._tensor import assume_constant_result
from torchrefract.effects.base import Effect

ROOT = Path(__file__).parents[1]
HEAVY = (
    "PIL",
    "albumentations",
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
IMPORT = "import sys, {module}; print([name for name in {names} if name in sys.modules])"


def test_the_package_imports_torch_and_numpy_only(spawn, tmp_path):
    outcome = spawn("-W", "error", "-c", IMPORT.format(module="torchrefract", names=HEAVY), cwd=tmp_path)
    assert (outcome.out.strip(), outcome.err) == ("[]", "")


def test_commands_without_a_model_import_neither_the_training_stack_nor_workers_matplotlib(spawn, tmp_path):
    # Workers that generate pairs import the module of their command.
    workers = IMPORT.format(
        module="torchrefract.generate, torchrefract.cli.generation", names=(*LEARNING, "matplotlib")
    )
    modules = ", ".join(f"torchrefract.cli.{name}" for name in ("calibration", "degradation", "generation", "preview"))
    outcome = spawn("-c", f"{workers}; {IMPORT.format(module=modules, names=LEARNING)}", cwd=tmp_path)
    assert (outcome.code, outcome.out.split()) == (0, ["[]", "[]"]), outcome.err


# Import a command with a finder that misses all libraries but those in a list, and run it.
ONLY = """
import importlib, sys
class Missing:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {missing}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)
sys.meta_path.insert(0, Missing())
sys.argv = ["torchrefract", *{words}]
importlib.import_module("torchrefract.{command}").main()
"""
MODULES = {  # by distribution, if the name differs
    "hydra-core": "hydra",
    "opencv-contrib-python-headless": "cv2",
    "pillow": "PIL",
    "pytorch-lightning": "pytorch_lightning",
    "pyyaml": "yaml",
    "segmentation-models-pytorch": "segmentation_models_pytorch",
}


def extra_modules(extra: str) -> set[str]:
    """Return the modules of an extra in pyproject.toml."""
    required = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"][extra]
    names = (re.split(r"[<>=~ \[;]", line)[0] for line in required)
    return {MODULES.get(name, name) for name in names}


@pytest.mark.parametrize("command", ["train", "calibrate"])
def test_a_command_without_its_libraries_names_the_extra_to_install_and_shows_its_help(spawn, tmp_path, command):
    missing = sorted(extra_modules("train") | extra_modules("calibration"))
    extra = "calibration" if command == "calibrate" else "train"
    outcome = spawn("-c", ONLY.format(missing=missing, words=[], command=command), cwd=tmp_path)
    assert (outcome.code, outcome.out) == (1, "")
    assert outcome.message == f"{command} needs hydra, which is not installed: pip install 'torchrefract[{extra}]'"
    outcome = spawn("-c", ONLY.format(missing=missing, words=["--help"], command=command), cwd=tmp_path)
    assert (outcome.code, outcome.err) == (0, "")
    assert f"python -m torchrefract.{command} " in outcome.out


def test_the_calibration_extra_suffices_for_calibration(spawn, tmp_path):
    missing = sorted(extra_modules("train") - extra_modules("calibration"))
    words = ["images=none", "out=a"]
    outcome = spawn("-c", ONLY.format(missing=missing, words=words, command="calibrate"), cwd=tmp_path)
    assert outcome.message.startswith("images must be an existing folder of pictures, got none")
    words = ["out=board.pdf"]
    assert spawn("-c", ONLY.format(missing=missing, words=words, command="make_board"), cwd=tmp_path).code == 0


def test_restoring_without_diffusers_names_the_extra(spawn, shifted, tmp_path):
    words = [f"ckpt_path={shifted}", "input=.", "out=out"]
    outcome = spawn("-c", ONLY.format(missing=["diffusers"], words=words, command="restore"), cwd=tmp_path)
    assert outcome.message == "restore needs diffusers, which is not installed: pip install 'torchrefract[train]'"


def test_a_command_speaks_before_it_imports_torch(spawn, tmp_path):
    # An import of torch would raise.
    (tmp_path / "torch.py").write_text("raise ImportError('reached torch')")
    outcome = spawn(
        "-c", f"import sys; sys.argv = ['-m']; sys.path.insert(0, {str(tmp_path)!r}); import torchrefract", cwd=tmp_path
    )
    assert outcome.err.splitlines()[0] == "torchrefract: loading …"
    assert outcome.err.splitlines()[-1] == "ImportError: reached torch"


@pytest.mark.quick
def test_the_help_of_the_package_names_all_effects_presets_and_commands():
    text = torchrefract.__doc__ or ""
    effects = [name for name in torchrefract.__all__ if issubclass(kind(getattr(torchrefract, name)), Effect)]
    scenes = [path.stem for path in (ROOT / "conf" / "scene").glob("*.yaml")]
    commands = [path.stem for path in (ROOT / "torchrefract").glob("*.py") if "import command" in path.read_text()]
    assert len(commands) == 13
    assert [name for name in effects + scenes + commands if name not in re.findall(r"\w+", text)] == []


def kind(value: object) -> type:
    """Return a class itself, and the class of anything else."""
    return value if isinstance(value, type) else type(value)


@pytest.mark.quick
def test_the_version_is_that_of_the_changelog_and_the_citation():
    assert f"\n## {torchrefract.__version__} " in (ROOT / "CHANGELOG.md").read_text()
    assert f"\nversion: {torchrefract.__version__}\n" in (ROOT / "CITATION.cff").read_text()


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
    assert metadata["Version"] == torchrefract.__version__
