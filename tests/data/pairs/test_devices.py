"""Pairs on a GPU: the choice of the device, where frames go, sets of one device, and GPUs of Ray's actors."""

import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch

from torchrefract._validation import UsageError
from torchrefract.cli.generation import choose_device
from torchrefract.data.pairs.generator import PairGenerator, PairTask, SourceReader
from torchrefract.data.pairs.ray_engine import map_in_actors
from torchrefract.data.pairs.sources import find_sources

LOCAL = {"name": "local"}


@pytest.mark.quick
@pytest.mark.parametrize(
    ("name", "engine", "device"),
    [
        ("cpu", LOCAL, "cpu"),
        ("cuda", LOCAL, "cuda"),
        ("cpu", {"name": "ray", "num_gpus": 0}, "cpu"),
        ("cpu", {"name": "ray", "num_gpus": 0.25}, "cuda"),
        ("cuda", {"name": "ray", "num_gpus": 1}, "cuda"),
    ],
)
def test_pairs_are_computed_on_the_device_or_on_the_gpus_of_actors(name, engine, device, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    assert choose_device(name, engine) == device


@pytest.mark.quick
@pytest.mark.parametrize(
    ("name", "num_gpus", "message"),
    [
        ("cuda", 0, "engine.num_gpus must be above 0 for device=cuda, because Ray hides GPUs from other actors, got 0"),
        ("cpu", -1, "engine.num_gpus must be a number of at least 0, got -1"),
        ("cpu", "one", "engine.num_gpus must be a real number, got 'one'"),
        ("mps", 0, "device must be one of cpu, cuda, got 'mps'"),
    ],
)
def test_a_device_that_actors_do_not_have_raises(name, num_gpus, message):
    with pytest.raises((ValueError, TypeError)) as error:
        choose_device(name, {"name": "ray", "num_gpus": num_gpus})
    assert str(error.value) == message


def test_a_gpu_that_torch_does_not_see_is_one_line(call, words, tmp_path, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    message = call("generate", *words("out"), "device=cuda").message
    assert (
        message == "device must be cpu where PyTorch sees no GPU, got cuda; use a node with one and PyTorch with CUDA"
    )
    assert not (tmp_path / "out" / "config.json").exists()


def test_frames_and_depth_go_to_the_device(frames, monkeypatch):
    seen = []

    class Effect:
        def degrade(self, image: torch.Tensor, **options: Any) -> None:
            seen.extend((image.device.type, options["depth"].device.type))
            raise ValueError("enough")

    class Depth:
        def read(self, *_: Any, **__: Any) -> torch.Tensor:
            return torch.ones(1, 32, 48)

    monkeypatch.setattr("torchrefract.data.pairs.generator.device_of", lambda _: torch.device("meta"))
    sources = find_sources(frames, size=None, every=1, drive_by="auto", val_share=0.2, seed=0)
    reader: Any = SourceReader(frames, None)
    reader.depth = Depth()
    effect: Any = Effect()
    with pytest.raises(UsageError, match="enough"):
        PairGenerator(effect, "none", reader, 0, "png", "cuda").generate(PairTask(0, sources.frame(0), 0))
    assert seen == ["meta", "meta"]


def test_a_set_of_another_device_raises_and_one_without_a_device_is_of_the_cpu(call, words, tmp_path):
    path = tmp_path / "out" / "config.json"
    assert call("generate", *words("out", "count=12")).code == 0
    assert "Pairs were computed on the device cpu." in (tmp_path / "out" / "README.md").read_text()
    document = json.loads(path.read_text())
    assert document["settings"].pop("device") == "cpu"
    path.write_text(json.dumps(document))
    assert call("generate", *words("out", "count=12")).code == 0
    path.write_text(path.read_text().replace('"device": "cpu"', '"device": "cuda"'))
    assert "where device is cuda there and cpu here; choose" in call("generate", *words("out", "count=12")).message


@pytest.fixture
def ray() -> Iterator[Any]:
    """Return Ray with two cores and a GPU that it believes in."""
    ray = pytest.importorskip("ray", reason="ray is in the extra ray")
    ray.init(num_cpus=2, num_gpus=1, include_dashboard=False, log_to_driver=False, logging_level="ERROR")
    yield ray
    ray.shutdown()


def visible_gpus(_: int) -> tuple[str | None, str]:
    """Return the GPUs that an actor sees, and the error of one without PyTorch's GPU."""
    from torchrefract.data.pairs.generator import device_of  # noqa: PLC0415  # an actor imports this function alone

    try:
        device_of("cuda")
    except UsageError as error:
        return os.environ.get("CUDA_VISIBLE_DEVICES"), str(error)
    return os.environ.get("CUDA_VISIBLE_DEVICES"), ""


@pytest.mark.filterwarnings("ignore::DeprecationWarning:ray.data.context")  # Ray sets its own old options
def test_ray_places_actors_on_gpus(ray):
    options: Any = {"workers": 1, "address": None}
    (gpus, error), *_ = map_in_actors(visible_gpus, range(2), num_gpus=1, **options)
    assert gpus == "0"
    assert torch.cuda.is_available() or error.startswith("device must be cpu where PyTorch sees no GPU, got cuda")
    (gpus, _), *_ = map_in_actors(visible_gpus, range(2), **options)
    assert gpus != "0"


def test_more_actors_than_gpus_raise(tmp_path: Path):
    pytest.importorskip("ray", reason="ray is in the extra ray")
    with pytest.raises(UsageError, match=r"^engine.num_gpus must be 0 or fit the GPUs of this machine, got 1 for"):
        next(map_in_actors(str, range(2), workers=99, address=None, num_gpus=1))
