import math

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from torchrefract import random
from torchrefract.fields import low_modes
from torchrefract.fields.covariance import covariance
from torchrefract.fields.gaussian import eigenvalues, gaussian_random_field, spectrum
from torchrefract.fields.length_bounds import eigenvalue_error, mean_eigenvalue, nodes_needed
from torchrefract.fields.low_modes import low_amplitude, low_eigenvalues, low_field
from torchrefract.fields.modes import Modes, mode_field, mode_noise, sum_of_modes
from torchrefract.fields.torus import torus
from torchrefract.types import Range

KINDS = ["exponential", "matern32", "matern52"]
RANGES = [(20.0, 60.0), (40.0, 80.0), (5.0, 5.0), (7.0, 7.01)]
# 3 divides one of the sides; up to a sixth of a period to the pixel, an aperture of 4 px leaves nothing out.
MODES = Modes((432, 560), 71, 92)


def drawn(lengths: Range, count: int) -> Tensor:
    """(count,), float64, from the shortest to the longest."""
    share = torch.rand(count, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    share[0], share[-1] = 0, 1
    return lengths[0] + (lengths[1] - lengths[0]) * share


def keys(count: int) -> Tensor:
    return random.noise_key(random.stream(3, torch.arange(count)))


def exact(modes: Modes, length: Tensor, kind: str) -> Tensor:
    whole = eigenvalues(modes.size, length[:, None, None], kind)
    return whole[:, : modes.rows + 1, : modes.columns + 1].clamp(min=0)


def in_order(quarter: Tensor, modes: Modes) -> Tensor:
    """(B, My, Mx) of a quarter of what is even along both axes."""
    rows, columns = (torch.arange(-most, most + 1).abs() for most in modes[1:])
    return quarter[:, rows][:, :, columns]


def amplitude_of(modes: Modes, length: Tensor, aperture: Tensor, *, kind: str = "exponential") -> Tensor:
    lengths = length.min().item(), length.max().item()
    options = {"lengths": lengths, "nodes": nodes_needed(modes.size, lengths, kind=kind, aperture=3.0)}
    return low_amplitude(modes, length, kind=kind, **options, aperture=aperture, dtype=torch.float64)


def example(count: int, modes: Modes = MODES, dtype: torch.dtype = torch.float64) -> tuple[Tensor, Tensor]:
    """The noise and the amplitude of fields of other lengths and apertures."""
    length, aperture = torch.linspace(20, 40, count).double(), torch.linspace(4, 4.5, count).double()
    return mode_noise(keys(count), modes, dtype=dtype), amplitude_of(modes, length, aperture).to(dtype)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("lengths", RANGES)
@pytest.mark.parametrize("fewer", [0, 4, 8])
def test_eigenvalues_between_the_nodes_are_off_by_less_than_the_bound(kind, lengths, fewer):
    size = torus(64, 96, length=lengths[1], kind=kind)
    modes = Modes(size, size[0] // 5, size[1] // 7)
    needed = nodes_needed(size, lengths, kind=kind, aperture=3.0)
    assert needed is not None
    nodes, length = max(1 if lengths[0] == lengths[1] else 2, needed - fewer), drawn(lengths, 9)
    found = low_eigenvalues(modes, length, kind=kind, lengths=lengths, nodes=nodes)
    expected = exact(modes, length, kind)
    assert found.dtype is torch.float64
    assert found.shape == expected.shape
    error, bound = (found - expected).abs().max().item(), eigenvalue_error(lengths, nodes, kind=kind)
    rounding = 1e-14 * expected.max().item()
    assert error <= bound + rounding
    assert bound <= 1e4 * (error + rounding)


@pytest.mark.parametrize("kind", KINDS)
def test_the_modulus_of_eigenvalues_of_complex_lengths_is_below_what_the_bound_takes_it_for(kind):
    y, x = torch.arange(-400, 401).double()[:, None], torch.arange(-400, 401).double()
    degree = KINDS.index(kind)
    for v, w in [(0.0, 0.0), (1.0, 0.7), (2.5, -0.3), (2.0, 1.2), (3.0, 0.0)]:
        length = torch.exp(torch.tensor(complex(v, w), dtype=torch.complex128))
        total = covariance(torch.hypot(y, x).to(torch.complex128), length, kind).abs().sum().item()
        real = math.exp(v) / math.cos(w)
        bound = (1 + 5 * real + 2 * math.pi * real**2) / math.cos(w) ** degree
        assert total <= bound <= 3 * total / math.cos(w) ** degree


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("length", [2.0, 6.0, 15.0])
@pytest.mark.parametrize("aperture", [0.0, 1.0, 2.0, 4.0, 8.0])
def test_the_mean_eigenvalue_is_no_less_than_its_bound(kind, length, aperture):
    power = eigenvalues((224, 280), torch.tensor([[[length]]]).double(), kind)[0]
    y, x = torch.arange(113).double()[:, None] / 224, torch.arange(141).double() / 280
    often_y, often_x = (torch.where((k > 0) & (k < 0.5), 2, 1) for k in (y, x))
    weight = torch.exp(-((2 * math.pi * aperture) ** 2) * (x * x + y * y)) * often_y * often_x
    mean = ((power * weight).sum() / weight.sum()).item()
    bound = mean_eigenvalue(length, aperture, kind=kind)
    assert bound <= 1.001 * mean
    assert mean <= 3 * bound or aperture > length


def test_nodes_are_as_few_as_the_share_allows_and_none_where_there_is_no_polynomial():
    size = (1000, 1000)
    for lengths in RANGES[:2]:
        most = 1e-10 * mean_eigenvalue(lengths[0], 2.0, kind="matern32")
        nodes = nodes_needed(size, lengths, kind="matern32", aperture=2.0)
        assert nodes is not None
        assert eigenvalue_error(lengths, nodes, kind="matern32") <= most
        assert eigenvalue_error(lengths, nodes - 1, kind="matern32") > most
    assert nodes_needed(size, (5.0, 5.0), kind="exponential") == 1
    assert nodes_needed(size, (2.0, 200.0), kind="exponential") is None
    # Of the lengths that have no room some are summed round the torus.
    assert nodes_needed((300, 600), (40.0, 60.0), kind="matern32") is None
    assert nodes_needed((300, 600), (40.0, 60.0), kind="exponential") is not None
    assert nodes_needed((200, 600), (40.0, 60.0), kind="matern32") is not None


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("lengths", RANGES[:3])
def test_amplitudes_are_those_of_the_whole_spectrum(kind, lengths):
    size = torus(64, 96, length=lengths[1], kind=kind)
    modes = Modes(size, math.ceil(0.24 * size[0]), math.ceil(0.24 * size[1]))
    length, aperture = drawn(lengths, 4), torch.linspace(3, 5, 4).double()
    nodes = nodes_needed(size, lengths, kind=kind, aperture=3.0, share=1e-12)
    options = {"kind": kind, "aperture": aperture, "dtype": torch.float64}
    found = low_amplitude(modes, length, lengths=lengths, nodes=nodes, **options)
    expected = in_order(spectrum(size, length, **options).amplitude, modes)
    assert found.shape == (4, *modes.counts)
    assert ((found - expected).abs().amax(dim=(1, 2)) / expected.amax(dim=(1, 2))).max() < 1e-6
    # The deviation of the difference of the fields, of variance 1, is what the nodes were chosen for.
    assert (found - expected).square().sum(dim=(1, 2)).max() < 2e-12
    assert_close(found.square().sum(dim=(1, 2)), torch.ones(4).double(), rtol=0, atol=1e-12)


def test_amplitudes_need_no_aperture_and_no_nodes():
    modes, length = Modes((64, 60), 31, 29), torch.tensor([3.0, 5.0]).double()
    options = {"kind": "matern52", "aperture": None, "dtype": torch.float64, "lengths": (3.0, 5.0)}
    found = low_amplitude(modes, length, nodes=None, **options)
    expected = exact(modes, length, "matern52").sqrt()
    expected = in_order(expected, modes)
    assert_close(found, expected / expected.square().sum(dim=(1, 2), keepdim=True).sqrt())
    assert_close(low_amplitude(modes, length, nodes=24, **options), found, rtol=0, atol=1e-7)


@pytest.mark.parametrize("step", [1, 2, 3, 4])
def test_fields_are_those_of_the_whole_torus(step):
    height, width, size = 64, 96, MODES.size
    length, aperture = torch.tensor([20.0, 40.0]).double(), torch.tensor([4.0, 4.0]).double()
    noise = random.white_noise(keys(2), size[0] * size[1]).view(-1, 2, *size).double()
    shape = spectrum(size, length, kind="exponential", aperture=aperture, dtype=torch.float64).amplitude
    left = 1 - in_order(shape, MODES).square().sum(dim=(1, 2))
    assert left.max() < 1e-10
    whole = gaussian_random_field(noise, shape, height=size[0], width=size[1])
    rows, columns = range(-step, height + step, step), range(1 - 2 * step, width + step, step)
    found = low_field(
        mode_noise(keys(2), MODES, dtype=torch.float64),
        amplitude_of(MODES, length, aperture),
        MODES,
        rows,
        columns,
    )
    assert found.shape == (2, 2, len(rows), len(columns))
    assert found.is_contiguous()
    expected = whole[:, :, torch.tensor(rows) % size[0]][:, :, :, torch.tensor(columns) % size[1]]
    assert_close(found, expected, rtol=0, atol=1e-4)
    # What is left is of the frequencies that are left out, not of the transforms.
    products = sum_of_modes(
        mode_noise(keys(2), MODES, dtype=torch.float64) * amplitude_of(MODES, length, aperture)[:, None],
        MODES,
        rows,
        columns,
    )
    assert_close(found, products, rtol=0, atol=1e-11)


@pytest.mark.parametrize(
    "places",
    [(0, 1, 2, 4), (7,), (9, 6, 3), range(-12, 432, 8), range(0, 2000, 12), range(-431, 431, 2)],
    ids=["unequal steps", "one", "backwards", "aliases", "round the torus", "twice round"],
)
def test_fields_at_any_rows_are_those_of_two_products(places):
    noise, amplitude = example(2)
    columns = range(-3, 100, 3)
    found = low_field(noise, amplitude, MODES, places, columns)
    expected = sum_of_modes(noise * amplitude.unsqueeze(1), MODES, places, columns)
    assert_close(found, expected, rtol=0, atol=1e-11)


def test_the_sum_of_modes_of_a_product_is_the_field_of_its_factors():
    modes = Modes((24, 20), 4, 3)
    noise, down, across = (torch.randn(2, *shape).double() for shape in ((2, 9, 7), (9,), (7,)))
    found = low_field(noise, down[:, :, None] * across[:, None], modes, range(-2, 9, 2), range(5))
    assert_close(found, mode_field(noise, (down, across), modes, range(-2, 9, 2), range(5)))


def test_float32_is_as_exact_as_it_can_be():
    noise, amplitude = example(2)
    places = range(-2, 66, 2), range(-2, 98, 2)
    found = low_field(noise.float(), amplitude.float(), MODES, *places)
    assert found.dtype is torch.float32
    assert_close(found.double(), low_field(noise, amplitude, MODES, *places), rtol=0, atol=1e-5)
    length, aperture = torch.tensor([25.0]), torch.tensor([4.0])
    options = {"kind": "exponential", "lengths": (20.0, 40.0), "nodes": 17}
    single = low_amplitude(MODES, length, aperture=aperture, dtype=torch.float32, **options)
    double = low_amplitude(MODES, length, aperture=aperture, dtype=torch.float64, **options)
    assert_close(single.double(), double, rtol=3e-7, atol=1e-12)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_sample_is_the_same_in_any_batch(dtype):
    noise, places = mode_noise(keys(3), MODES, dtype=dtype), (range(-2, 66, 2), range(-3, 98, 3))
    length, aperture = torch.tensor([20.0, 33.0, 40.0]), torch.tensor([3.0, 5.0, 4.0])
    options = {"kind": "matern32", "lengths": (20.0, 40.0), "nodes": 17, "dtype": dtype}
    amplitude = low_amplitude(MODES, length, aperture=aperture, **options)
    field = low_field(noise, amplitude, MODES, *places)
    for i in range(3):
        own = low_amplitude(MODES, length[i : i + 1], aperture=aperture[i : i + 1], **options)
        assert torch.equal(own, amplitude[i : i + 1])
        assert torch.equal(low_field(noise[i : i + 1], own, MODES, *places), field[i : i + 1])
    none = low_amplitude(MODES, length[:0], aperture=aperture[:0], **options)
    assert low_field(noise[:0], none, MODES, *places).shape == (0, *field.shape[1:])


def test_fields_are_the_same_on_any_number_of_threads(on_threads):
    noise, amplitude = example(1, dtype=torch.float32)
    found = []
    for threads in (1, 2):
        on_threads(threads)
        found.append(low_field(noise, amplitude, MODES, range(-2, 66, 2), range(-2, 98, 2)))
        found.append(low_eigenvalues(MODES, drawn((20.0, 40.0), 1), kind="matern32", lengths=(20.0, 40.0), nodes=17))
    assert torch.equal(found[0], found[2])
    assert torch.equal(found[1], found[3])


@pytest.mark.parametrize("rows", [range(-2, 7, 2), range(-3, 6, 3), (0, 1, 5)])
def test_fields_have_the_gradients_of_their_values(rows):
    modes = Modes((12, 20), 2, 3)
    generator = torch.Generator().manual_seed(2)
    noise = torch.randn(2, 2, *modes.counts, dtype=torch.float64, generator=generator, requires_grad=True)
    amplitude = torch.rand(2, *modes.counts, dtype=torch.float64, generator=generator, requires_grad=True)

    def field(noise: Tensor, amplitude: Tensor) -> Tensor:
        return low_field(noise, amplitude, modes, rows, range(-4, 8, 4))

    assert torch.autograd.gradcheck(field, (noise, amplitude))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("lengths", "nodes"), [((2.0, 4.0), 22), ((3.0, 3.0), 1)])
def test_amplitudes_have_the_gradients_of_their_values(kind, lengths, nodes):
    modes = Modes((36, 40), 3, 2)
    length = torch.tensor([3.0], dtype=torch.float64, requires_grad=True)
    aperture = torch.tensor([1.5], dtype=torch.float64, requires_grad=True)
    options = {"kind": kind, "dtype": torch.float64}

    def amplitude(length: Tensor, aperture: Tensor) -> Tensor:
        return low_amplitude(modes, length, aperture=aperture, lengths=lengths, nodes=nodes, **options)

    assert torch.autograd.gradcheck(amplitude, (length, aperture))


def test_a_table_that_inference_made_serves_training():
    modes, options = Modes((80, 90), 4, 5), {"kind": "exponential", "lengths": (2.0, 4.0), "nodes": 20}
    length = torch.tensor([3.0], dtype=torch.float64)
    with torch.inference_mode():
        first = low_eigenvalues(modes, length, **options)
    second = low_eigenvalues(modes, length.requires_grad_(), **options)
    second.sum().backward()
    assert torch.equal(first.clone(), second.detach())


def test_a_graph_computes_what_eager_code_does():
    noise, places = mode_noise(keys(2), MODES, dtype=torch.float64), (range(-2, 66, 2), range(-2, 98, 2))
    length, aperture = torch.tensor([20.0, 31.0]).double(), torch.tensor([4.0, 5.0]).double()
    options = {"kind": "matern32", "lengths": (20.0, 40.0), "nodes": 18, "dtype": torch.float64}

    def field(length: Tensor) -> Tensor:
        return low_field(noise, low_amplitude(MODES, length, aperture=aperture, **options), MODES, *places)

    found = torch.compile(field, fullgraph=True, backend="aot_eager")(length)
    assert_close(found, field(length), rtol=0, atol=1e-5)


def test_tables_are_kept_up_to_a_limit_those_asked_for_last(monkeypatch):
    monkeypatch.setattr(low_modes, "_tables", {})
    monkeypatch.setattr(low_modes, "_MOST_KEPT", 3 * 6 * 5 * 5)
    modes, length = Modes((64, 64), 4, 4), torch.tensor([6.0])

    def ask(high: float) -> None:
        low_eigenvalues(modes, length, kind="exponential", lengths=(5.0, high), nodes=6)

    for high in (7.0, 8.0, 9.0, 7.0, 10.0):
        ask(high)
    assert [key[2][1] for key in low_modes._tables] == [9.0, 7.0, 10.0]
