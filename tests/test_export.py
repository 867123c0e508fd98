import json
import sys
import zipfile
from pathlib import Path
from typing import Any

import onnx
import onnxruntime
import pytest
import torch
from torch import Tensor

from torchrefract import warp
from torchrefract._validation import UsageError
from torchrefract.data.pairs.manifest import locked
from torchrefract.restoration import export
from torchrefract.restoration.checkpoints import load_model
from torchrefract.restoration.models.lens_net import LensEncoder

SIZE = (40, 72)  # of the frames
MODEL_SIZE = (32, 64)  # of the training, and of the frames if no size is given


def images(batch: int, size: tuple[int, int]) -> Tensor:
    return torch.rand(batch, 3, *size, generator=torch.Generator().manual_seed(batch))


def expected(task: str, image: Tensor) -> list[Tensor]:
    """Compute the outputs of the models in closed form."""
    if task == "deweather":
        return [(image + torch.tensor([0.2, 0.0, -0.1]).view(3, 1, 1)).clamp(0, 1)]
    batch, _, height, width = image.shape
    flow = torch.tensor([width / 16, -height / 32]).view(1, 2, 1, 1).expand(batch, 2, height, width)
    return [warp(image, flow, padding="border", interpolation="bicubic")[0], flow]


def assert_agrees(oracle, path: Path, task: str, size: tuple[int, int]) -> None:
    program = export.load_program(path)
    for image in (images(batch, size) for batch in (1, 3)):
        for name, output, value in zip(("image", "flow"), program(image), expected(task, image), strict=False):
            oracle(f"exported {path.suffix}, {task}, {name}", output, value, 1e-4, unit="px" if name == "flow" else "")


def test_a_pt2_program_computes_the_model_for_any_batch_size(call, tmp_path, shifted, oracle):
    out, (height, width) = tmp_path / "out" / "model.pt2", SIZE
    (line,) = call("export", f"ckpt_path={shifted}", "out=out/model.pt2", f"size={height}x{width}").out.splitlines()
    model = "ResUNet (tu-test_resnet) for undistort"
    assert line.startswith(f"out/model.pt2: {model}, frames of {height}x{width}, any batch size; largest difference ")
    assert [file.name for file in out.parent.iterdir()] == ["model.pt2"]
    assert_agrees(oracle, out, "undistort", SIZE)
    with zipfile.ZipFile(out) as archive:
        (about,) = (name for name in archive.namelist() if name.endswith(export.METADATA))
        metadata = json.loads(archive.read(about))
    assert metadata["input"] == f"image, (B, 3, {height}, {width}), RGB in [0, 1]"
    assert metadata["outputs"] == ["restored", "flow"]


def test_an_onnx_program_computes_the_model_for_frames_of_the_training_and_any_batch_size(
    call, tmp_path, brighter, oracle
):
    out = tmp_path / "out" / "model.onnx"
    assert call("export", f"ckpt_path={brighter}", "out=out/model.onnx").code == 0
    assert_agrees(oracle, out, "deweather", MODEL_SIZE)
    session = onnxruntime.InferenceSession(out, providers=["CPUExecutionProvider"])
    assert [value.name for value in session.get_outputs()] == ["restored"]
    assert session.get_inputs()[0].shape == session.get_outputs()[0].shape == ["batch", 3, *MODEL_SIZE]
    (about,) = onnx.load(out).metadata_props
    metadata = json.loads(about.value)
    assert (metadata["task"], metadata["licenses"], metadata["outputs"]) == ("deweather", {"data": "CC0"}, ["restored"])


def test_an_onnx_program_computes_the_features_of_lens_net(tmp_path, oracle):
    network, names = LensEncoder(weightings=1, lenses=2, edges=64).eval(), ["features", "cells"]
    path, program = tmp_path / "model.onnx", export.trace(network, images(2, SIZE))
    export.save_program(program, path, outputs=names, metadata={})
    for name, output, value in zip(
        names, export.load_program(path)(images(1, SIZE)), network(images(1, SIZE)), strict=True
    ):
        oracle(f"exported .onnx, lens_net, {name}", output, value.detach(), 1e-4)


@pytest.mark.parametrize("package", ["onnxscript", "onnxruntime"])
def test_a_missing_package_is_named(call, tmp_path, brighter, monkeypatch, package):
    monkeypatch.setitem(sys.modules, package, None)
    message = call("export", f"ckpt_path={brighter}", "out=model.onnx").message
    remedy = "got .onnx: pip install onnx onnxscript onnxruntime"
    assert message == f"out must end in .pt2 if {package} is not installed, {remedy}"
    assert not list(tmp_path.iterdir())


def test_a_program_that_disagrees_with_the_model_is_deleted(call, tmp_path, brighter, monkeypatch):
    monkeypatch.setattr(export, "trace", lambda *_: None)
    monkeypatch.setattr(export, "save_program", lambda program, path, **_: path.write_text("a program"))
    monkeypatch.setattr(export, "load_program", lambda _: lambda image: [image + 0.1])
    message = call("export", f"ckpt_path={brighter}", "out=model.pt2").message
    assert message.startswith("out must agree with the model, got restored off by ")
    assert not list(tmp_path.iterdir())


def test_what_a_killed_export_left_is_replaced_by_the_next_one(call, tmp_path, brighter, monkeypatch):
    left = list[Path]()

    def save(program: Any, path: Path, **_: Any) -> None:
        path.write_text("a program")
        left.append(path)
        with pytest.raises(UsageError, match="out must not be in use"), locked("out", tmp_path, "model.pt2"):
            pytest.fail("a second process may write the file")

    monkeypatch.setattr(export, "trace", lambda *_: None)
    monkeypatch.setattr(export, "save_program", save)
    monkeypatch.setattr(export, "_compare", lambda *_: {})
    for _ in range(2):
        assert call("export", f"ckpt_path={brighter}", "out=model.pt2").code == 0
    assert left[0] == left[1] != tmp_path / "model.pt2"
    assert [path.name for path in tmp_path.iterdir()] == ["model.pt2"]


def test_a_model_with_several_passes_is_rejected(call, brighter, monkeypatch):
    diffusion = load_model(brighter)._replace(model=torch.nn.Identity(), name="Diffusion")  # pyright: ignore[reportArgumentType]  # only its type counts
    monkeypatch.setattr("torchrefract.cli.restoration.load_model", lambda _: diffusion)
    message = call("export", f"ckpt_path={brighter}", "out=model.pt2").message
    assert message == f"ckpt_path must be of a model that restores in a single pass, got {brighter} of Diffusion"


def test_a_full_disk_is_one_line_of_error(call, tmp_path, brighter, file_limit):
    with file_limit(1000):
        outcome = call("export", f"ckpt_path={brighter}", "out=model.pt2")
    assert outcome.message == "out must name what can be read or written, got model.pt2: File too large"
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("out=model.pth", "out must be one of .onnx, .pt2, .safetensors, got '.pth'"),
        ("size=72", "size must be HEIGHTxWIDTH, such as 720x1280, got 72"),
        ("size=0x72", "size must be HEIGHTxWIDTH, such as 720x1280, got 0x72"),
        ("interpolation=cubic", "interpolation must be one of nearest, bilinear, bicubic"),
        (
            "ckpt_path=none.ckpt",
            "ckpt_path must be a checkpoint file, such as <run>/last.ckpt, or the name lens_small, got none.ckpt",
        ),
    ],
)
def test_an_invalid_option_is_one_line_of_error(call, tmp_path, brighter, word, message):
    assert call("export", f"ckpt_path={brighter}", word).message.startswith(message)
    assert not list(tmp_path.iterdir())
