"""Derivatives of effects and label functions, against central differences of the exact function in float64."""

import derivatives
import pytest
import torch
from derivatives import (
    CASES,
    HEIGHT,
    LARGEST,
    LENSES,
    WARPS,
    WIDTH,
    Errors,
    central_difference,
    curved_function,
    directions_of,
    errors_of,
    relative_error,
)
from helpers import random_image
from torch import Tensor
from torch.func import grad, hessian, jacfwd, jacrev, jvp, vmap

from torchrefract.fields.lens import lens_flow
from torchrefract.warping.lattice import pixel_lattice

pytestmark = [
    pytest.mark.filterwarnings("ignore:`torch.jit.script:FutureWarning"),  # PyTorch's forward mode compiles scripts
    pytest.mark.filterwarnings("ignore:`torch.jit.script:DeprecationWarning"),  # in other versions of PyTorch
    pytest.mark.filterwarnings("ignore:.*must fit into a periodic domain:UserWarning"),  # frames of 7 x 8 px are small
    pytest.mark.filterwarnings("ignore:.*folds:UserWarning"),  # a fold changes no derivative
]

# Images are sampled by PyTorch's grid_sample, and the color of light by the same, which have no forward over reverse.
SAMPLED = {name for name in CASES if name.endswith((", image", ", bilinear", ", soft=True"))}
SAMPLED |= {"volumetric fog", "chromatic aberration"}
STRENGTHS = {  # parameters that have a gradient at strength zero
    "lens": "coefficients",
    "turbulence": "amplitude",
    "thin-plate spline": "displacement",
    "rolling shutter": "speed",
    "divergence-free": "amplitude",
}


# The image of each warp is sampled along its flow by the same code.
@pytest.mark.parametrize("name", [name for name in CASES if not name.endswith(", image") or name == "lens, image"])
def test_every_mode_gives_the_derivatives_of_the_exact_function_or_raises(name):
    errors = errors_of(name)
    assert errors.largest <= LARGEST, errors
    assert (errors.hessian is None) == (name in SAMPLED)
    assert errors.forward is not None
    assert errors.reverse is not None
    assert errors.backward_twice is not None


@pytest.mark.parametrize("name", [name for name in CASES if name not in SAMPLED])
def test_third_derivatives_are_those_of_the_exact_function(name):
    function, x = CASES[name]()
    direction, weights = directions_of(function, x)
    curved = curved_function(function, weights)

    def curvature(x: Tensor, *, create_graph: bool = False) -> Tensor:
        leaf = x if create_graph else x.clone().requires_grad_()
        (slope,) = torch.autograd.grad(curved(leaf), leaf, create_graph=True)
        return torch.autograd.grad(slope @ direction, leaf, create_graph=create_graph)[0]

    leaf = x.clone().requires_grad_()
    backward = torch.autograd.grad(curvature(leaf, create_graph=True) @ direction, leaf)[0]
    forward = jvp(grad(lambda x: grad(curved)(x) @ direction), (x,), (direction,))[1]
    scale = x.abs().clamp(min=0.1)
    expected = 2 * central_difference(curvature, x, direction / 2) * scale
    errors = [relative_error(value * scale, expected) for value in (backward, forward)]
    # Roots of the rounded spectrum of a stream function are noise in its third derivatives with respect to its length.
    assert max(errors) <= (1e-3 if "divergence-free" in name else LARGEST), errors


@pytest.mark.quick
def test_a_wrong_derivative_ends_the_command(monkeypatch, capsys):
    rows = {"right": Errors("right", 1e-9, 1e-8, None, 1e-7), "wrong": Errors("wrong", 1e-9, 0.5, 1e-9, None)}
    monkeypatch.setattr(derivatives, "CASES", rows)
    monkeypatch.setattr(derivatives, "errors_of", rows.get)
    monkeypatch.setattr("sys.argv", ["derivatives.py", "--only", "right"])
    derivatives.main()
    assert "largest of all: 1.0e-07, bar 1e-05" in capsys.readouterr().out
    monkeypatch.setattr("sys.argv", ["derivatives.py", "--only", "right", "wrong"])
    with pytest.raises(SystemExit):
        derivatives.main()
    assert capsys.readouterr().out.splitlines()[2].split() == ["wrong", "1.0e-09", "5.0e-01", "1.0e-09", "raises"]


@pytest.mark.quick
def test_a_backward_that_is_off_by_a_tenth_is_an_error_of_a_tenth(monkeypatch):
    class Cube(torch.autograd.Function):
        generate_vmap_rule = True

        @staticmethod
        def forward(x):
            return x**3

        @staticmethod
        def setup_context(ctx, inputs, output):
            ctx.save_for_backward(*inputs)

        @staticmethod
        def backward(ctx, *gradients):
            return gradients[0] * 3.3 * ctx.saved_tensors[0] ** 2

    monkeypatch.setitem(CASES, "cube", lambda: (Cube.apply, torch.tensor([0.5, 1.5], dtype=torch.float64)))
    errors = errors_of("cube")
    assert errors.forward is None  # it has no forward mode
    assert errors.reverse == pytest.approx(0.1)


def test_nested_transforms_give_the_derivatives_of_a_lens():
    points = pixel_lattice(3, 4).points(dtype=torch.float64, device=torch.device("cpu"))
    x = torch.tensor([*LENSES["polynomial12"], 4.0, 4.5, 1.4, 1.1], dtype=torch.float64)

    def total(x: Tensor) -> Tensor:
        return lens_flow(x[None, :12], x[None, 12:14], x[None, 14:], points)[0].square().sum()

    def through_vmap(x: Tensor) -> Tensor:
        return vmap(total)(x[None])[0]

    expected = torch.stack([central_difference(jacrev(total), x, direction) for direction in torch.eye(16).double()])
    for name, second in {
        "forward over forward": jacfwd(jacfwd(total)),
        "reverse over forward": jacrev(jacfwd(total)),
        "reverse over reverse": jacrev(jacrev(total)),
        "through vmap": jacfwd(jacfwd(through_vmap)),
    }.items():
        assert relative_error(second(x), expected) <= LARGEST, name
    third = torch.stack([central_difference(hessian(total), x, torch.eye(16).double()[i]) for i in (0, 12)])
    assert relative_error(jacrev(hessian(total))(x)[[0, 12]], third) <= LARGEST


@pytest.mark.parametrize("name", ["thin-plate spline, image", "volumetric fog"])
def test_forward_over_reverse_of_an_image_says_what_pytorch_lacks(name):
    function, x = CASES[name]()
    with pytest.raises(NotImplementedError, match="forward AD"):
        hessian(lambda x: function(x).square().sum())(x)


@pytest.mark.parametrize(("name", "field"), STRENGTHS.items())
def test_forward_mode_reaches_parameters_at_strength_zero(name, field):
    image = random_image(2, 3, HEIGHT, WIDTH, dtype=torch.float64)
    effect = WARPS[name]()
    params = effect.sample(image, seed=1)
    value = torch.zeros_like(getattr(params, field))

    def flow(value: Tensor) -> Tensor:
        return effect.apply(image, params._replace(**{field: value})).flow

    direction = torch.ones_like(value)
    forward, reverse = jvp(flow, (value,), (direction,))[1], jacrev(flow)(value).flatten(4).sum(dim=-1)
    assert forward.abs().max() > 0
    torch.testing.assert_close(forward, reverse)
