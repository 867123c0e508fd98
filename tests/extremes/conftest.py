import pytest
from hypothesis import HealthCheck, Phase, settings

from torchrefract.fields import random_field


def pytest_configure(config) -> None:
    """Use the same hypothesis examples in every run, and more of them with `--extremes=full`."""
    settings.register_profile(
        "extremes",
        derandomize=True,
        deadline=None,
        max_examples=2000 if config.getoption("extremes") == "full" else 40,
        phases=(Phase.explicit, Phase.generate, Phase.shrink),
        suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large, HealthCheck.function_scoped_fixture],
    )
    settings.load_profile("extremes")


@pytest.fixture
def small_domains(full_extremes, monkeypatch) -> None:
    """Lower the largest domain of random fields, since the longest correlations would take seconds each.

    `test_the_longest_correlations_take_the_largest_domain` uses the real limit with `--extremes=full`.
    """
    monkeypatch.setattr(random_field, "_MAX_POINTS", 1 << (18 if full_extremes else 12))
