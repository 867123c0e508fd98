"""Effects under PyTorch's settings and tools: default types and devices, meta and fake tensors, graphs, saved files."""

import ast
import io
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import torch
from helpers import EFFECTS, SIZE, assert_equal_maps, maps_of, random_image, seeded
from torch import Tensor, nn
from torch._dynamo.exc import FailOnRecompileLimitHit
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.testing import assert_close

import torchrefract as tr
from torchrefract import random
from torchrefract._tensor import cached_constant
from torchrefract.effects.base import Effect
from torchrefract.effects.photometric_effect import PhotometricEffect, Rendered

SOURCES = Path(tr.__file__).parent
PACKAGES = ("effects", "fields", "planning", "labels", "cameras", "warping", "ops")
FLOATS = {"empty", "eye", "full", "linspace", "ones", "rand", "randn", "zeros"}
FACTORIES = {*FLOATS, "arange", "as_tensor", "randint", "randperm", "tensor"}


@pytest.fixture(params=EFFECTS)
def effect(request) -> Effect:
    return EFFECTS[request.param]()


@pytest.mark.quick
def test_every_new_tensor_names_its_device_and_floats_their_type():
    calls = []
    for path in [*SOURCES.glob("*.py"), *(path for name in PACKAGES for path in (SOURCES / name).rglob("*.py"))]:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
                module, name = ast.unparse(node.func.value), node.func.attr
                # torch.where of two numbers is of the default type, and a cache keeps it for later calls.
                assert name != "where" or not all(isinstance(value, ast.Constant) for value in node.args[1:3]), path
                if module == "torch" and name in FACTORIES:
                    calls.append((path.name, node.lineno, name, {word.arg for word in node.keywords}))
    assert len(calls) > 50
    for name, line, factory, words in calls:
        expected = {"device", "dtype"} if factory in FLOATS else {"device"}
        assert expected <= words, (name, line, factory)


@pytest.fixture
def default_type() -> Iterator[Callable[[torch.dtype], None]]:
    """Return the function that sets the default type, which is restored after the test."""
    before = torch.get_default_dtype()
    yield torch.set_default_dtype
    torch.set_default_dtype(before)


def test_the_default_type_changes_no_bit(effect, default_type):
    image = random_image(2, 3, *SIZE)
    expected = maps_of(effect.degrade(image, seed=7, frame=2))
    for dtype in (torch.bfloat16, torch.float64):
        default_type(dtype)
        assert_equal_maps(maps_of(effect.degrade(image, seed=7, frame=2)), expected)


def test_the_default_type_changes_no_bit_of_lamps_in_fog(default_type):
    fog = tr.HeterogeneousFog(mode="ray", airlight=0.1, lamp_luminance=20.0)
    image = random_image(2, 3, *SIZE)
    expected = maps_of(fog.degrade(image, seed=7))
    default_type(torch.float64)
    assert_equal_maps(maps_of(fog.degrade(image, seed=7)), expected)


def test_the_default_type_changes_no_bit_of_moved_labels(default_type):
    flow = tr.LensDistortion().degrade(random_image(1, 3, *SIZE), seed=7).flow
    points, boxes = 30 * random_image(1, 9, 2), torch.tensor([[3.0, 4.0, 20.0, 25.0]])
    results = []
    for dtype in (torch.float32, torch.bfloat16, torch.float64):
        default_type(dtype)
        results.append((*tr.warp_points(points, flow), *tr.warp_boxes(boxes, flow[0]), *tr.invert_flow(flow)))
    for expected, *others in zip(*results, strict=True):
        for value in others:
            assert value.dtype is expected.dtype
            assert torch.equal(value, expected)


def test_the_default_device_changes_nothing(effect):
    image = random_image(2, 3, *SIZE)

    def results() -> dict[str, Tensor]:
        return maps_of(effect.degrade(image, seed=7, keys=[5, 9])) | {"drawn": effect(image)}

    expected = seeded(results)
    with torch.device("meta"):
        assert_equal_maps(seeded(results), expected)


# `torch.compile` runs each effect on fake tensors in its own test; one of each kind suffices outside of a graph.
FAKE = ("thin-plate spline", "uniform fog", "flare", "one of", "rectification")


@pytest.mark.parametrize(("name", "mode"), [*((n, torch.device("meta")) for n in EFFECTS), *((n, None) for n in FAKE)])
def test_images_without_values_give_shapes(name, mode):
    effect = EFFECTS[name]()
    expected = maps_of(effect.degrade(random_image(2, 3, *SIZE), seed=7))
    with mode or FakeTensorMode():
        image = torch.empty(2, 3, *SIZE, dtype=torch.float32)
        actual = maps_of(effect.degrade(image))
    assert actual.keys() == expected.keys()
    for field, value in actual.items():
        assert (value.shape, value.dtype, value.device) == (expected[field].shape, expected[field].dtype, image.device)


@pytest.mark.quick
def test_a_cached_constant_does_not_depend_on_who_computes_it_first():
    @cached_constant(maxsize=4)
    def total(count: int) -> float:
        return torch.arange(count, dtype=torch.float64).sum().item()

    with FakeTensorMode(), torch.device("meta"), torch.inference_mode():
        assert total(4) == 6.0
    assert total(4) == 6.0


def test_a_graph_takes_another_frame_size_and_batch():
    effect, graphs = tr.ThinPlateSpline(), []
    compiled = torch.compile(effect, fullgraph=True, backend=lambda graph, _: graphs.append(graph) or graph.forward)
    for shape in ((2, 3, 24, 32), (3, 3, 20, 28), (3, 3, 24, 32), (2, 3, 24, 32)):
        image = random_image(*shape)
        assert_close(seeded(compiled, image), seeded(effect, image), rtol=0, atol=2e-4)
    assert len(graphs) == 3


def test_the_number_of_frame_sizes_of_a_graph_is_the_recompile_limit_of_pytorch():
    effect, images = tr.UniformFog(), [random_image(1, 3, 8 + k, 12 + 2 * k) for k in range(2)]
    for limit in (1, 2):
        torch.compiler.reset()
        compiled = torch.compile(effect, fullgraph=True, backend="eager")
        with torch._dynamo.config.patch(recompile_limit=limit):
            for image in images[:limit]:
                assert_close(seeded(compiled, image), seeded(effect, image), rtol=0, atol=2e-4)
            if limit < len(images):
                with pytest.raises(FailOnRecompileLimitHit):
                    compiled(images[limit])


@pytest.mark.filterwarnings("ignore:depth is that of a road")  # the warning is not what is tested
def test_effects_of_one_class_with_other_numbers_have_a_graph_each():
    image = random_image(1, 3, 12, 16)
    for fx in (15.0, 17.0):  # torch.compile makes a symbol of a number that differs
        camera = tr.Camera(width=16, height=12, fx=fx, fy=fx, cx=7.5, cy=5.5, coefficients=(0.0,) * 4)
        effect = tr.UniformFog(camera=camera, depth=tr.CorridorDepth(focal=fx / 16))
        compiled = torch.compile(effect, fullgraph=True, backend="eager")
        assert_close(seeded(compiled, image), seeded(effect, image), rtol=0, atol=2e-4)


@pytest.mark.parametrize("effect", [tr.ThinPlateSpline(), tr.LensDistortion()], ids=["spline", "lens"])
def test_a_model_with_an_effect_is_exported_as_a_graph_that_draws(effect):
    model, image = nn.Sequential(nn.Conv2d(3, 3, 1), effect).train(), random_image(2, 3, 24, 32)
    file = io.BytesIO()
    torch.export.save(torch.export.export(model, (image,)), file)
    file.seek(0)
    exported = torch.export.load(file).module()
    expected, first = seeded(model, image), seeded(exported, image)
    assert_close(first, expected, rtol=0, atol=2e-4)
    assert (exported(image) - first).abs().max() > 0.01


def saved_and_loaded(value: Any) -> Any:
    file = io.BytesIO()
    torch.save(value, file)
    file.seek(0)
    return torch.load(file, weights_only=True)


@pytest.mark.quick
def test_saved_params_are_loaded_with_weights_only(effect):
    image = random_image(2, 3, *SIZE)
    degraded = effect.degrade(image, seed=7)
    params = saved_and_loaded({"params": degraded.params})["params"]
    assert type(params) is type(degraded.params)
    assert torch.equal(effect.apply(image, params).image, degraded.image)


class DimmerParams(NamedTuple):
    """Parameters of an effect that is defined outside of the package."""

    applied: Tensor
    share: Tensor

    @property
    def is_identity(self) -> Tensor:
        return self.share == 1


class Dimmer(PhotometricEffect):
    params_type, maps = DimmerParams, ()

    def sample_params(self, stream: random.Stream, image: Tensor) -> DimmerParams:
        return DimmerParams(*self.draw_in_ranges(stream, [(0.2, 0.8)], image))

    def validate(self, params: DimmerParams, image: Tensor) -> None:
        return None

    def render(self, image: Tensor, params: DimmerParams, depth: Tensor | None) -> Rendered:
        return Rendered(image * params.share.view(-1, 1, 1, 1), lambda: params.applied.view(-1, 1, 1, 1))


def test_saved_params_of_an_effect_of_another_package_are_loaded_with_weights_only():
    params = Dimmer().sample(random_image(2, 3, *SIZE), seed=7)
    assert_close(saved_and_loaded(params), params, rtol=0, atol=0)


@pytest.mark.filterwarnings("ignore:`torch.jit.trace")  # PyTorch's, of its own function
@pytest.mark.parametrize("name", EFFECTS)
def test_a_trace_raises_and_names_what_draws_anew(name):
    with pytest.raises(TypeError, match=r"use torch\.export\.export or torch\.compile"):
        torch.jit.trace(EFFECTS[name](), random_image())
