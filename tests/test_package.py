import ast
import email
import inspect
import re
import runpy
import sys
import tomllib
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import torch

import torchrefract
from torchrefract._io import CONFIG_DIR
from torchrefract._tensor import assume_constant_result
from torchrefract.effects.base import Effect

ROOT = Path(__file__).parents[1]
LEARNING = ("diffusers", "pytorch_lightning", "segmentation_models_pytorch", "timm", "torch._dynamo", "torchvision")
HEAVY = (*LEARNING, "PIL", "albumentations", "av", "cv2", "hydra", "kornia", "lightning", "matplotlib", "omegaconf")
HEAVY += ("rich", "scipy", "yaml")
LISTED = "import {modules}; print([name for name in {names} if name in sys.modules])"
# Run commands with a finder that misses the libraries of a list, and print the exit code of each.
WITHOUT = """
import importlib
class Missing:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {missing}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)
sys.meta_path.insert(0, Missing())
for command, *words in {calls}:
    sys.argv = ["torchrefract", *words]
    try:
        importlib.import_module(f"torchrefract.{{command}}").main()
    except SystemExit as stop:
        print("exit", stop.code)
"""
# Import the package once, which takes seconds, and run each script in a process of its own that is forked from there.
FORKED = """
import os, sys, torchrefract
for name, script in {scripts}.items():
    child = os.fork()
    if child == 0:
        for stream, kind in ((1, "out"), (2, "err")):
            os.dup2(os.open(f"{{name}}.{{kind}}", os.O_WRONLY | os.O_CREAT), stream)
        exec(script)
        sys.exit(0)
    os.waitpid(child, 0)
"""
MODULES = {  # by distribution, if the name differs
    "hydra-core": "hydra",
    "opencv-contrib-python-headless": "cv2",
    "pillow": "PIL",
    "pytorch-lightning": "pytorch_lightning",
    "pyyaml": "yaml",
    "segmentation-models-pytorch": "segmentation_models_pytorch",
}
COMMANDS = {"train": "train", "calibrate": "calibration"}  # and their extras


def extra_modules(extra: str) -> set[str]:
    """Return the modules of an extra in pyproject.toml."""
    required = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"][extra]
    names = (re.split(r"[<>=~ \[;]", line)[0] for line in required)
    return {MODULES.get(name, name) for name in names}


@pytest.fixture(scope="module")
def printed(tmp_path_factory, spawn) -> Callable[[str], tuple[str, str]]:
    """Return a function that gives what a script has printed and its errors, in a process that had only the package."""
    train, calibration = extra_modules("train"), extra_modules("calibration")
    folder, parts = tmp_path_factory.mktemp("forked"), ("calibration", "degradation", "preview")
    scripts = {
        "package": LISTED.format(modules="torchrefract", names=HEAVY),
        # Workers that generate pairs import the module of their command.
        "commands": LISTED.format(
            modules="torchrefract.generate, torchrefract.cli.generation", names=(*LEARNING, "matplotlib")
        )
        + "\n"
        + LISTED.format(modules=", ".join(f"torchrefract.cli.{name}" for name in parts), names=LEARNING),
        "train": WITHOUT.format(
            missing=sorted(train | calibration),
            calls=[(name, *words) for name in COMMANDS for words in ([], ["--help"])],
        ),
        "calibration": WITHOUT.format(
            missing=sorted(train - calibration),
            calls=[("make_board", "out=board.pdf"), ("calibrate", "images=none", "out=a")],
        ),
        "labels": "import torch; from torchrefract.labels.targets import warp_labels\n"
        "print(warp_labels({'id': 3}, torch.zeros(2, 4, 5)), 'torchvision' in sys.modules)",
    }
    outcome = spawn("-W", "error", "-c", FORKED.format(scripts=scripts), cwd=folder)
    assert (outcome.code, outcome.err) == (0, "")
    return lambda name: ((folder / f"{name}.out").read_text(), (folder / f"{name}.err").read_text())


def test_the_package_imports_torch_and_numpy_only(printed):
    assert printed("package") == ("[]\n", "")


def test_the_package_imports_its_presets_and_depth_networks(spawn, tmp_path):
    names = "torchrefract.presets.cape_town_fog.__name__, torchrefract.depth.from_transformers.__name__"
    outcome = spawn("-c", f"import torchrefract; print({names})", cwd=tmp_path)
    assert (outcome.code, outcome.out) == (0, "cape_town_fog from_transformers\n")


def test_plain_targets_do_not_import_torchvision(printed):
    assert printed("labels") == ("{'id': 3} False\n", "")


def test_commands_without_a_model_import_neither_the_training_stack_nor_workers_matplotlib(printed):
    assert printed("commands")[0] == "[]\n[]\n"


def test_a_command_without_its_libraries_names_the_extra_to_install_and_shows_its_help(printed):
    out, err = printed("train")
    assert err.splitlines() == [
        f"error: {command} needs hydra, which is not installed: pip install 'torchrefract[{extra}]'"
        for command, extra in COMMANDS.items()
    ]
    pages = out.split("exit 1\n")[1:]
    assert all(f"python -m torchrefract.{name} " in page for name, page in zip(COMMANDS, pages, strict=True))


def test_the_calibration_extra_suffices_for_calibration(printed):
    out, err = printed("calibration")
    assert "board.pdf" in out
    assert err.startswith("error: images must be an existing folder of pictures, got none")


def test_restoring_without_diffusers_names_the_extra(call, monkeypatch):
    for name in ("diffusers", "diffusers.optimization"):
        monkeypatch.setitem(sys.modules, name, None)
    for name in ("torchrefract.cli.restoration", "torchrefract.restoration.module"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    message = "restore needs diffusers, which is not installed: pip install 'torchrefract[train]'"
    assert call("restore", "ckpt_path=best.ckpt", "input=.", "out=out").message == message


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
    assert len(commands) == 14
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
def test_every_module_has_a_docstring():
    texts = {path: path.read_text() for path in (ROOT / "torchrefract").rglob("*.py")}
    assert len(texts) > 100
    assert [path for path, text in texts.items() if text and not ast.get_docstring(ast.parse(text))] == []


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


def test_a_wheel_contains_all_modules_data_files_and_nothing_else(wheel):
    names = {name for name in wheel.namelist() if ".dist-info/" not in name and "/conf/" not in name}
    package = ROOT / "torchrefract"
    expected = {path.relative_to(ROOT).as_posix() for path in package.rglob("*.py")}
    weights = "torchrefract/restoration/weights/lens_small"
    data = {"torchrefract/cameras/lenses.csv", f"{weights}.safetensors", f"{weights}.md"}
    assert names == {*expected, "torchrefract/py.typed", *data}
    for name in data:
        assert wheel.read(name) == (ROOT / name).read_bytes()


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
