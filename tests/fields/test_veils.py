import math
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.autograd import forward_ad
from torch.testing import assert_close

from torchrefract import _compiled as compiled
from torchrefract.fields import veils
from torchrefract.fields.fog import linear_to_srgb, srgb_to_linear
from torchrefract.fields.veils import NO_ENDS, Drifting, Ends, veiled, veiled_by_drifts_

pytest.importorskip("torchrefract._jit", reason="needs numba")
SIZES = [(1, 1), (3, 127), (5, 128), (4, 129), (40, 300), (2, 1920)]
BARS = {False: 2e-7, True: 1e-6}  # of images in [0, 1]; the curve of sRGB stretches rounding in the dark
both_lights = pytest.mark.parametrize("linear", [False, True])


def frames(count: int, size: tuple[int, int], channels: int = 3) -> Tensor:
    found = torch.rand(count, channels, *size, generator=torch.Generator().manual_seed(1))
    found[..., ::7], found[..., 3::11] = 0.0, 1.0
    return found


def colors(count: int, channels: int = 3) -> Tensor:
    return torch.rand(count, channels, generator=torch.Generator().manual_seed(2))


def drifts(count: int, size: tuple[int, int], *, distances: tuple[int, int] | None = None, k: float = 0.05) -> Drifting:
    """Of q between 0 and 1; by default each sample has distances by pixel, from 0 to beyond everything."""
    generator = torch.Generator().manual_seed(3)
    far = 600 * torch.rand(count, 1, *(distances or size), generator=generator) ** 3
    far.flatten()[::5], far.flatten()[2::13] = 0.0, math.inf
    noise = torch.rand(count, 1, *size, generator=generator) - 0.5
    each = k * (1 + torch.arange(count)).view(-1, 1, 1, 1).float()
    return Drifting(noise, each, each / 2, far)


def precisely(drifting: Drifting) -> Drifting:
    return Drifting(*(value.double() for value in drifting))


def own(drifting: Drifting, rows: list[int] | slice = slice(None)) -> Drifting:
    """A copy, as the noise gives its memory away."""
    return Drifting(*(value[rows].clone() for value in drifting))


def expected(image: Tensor, drifting: Drifting, airlight: Tensor, *, linear: bool) -> tuple[Tensor, Tensor]:
    """The closed form in float64."""
    noise, a, b, distance = precisely(drifting)
    t = torch.exp(-(a * noise + b) * distance.clamp(max=1e12))
    light = airlight.double()[:, :, None, None]
    if not linear:
        return t * image.double() + (1 - t) * light, t
    mixed = t * srgb_to_linear(image.double()) + (1 - t) * srgb_to_linear(light)
    return linear_to_srgb(mixed), t


@pytest.fixture
def asked(monkeypatch) -> list[str]:
    """The kernels that are called."""
    found, kernels = list[str](), compiled.kernels

    def counted(name: str) -> Any:
        found.append(name)
        return kernels(name)

    monkeypatch.setattr(veils, "kernels", counted)
    return found


@both_lights
@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("channels", [1, 3, 4])
def test_drifts_are_those_of_float64(size, channels, linear, asked, oracle):
    image, airlight = frames(2, size, channels), colors(2, channels)
    for distances in (size, (size[0], 1)):
        drifting = drifts(2, size, distances=distances)
        for one in (drifting, drifting._replace(distance=drifting.distance[:1])):
            exact = expected(image, one, airlight, linear=linear)
            found = veiled_by_drifts_(image, own(one), airlight, ends=NO_ENDS, linear=linear)
            kind = "linear light" if linear else "stored values"
            oracle(f"drifts by a kernel, {kind}, float64", found[0], exact[0], BARS[linear], unit="")
            oracle("transmission of drifts by a kernel, float64", found[1], exact[1], 2e-7, unit="")
    assert set(asked) == {"fields.kernels.veils"}


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("rows", [1, 2])
def test_linear_light_behind_a_given_transmission_is_that_of_float64(size, rows, asked, oracle):
    image, airlight = frames(2, size), colors(2)
    for width in (1, size[1]):
        t = torch.rand(rows, 1, size[0], width, generator=torch.Generator().manual_seed(4))
        t.flatten()[::3], t.flatten()[1::5] = 0.0, 1.0
        light = srgb_to_linear(airlight.double())[:, :, None, None]
        exact = linear_to_srgb(t * srgb_to_linear(image.double()) + (1 - t.double()) * light)
        found = veiled(image, t, airlight, ends=NO_ENDS, linear=True)
        oracle("linear light by a kernel, float64", found, exact, BARS[True], unit="")
        clear = (t == 1).expand(2, -1, -1, size[1])
        assert torch.equal(found[clear.expand_as(found)], image[clear.expand_as(found)])
    assert asked


@both_lights
def test_what_is_not_seen_is_the_airlight_and_what_is_not_veiled_the_image_bit_for_bit(linear):
    size = (6, 400)
    image, airlight = frames(1, size), colors(1)
    distance = torch.tensor([0.0, 0.0, 1e4, 1e30, math.inf, 30.0])[None, None, :, None]
    drifting = drifts(1, size)._replace(distance=distance)
    drifting.noise.clamp_(min=-0.4)  # without holes
    found, t = veiled_by_drifts_(image, drifting, airlight, ends=NO_ENDS, linear=linear)
    assert torch.equal(found[:, :, :2], image[:, :, :2])
    assert torch.equal(found[:, :, 3:5], airlight[:, :, None, None].expand(-1, -1, 2, size[1]))
    assert t[:, :, :2].unique().tolist() == [1]
    assert t[:, :, 3:5].unique().tolist() == [0]
    assert 0 < t[:, :, 5].min() < t[:, :, 5].max() < 1


@both_lights
@pytest.mark.parametrize("with_numba", [True, False])
def test_ends_are_where_they_are_said_to_be(linear, with_numba, monkeypatch):
    size, ends = (40, 300), Ends(opaque=0.02, clear=0.95)
    image, airlight, drifting = frames(2, size), colors(2), drifts(2, size)
    exact, t = expected(image, drifting, airlight, linear=linear)
    monkeypatch.setattr(compiled, "kernels", compiled.kernels if with_numba else lambda _: None)
    found, through = veiled_by_drifts_(image, own(drifting), airlight, ends=ends, linear=linear)
    opaque, clear = t < 0.02 - 1e-6, t > 0.95 + 1e-6
    between = (t > 0.02 + 1e-6) & (t < 0.95 - 1e-6)
    for where in (opaque, clear, between):
        assert 0.05 < where.float().mean() < 0.9
    assert through[opaque].unique().tolist() == [0]
    assert through[clear].unique().tolist() == [1]
    # PyTorch rounds more often.
    assert_close(through[between], t[between].float(), rtol=0, atol=2e-7 if with_numba else 1e-6)
    color = airlight[:, :, None, None].expand_as(image)
    # In linear light PyTorch's airlight goes through the curve of sRGB and back.
    assert_close(found[opaque.expand_as(found)], color[opaque.expand_as(found)], rtol=0, atol=3e-7 * (not with_numba))
    assert torch.equal(found[clear.expand_as(found)], image[clear.expand_as(found)])
    inner = between.expand_as(found)
    assert_close(found[inner], exact[inner].float(), rtol=0, atol=BARS[linear] if with_numba else 1e-6)


@both_lights
def test_batch_and_threads_change_no_bit(linear, on_threads):
    size, ends = (150, 261), Ends(0.01, 0.99)
    image, airlight, drifting = frames(4, size), colors(4), drifts(4, size)

    def made(rows: list[int]) -> tuple[Tensor, Tensor]:
        return veiled_by_drifts_(image[rows], own(drifting, rows), airlight[rows], ends=ends, linear=linear)

    together = made([0, 1, 2, 3])
    for threads in (1, 2, 3, 8):
        on_threads(threads)
        for rows in ([0, 1, 2, 3], [1], [3, 1, 0]):
            assert all(torch.equal(one, whole[rows]) for one, whole in zip(made(rows), together, strict=True))


@both_lights
def test_any_part_of_the_rows_is_made_as_in_the_whole(linear, monkeypatch):
    size, ends = (61, 140), [0, 1, 2, 17, 61, 62, 130, 183]
    image, airlight, drifting = frames(3, size), colors(3), drifts(3, size)
    whole = veiled_by_drifts_(image, own(drifting), airlight, ends=NO_ENDS, linear=linear)[0]

    def in_pieces(work: Any, count: int, *, least: int) -> None:
        assert count == ends[-1]
        assert least > 0
        for start, stop in reversed(list(pairwise(ends))):
            work(start, stop)

    monkeypatch.setattr(veils, "share", in_pieces)
    again = veiled_by_drifts_(image, own(drifting), airlight, ends=NO_ENDS, linear=linear)[0]
    assert torch.equal(again, whole)


@pytest.mark.parametrize("layout", ["channels_last", "strided"])
def test_where_the_image_lies_in_memory_changes_no_bit(layout):
    size = (30, 140)
    image, airlight, drifting = frames(2, size), colors(2), drifts(2, size)
    whole = veiled_by_drifts_(image, own(drifting), airlight, ends=NO_ENDS, linear=False)[0]
    other = image.contiguous(memory_format=torch.channels_last)
    if layout == "strided":
        other = torch.zeros(2, 3, 30, 280)[..., ::2].copy_(image)
    found = veiled_by_drifts_(other, own(drifting), airlight, ends=NO_ENDS, linear=False)[0]
    assert torch.equal(found, whole)


@both_lights
def test_gradients_of_the_image_are_those_of_float64_and_have_some_of_their_own(linear, asked):
    size = (20, 150)
    image, airlight, drifting = frames(2, size).clamp(0.02, 0.98), colors(2), drifts(2, size)
    upstream = torch.rand(image.shape, generator=torch.Generator().manual_seed(5))
    slopes = []
    for dtype in (torch.float32, torch.float64):
        leaf = image.to(dtype).requires_grad_()
        one = Drifting(*(value.to(dtype).clone() for value in drifting))
        found = veiled_by_drifts_(leaf, one, airlight.to(dtype), ends=NO_ENDS, linear=linear)[0]
        total = (found * upstream.to(dtype)).sum()
        once = torch.autograd.grad(total, leaf, retain_graph=True)[0]
        slope = torch.autograd.grad(total, leaf, create_graph=True)[0]
        again = torch.autograd.grad(slope.square().sum(), leaf)[0] if linear else torch.zeros_like(slope)
        slopes.append((once, slope.detach(), again))
    assert set(asked) == {"fields.kernels.veils"}
    for (found, exact), bar in zip(zip(*slopes, strict=True), (1e-5, 1e-5, 1e-3), strict=True):
        assert_close(found.double(), exact, rtol=bar, atol=bar)
    assert slopes[1][0].abs().max() > 0.5
    assert not linear or slopes[1][2].abs().max() > 0.5


def test_gradients_of_linear_light_behind_one_transmission_in_each_row_are_those_of_float64(asked):
    image, airlight, t = frames(2, (9, 150)), colors(2), torch.linspace(0, 1, 9).view(1, 1, 9, 1)
    slopes = []
    for dtype in (torch.float32, torch.float64):
        leaf = image.to(dtype).requires_grad_()
        found = veiled(leaf, t.to(dtype), airlight.to(dtype), ends=Ends(0.2, 0.8), linear=True)
        slopes.append(torch.autograd.grad(found.sum(), leaf)[0])
    assert len(asked) == 2  # forward, and backward
    assert_close(slopes[0].double(), slopes[1], rtol=1e-5, atol=1e-5)
    assert slopes[0][:, :, :2].abs().max() == 0
    assert (slopes[0][:, :, 7:] == 1).all()


@both_lights
@pytest.mark.parametrize("which", ["noise", "scale", "offset", "distance", "airlight"])
def test_what_learns_changes_no_bit_and_has_the_gradients_of_float64(which, linear, asked):
    size, ends = (8, 150), Ends(0.02, 0.95)
    image, inputs = frames(2, size).clamp(0.02, 0.98), {"airlight": colors(2), **drifts(2, size)._asdict()}
    inputs["distance"].clamp_(max=500.0)
    upstream = torch.rand(2, 4, *size, generator=torch.Generator().manual_seed(5))

    def made(dtype: torch.dtype, *, learning: bool) -> tuple[Tensor, Tensor]:
        values = {name: value.to(dtype).clone() for name, value in inputs.items()}
        values[which].requires_grad_(learning)
        drifting = Drifting(*(values[name] for name in Drifting._fields))
        found = torch.cat(
            veiled_by_drifts_(image.to(dtype), drifting, values["airlight"], ends=ends, linear=linear), dim=1
        )
        slope = torch.autograd.grad((found * upstream.to(dtype)).sum(), values[which])[0] if learning else found
        return found.detach(), slope

    still, (found, slope) = made(torch.float32, learning=False)[0], made(torch.float32, learning=True)
    assert set(asked) == {"fields.kernels.veils"}
    assert torch.equal(found, still)
    exact = made(torch.float64, learning=True)[1]
    assert exact.abs().max() > 0
    assert_close(slope.double(), exact, rtol=1e-4, atol=1e-5 * exact.abs().max().item())


@both_lights
def test_gradients_of_what_noise_and_distance_both_come_of_are_those_of_float64(linear, asked):
    size = (8, 150)
    image, airlight, drifting = frames(2, size).clamp(0.02, 0.98), colors(2), drifts(2, size)
    slopes = []
    for dtype in (torch.float32, torch.float64):
        # Nearer than that t rounds to 1 in float32, where the image is left as it is.
        leaf = drifting.distance.clamp(1.0, 500.0).to(dtype).requires_grad_()
        noise, a, b, _ = (value.to(dtype) for value in drifting)
        own = Drifting(noise + 1e-3 * leaf, a, b, leaf)
        found = veiled_by_drifts_(image.to(dtype), own, airlight.to(dtype), ends=NO_ENDS, linear=linear)[0]
        (once,) = torch.autograd.grad(found.sum(), leaf, create_graph=True)
        slopes.append((once.detach(), *torch.autograd.grad(once.square().sum(), leaf)))
    assert asked
    for found, exact in zip(*slopes, strict=True):
        assert exact.abs().max() > 1e-3
        assert_close(found.double(), exact, rtol=1e-3, atol=1e-4 * exact.abs().max().item())


@pytest.mark.filterwarnings("ignore:.torch.jit.script. is deprecated:FutureWarning")  # of torch.func.jvp
@both_lights
def test_maps_graphs_and_forward_gradients_are_pytorchs(linear, asked):
    size = (8, 30)
    image, airlight, drifting = frames(2, size), colors(2), drifts(2, size)

    def made(image: Tensor, airlight: Tensor, *drifting: Tensor) -> Tensor:
        return veiled_by_drifts_(image, Drifting(*drifting), airlight, ends=Ends(0.1, 0.9), linear=linear)[0]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(compiled, "kernels", lambda _: None)
        plain = made(image, airlight, *own(drifting))
    graph = torch.compile(made, fullgraph=True, backend="eager")(image, airlight, *own(drifting))
    assert_close(graph, plain, rtol=0, atol=1e-6)

    def sample(*values: Tensor) -> Tensor:
        return made(*(value[None] for value in values))[0]

    mapped = torch.vmap(sample)(image, airlight, *own(drifting))
    assert_close(mapped, plain, rtol=0, atol=1e-6)
    with forward_ad.dual_level():
        tangent = forward_ad.unpack_dual(made(forward_ad.make_dual(image, image), airlight, *own(drifting))).tangent
    assert tangent is not None
    assert tangent.abs().max() > 0
    assert not asked


@both_lights
@pytest.mark.parametrize("poison", [math.nan, math.inf, -math.inf])
def test_a_pixel_that_is_no_number_stays_alone(poison, linear):
    size = (8, 300)
    image, airlight, drifting = frames(1, size), colors(1), drifts(1, size)
    clean = veiled_by_drifts_(image, own(drifting), airlight, ends=NO_ENDS, linear=linear)[0]
    image[0, 1, 3, 150] = poison
    found = veiled_by_drifts_(image, own(drifting), airlight, ends=NO_ENDS, linear=linear)[0]
    apart = found != clean
    assert apart.sum() <= 1
    assert not apart.any() or (apart.nonzero() == torch.tensor([[0, 1, 3, 150]])).all()


def test_exponentials_and_powers_are_those_of_real_numbers():
    kernels = compiled.kernels("fields.kernels.exponentials")
    for x in np.linspace(-87, 88, 4001, dtype=np.float32):
        assert kernels.exponential(x) == pytest.approx(math.exp(x), rel=2e-7)
    assert kernels.exponential(np.float32(0)) == 1
    for x in np.geomspace(1e-3, 1e3, 4001, dtype=np.float32):
        for exponent in (np.float32(2.4), np.float32(1 / 2.4)):
            # The exponent of e is rounded twice, by half a unit of its last place, 2^-24 of it.
            bar = 3e-7 + 2 * 2**-24 * abs(float(exponent) * math.log(x))
            assert kernels.power(x, exponent) == pytest.approx(float(x) ** float(exponent), rel=bar)
    assert kernels.power(np.float32(1), np.float32(2.4)) == 1
