import json
import math
import sys
from pathlib import Path

import onnx
import onnxruntime
import pytest
import torch

from torchrefract import warp
from torchrefract.restoration import export as programs
from torchrefract.restoration import loading

SIZE = (40, 72)  # of frames, of other sides than those that the model sees
SEEN = (32, 64)  # those that it sees, which frames have if nothing is said


def images(batch: int, size: tuple[int, int] = SIZE) -> torch.Tensor:
    return torch.rand(batch, 3, *size, generator=torch.Generator().manual_seed(batch))


@pytest.fixture(scope="module")
def shifted(known_model):
    """A model that looks 1/16 of the width to the right and 1/32 of the height up."""
    return known_model("undistort", (math.atanh(1 / 4), math.atanh(-1 / 8)))


@pytest.fixture(scope="module")
def brighter(known_model):
    return known_model("deweather", (0.2, 0.0, -0.1))


def expected(task: str, image: torch.Tensor) -> list[torch.Tensor]:
    """What the models above make of images, written the long way."""
    if task == "deweather":
        return [(image + torch.tensor([0.2, 0.0, -0.1]).view(3, 1, 1)).clamp(0, 1)]
    batch, _, height, width = image.shape
    flow = torch.tensor([width / 16, -height / 32]).view(1, 2, 1, 1).expand(batch, 2, height, width)
    return [warp(image, flow, padding="border", interpolation="bicubic")[0], flow]


@pytest.mark.parametrize(
    ("suffix", "task", "size"),
    [
        (".onnx", "undistort", SIZE),
        (".onnx", "deweather", SIZE),
        (".pt2", "undistort", SIZE),
        (".pt2", "deweather", None),
    ],
)
def test_a_program_computes_what_the_model_does(
    call, tmp_path, shifted, brighter, suffix, task, size, oracle, monkeypatch
):
    path = {"undistort": shifted, "deweather": brighter}[task]
    height, width = size or SEEN
    words = [f"size={height}x{width}"] if size else []
    outcome = call("export", f"ckpt_path={path}", f"out=out/model{suffix}", *words)
    (line,) = outcome.out.splitlines()
    assert line.startswith(
        f"out/model{suffix}: ResUNet (tu-mobilenetv3_small_050) for {task}, frames of {height}x{width}, any batch"
    )
    assert [file.name for file in (tmp_path / "out").iterdir()] == [f"model{suffix}"]
    for batch in (1, 3):
        image = images(batch, (height, width))
        found, truths = programs.outputs_of(tmp_path / "out" / f"model{suffix}", image), expected(task, image)
        for name, value, truth in zip(("image", "flow")[: len(truths)], found, truths, strict=True):
            oracle(f"exported {suffix}, {task}, {name}", value, truth, 1e-4, unit="px" if name == "flow" else "")
    if suffix == ".onnx":  # a file needs no torch, and no runtime either
        says_what_it_is(tmp_path / "out" / "model.onnx", task)
        monkeypatch.setitem(sys.modules, "onnxruntime", None)
        found = programs.outputs_of(tmp_path / "out" / "model.onnx", images(1))
        for value, truth in zip(found, expected(task, images(1)), strict=True):
            oracle(f"exported .onnx by ONNX's reference, {task}", value, truth, 1e-4, unit="")
    else:
        files = {programs.ABOUT: ""}
        torch.export.load(tmp_path / "out" / "model.pt2", extra_files=files)
        told = json.loads(files[programs.ABOUT])
        assert told["input"] == f"image, (B, 3, {height}, {width}), RGB in [0, 1]"
        assert told["outputs"] == (["restored", "flow"] if task == "undistort" else ["restored"])


def says_what_it_is(path: Path, task: str) -> None:
    outputs = ["restored", "flow"] if task == "undistort" else ["restored"]
    session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    assert [value.name for value in session.get_outputs()] == outputs
    assert session.get_inputs()[0].shape[1:] == [3, *SIZE]
    (about,) = onnx.load(path).metadata_props
    told = json.loads(about.value)
    assert (told["task"], told["licenses"], told["outputs"]) == (task, {"data": "CC0"}, outputs)


def test_a_package_that_is_missing_is_named(call, tmp_path, brighter, monkeypatch):
    monkeypatch.setitem(sys.modules, "onnxscript", None)
    message = call("export", f"ckpt_path={brighter}", "out=model.onnx").message
    told = "got .onnx: pip install onnx onnxscript onnxruntime"
    assert message == f"out must end in .pt2 where onnxscript is not installed, {told}"
    assert not list(tmp_path.iterdir())


def test_a_program_that_computes_something_else_is_not_kept(call, tmp_path, brighter, monkeypatch):
    monkeypatch.setattr("torchrefract.export.outputs_of", lambda _, image: [image + 0.1])
    message = call("export", f"ckpt_path={brighter}", "out=model.pt2").message
    assert message.startswith("out must compute what the model does, got restored off by ")
    assert not list(tmp_path.iterdir())


def test_a_model_of_many_steps_is_refused(call, brighter, monkeypatch):
    class Steps(torch.nn.Module):
        """Stands for a model that draws."""

    whole = loading.load_model(brighter)
    monkeypatch.setattr("torchrefract.export.load_model", lambda _: whole._replace(model=Steps(), name="Steps"))
    message = call("export", f"ckpt_path={brighter}", "out=model.pt2").message
    assert message == f"ckpt_path must be of a model that restores in one step, got {brighter} of Steps"


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("out=model.pth", "out: out must be one of .onnx, .pt2, got '.pth'"),
        ("size=72", "size must be height x width, as 720x1280, got 72"),
        ("size=0x72", "size must be height x width, as 720x1280, got 0x72"),
        ("size=axb", "size must be height x width, as 720x1280, got axb"),
        ("interpolation=cubic", "interpolation: interpolation must be one of nearest, bilinear, bicubic"),
        ("ckpt_path=none.ckpt", "ckpt_path must be a checkpoint file, such as <run>/last.ckpt, got none.ckpt"),
    ],
)
def test_a_wrong_word_is_one_line_of_error(call, tmp_path, brighter, word, message):
    assert call("export", f"ckpt_path={brighter}", word).message.startswith(message)
    assert not list(tmp_path.iterdir())
