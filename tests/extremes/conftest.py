import pytest
from hypothesis import HealthCheck, Phase, settings

from torchrefract.fields import torus


def pytest_configure(config) -> None:
    """The same examples in every run, few of them unless all are asked for."""
    examples = 2000 if config.getoption("extremes") == "full" else 60
    # An effect of a wild size may be slow, and its data many; no fixture here changes from case to case.
    slow = [HealthCheck.too_slow, HealthCheck.data_too_large, HealthCheck.function_scoped_fixture]
    settings.register_profile(
        "extremes",
        derandomize=True,
        deadline=None,
        max_examples=examples,
        phases=(Phase.explicit, Phase.generate, Phase.shrink),
        suppress_health_check=slow,
    )
    settings.load_profile("extremes")


@pytest.fixture
def small_tori(full_extremes, monkeypatch) -> None:
    """The longest correlations would take seconds each: a smaller cap asks the same questions.

    The cap that users have is tried by `test_the_longest_correlations_take_the_largest_torus`.
    """
    monkeypatch.setattr(torus, "_MOST_POINTS", 1 << (18 if full_extremes else 12))
