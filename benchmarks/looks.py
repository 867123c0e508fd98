"""Slow candidates: few rounds each, or a run would take an hour.

A candidate is slow if its second call still takes `SLOW_S`, or what a script sets instead, or more. One whose first
call takes `ENDLESS_S` or more is called no second time: that call is its only round.
"""

from collections.abc import Mapping, Sequence
from statistics import median

from timing import COPY, GRID_SAMPLE, Candidate, Spread, Timing, measure
from torch.utils import benchmark

SLOW_S = 0.5
ENDLESS_S = 60.0  # more than a first call takes that has kernels to compile
LOOKS = 3


def timed(
    found: Mapping[str, Candidate],
    *,
    repeats: int,
    threads: int,
    held_against: Sequence[str] = (GRID_SAMPLE, COPY),
    slow_s: float = SLOW_S,
) -> tuple[list[Timing], list[str]]:
    """What each candidate takes, in their order, the slow ones by a few looks, and a line about each of these.

    The slow ones run on the threads that torch has now: set as many as `threads`.
    """
    references = {name: found[name] for name in held_against}
    first = {name: _trial(call) for name, call in found.items()}
    quick = {name: call for name, call in found.items() if first[name] < slow_s or name in references}
    timings = {t.name: t for t in measure(quick, references=held_against, repeats=repeats, threads=threads)}
    notes = []
    for name, call in found.items():
        if name in quick:
            continue
        if first[name] < ENDLESS_S:
            timings[name] = glance(name, call, references)
            notes.append(f"{name}: median (least-most) of {LOOKS} rounds")
        else:
            timings[name] = _spread_of(name, [(first[name], _references(references))])
            notes.append(f"{name}: one call")
    return [timings[name] for name in found], notes


def glance(name: str, slow: Candidate, held_against: Mapping[str, Candidate]) -> Timing:
    """What a slow candidate takes: median, least and most of three rounds, with one call in each."""
    return _spread_of(name, [(seconds(slow), _references(held_against)) for _ in range(LOOKS)])


def alternate(found: Mapping[str, Candidate], *, reference: str, rounds: int) -> list[Timing]:
    """What very slow candidates take: median, least and most of rounds in which each is called once, in turn.

    Args:
        found: what to call, by name; each is called once before.
        reference: the one that ratios are taken to.
        rounds: how many.
    """
    for call in found.values():
        call()
    taken = [{name: seconds(call) for name, call in found.items()} for _ in range(rounds)]
    return [_spread_of(name, [(times[name], {reference: times[reference]}) for times in taken]) for name in found]


def seconds(call: Candidate, *, before: int = 0) -> float:
    """s, of one call, after so many that are not timed."""
    for _ in range(before):
        call()
    start = benchmark.timer()
    call()
    return benchmark.timer() - start


def _trial(call: Candidate) -> float:
    """s, of a first call if it seems to have no end, else of a second, which has nothing left to prepare."""
    first = seconds(call)
    return first if first >= ENDLESS_S else seconds(call)


def _references(held_against: Mapping[str, Candidate]) -> dict[str, float]:
    return {key: seconds(call, before=2) for key, call in held_against.items()}


def _spread_of(name: str, rounds: Sequence[tuple[float, Mapping[str, float]]]) -> Timing:
    return Timing(
        name,
        1,
        milliseconds=_spread([1e3 * own for own, _ in rounds]),
        ratios={key: _spread([own / others[key] for own, others in rounds]) for key in rounds[0][1]},
    )


def _spread(values: Sequence[float]) -> Spread:
    return Spread(median(values), min(values), max(values))
