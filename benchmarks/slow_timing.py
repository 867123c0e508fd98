"""Timing of slow candidates by few rounds, so that a benchmark takes minutes and not an hour.

A candidate is slow if its second call takes `slow_s` or more. If its first call takes `ENDLESS_S` or more, that call is
its only round.
"""

from collections.abc import Mapping, Sequence
from statistics import median

from timing import COPY, GRID_SAMPLE, Candidate, Spread, Timing, measure
from torch.utils import benchmark

SLOW_S = 0.5
ENDLESS_S = 60.0  # longer than any compilation in a first call
NUM_ROUNDS = 3


def timed(
    candidates: Mapping[str, Candidate],
    *,
    repeats: int,
    threads: int,
    held_against: Sequence[str] = (GRID_SAMPLE, COPY),
    slow_s: float = SLOW_S,
) -> tuple[list[Timing], list[str]]:
    """Time candidates: fast ones by `measure`, slow ones by few rounds.

    Args:
        candidates: functions to call, by name.
        repeats: rounds of the fast candidates.
        threads: of the fast candidates; slow ones run with the threads that torch has now, so set the same number.
        held_against: names of the references, which are always timed like fast candidates.
        slow_s: time of a second call from which a candidate is slow, s.

    Returns:
        the timings in the order of the candidates, and a note on each slow one.
    """
    references = {name: candidates[name] for name in held_against}
    trial_s = {name: _trial(call) for name, call in candidates.items()}
    fast = {name: call for name, call in candidates.items() if trial_s[name] < slow_s or name in references}
    timings = {t.name: t for t in measure(fast, references=held_against, repeats=repeats, threads=threads)}
    notes = []
    for name, call in candidates.items():
        if name in fast:
            continue
        if trial_s[name] < ENDLESS_S:
            timings[name] = time_slow(name, call, references)
            notes.append(f"{name}: median (least-most) of {NUM_ROUNDS} rounds")
        else:
            timings[name] = _timing(name, [(trial_s[name], _reference_seconds(references))])
            notes.append(f"{name}: one call")
    return [timings[name] for name in candidates], notes


def time_slow(name: str, call: Candidate, references: Mapping[str, Candidate]) -> Timing:
    """Return the median, least and most time of three rounds of one call each."""
    return _timing(name, [(seconds(call), _reference_seconds(references)) for _ in range(NUM_ROUNDS)])


def alternate(candidates: Mapping[str, Candidate], *, reference: str, rounds: int) -> list[Timing]:
    """Return the median, least and most time of rounds in which each candidate is called once, in turn.

    Args:
        candidates: functions to call, by name; each is called once before the first round.
        reference: name of the candidate to which ratios are taken.
        rounds: number of rounds.
    """
    for call in candidates.values():
        call()
    times = [{name: seconds(call) for name, call in candidates.items()} for _ in range(rounds)]
    return [_timing(name, [(row[name], {reference: row[reference]}) for row in times]) for name in candidates]


def seconds(call: Candidate, *, before: int = 0) -> float:
    """Time one call after `before` calls that are not timed, in s."""
    for _ in range(before):
        call()
    start = benchmark.timer()
    call()
    return benchmark.timer() - start


def _trial(call: Candidate) -> float:
    """Time a first call if it is endless, else a second one, which has nothing left to compile."""
    first = seconds(call)
    return first if first >= ENDLESS_S else seconds(call)


def _reference_seconds(references: Mapping[str, Candidate]) -> dict[str, float]:
    return {key: seconds(call, before=2) for key, call in references.items()}


def _timing(name: str, rounds: Sequence[tuple[float, Mapping[str, float]]]) -> Timing:
    return Timing(
        name,
        1,
        milliseconds=_spread([1e3 * time for time, _ in rounds]),
        ratios={key: _spread([time / references[key] for time, references in rounds]) for key in rounds[0][1]},
    )


def _spread(values: Sequence[float]) -> Spread:
    return Spread(median(values), min(values), max(values))
