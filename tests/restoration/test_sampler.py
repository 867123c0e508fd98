import numpy as np
import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from torchrefract.random import stream
from torchrefract.restoration.sampler import SAMPLERS, check_steps, noise_levels, normal, sample

KEPT = np.cumprod(1 - np.linspace(1e-4, 0.02, 1000))
SHAPE = (3, 2, 5, 7)


def answer(noisy: Tensor, time: Tensor) -> Tensor:
    """A network that would be wrong, but depends on all that it is given."""
    return torch.tanh(0.4 * noisy + 0.3 - time.view(-1, 1, 1, 1) / 2000)


def draws(*keys: int):
    return stream(7, torch.tensor(keys))


def run(name: str, steps: int, *keys: int, start: Tensor | None = None) -> Tensor:
    source = draws(*keys)
    start = normal(source.at(0), torch.empty(len(keys), *SHAPE[1:])) if start is None else start
    return sample(start, answer, source.at(1), name=name, steps=steps)


def along_the_mean(start: np.ndarray, steps: int) -> np.ndarray:
    """DDIM without noise, from level to level: Song, Meng, Ermon 2021, equation 12 with sigma = 0."""
    noisy = start.astype(np.float64)
    times = [1000 * (steps - i) // steps - 1 for i in range(steps)]
    for time, after in zip(times, [*times[1:], None], strict=True):
        kept, kept_after = KEPT[time], 1.0 if after is None else KEPT[after]
        found = np.tanh(0.4 * noisy + 0.3 - time / 2000)
        noise = (noisy - np.sqrt(kept) * found) / np.sqrt(1 - kept)
        noisy = np.sqrt(kept_after) * found + np.sqrt(1 - kept_after) * noise
    return noisy


def test_the_levels_are_those_of_variances_that_grow_linearly():
    assert_close(noise_levels().alphas_cumprod.double(), torch.from_numpy(KEPT), rtol=1e-4, atol=0)


@pytest.mark.parametrize("steps", [1, 2, 3, 7, 50, 300])
def test_ddim_follows_its_formula_for_numbers_of_steps_that_divide_and_those_that_do_not(steps):
    start = torch.randn(SHAPE, generator=torch.Generator().manual_seed(steps))
    found = run("ddim", steps, 1, 2, 3, start=start)
    assert_close(found.double(), torch.from_numpy(along_the_mean(start.numpy(), steps)), rtol=0, atol=2e-4)


def test_more_steps_of_the_solver_end_nearer_to_where_very_many_do_and_sooner_than_those_of_ddim():
    start = torch.randn(SHAPE, generator=torch.Generator().manual_seed(0))
    goal = torch.from_numpy(along_the_mean(start.numpy(), 1000)).float()
    error = {
        (name, steps): float((run(name, steps, 1, 2, 3, start=start) - goal).abs().max())
        for name in ("ddim", "dpm_solver")
        for steps in (10, 100)
    }
    assert error["ddim", 100] < error["ddim", 10] / 2
    assert error["dpm_solver", 100] < error["dpm_solver", 10] / 2
    assert error["dpm_solver", 100] < error["ddim", 100]


def test_ddpm_ends_at_the_target_that_the_network_always_finds():
    # Whatever was drawn, the last step takes all noise away.
    target = torch.full(SHAPE, 0.25)
    found = sample(torch.randn(SHAPE), lambda noisy, time: target, draws(1, 2, 3), name="ddpm", steps=20)
    assert_close(found, target, rtol=0, atol=1e-6)


def test_ddpm_has_the_spread_of_its_posterior():
    # One step from the first of two levels: its mean and variance by Ho et al. 2020, equations 6 and 7, and then a
    # network that hands on what it gets, so that the spread is seen.
    seen = []

    def estimate(noisy: Tensor, time: Tensor) -> Tensor:
        seen.append(noisy)
        return torch.zeros_like(noisy)

    start = torch.ones(1, 1, 200, 200)
    sample(start, estimate, draws(4), name="ddpm", steps=2)
    kept, after = KEPT[999], KEPT[499]
    step = kept / after
    mean = np.sqrt(step) * (1 - after) / (1 - kept)
    variance = (1 - after) / (1 - kept) * (1 - step)
    assert float(seen[1].mean()) == pytest.approx(mean, abs=4 * np.sqrt(variance) / 200)
    assert float(seen[1].var()) == pytest.approx(variance, rel=0.04)


@pytest.mark.parametrize("name", SAMPLERS)
def test_a_sample_depends_on_its_key_alone(name):
    together = run(name, 6, 11, 12, 13)
    assert torch.equal(run(name, 6, 11, 12, 13), together)
    for i, key in enumerate((11, 12, 13)):
        assert torch.equal(run(name, 6, key), together[i : i + 1])
    assert not torch.equal(together[0], together[1])


def test_the_noise_is_standard_normal_and_that_of_the_key():
    noise = normal(draws(1, 2), torch.empty(2, 3, 101, 99))
    assert torch.equal(normal(draws(2), torch.empty(1, 3, 101, 99)), noise[1:])
    for each in noise.flatten(1):
        assert float(each.mean()) == pytest.approx(0, abs=4 / len(each) ** 0.5)
        assert float(each.std()) == pytest.approx(1, abs=0.02)
    pair = torch.stack([noise[0].flatten(), noise[1].flatten()])
    assert abs(float(torch.corrcoef(pair)[0, 1])) < 4 / noise[0].numel() ** 0.5


@pytest.mark.parametrize(
    ("steps", "error", "message"),
    [
        (0, ValueError, "val_steps must be at least 1, got 0"),
        (1001, ValueError, "val_steps must be at most the 1000 levels of noise of the training, got 1001"),
        (2.5, TypeError, "val_steps must be a whole number, got 2.5"),
    ],
)
def test_a_number_of_steps_that_no_sampler_can_take_is_named(steps, error, message):
    with pytest.raises(error, match=message):
        check_steps("val_steps", steps)


def test_a_sampler_that_is_not_known_is_told_with_those_that_are():
    with pytest.raises(ValueError, match="sampler must be one of ddpm, ddim, dpm_solver, got 'euler'"):
        run("euler", 5, 1)
