"""The search for worst cases beside random search."""

import pytest
import torch
import worst_case

from torchrefract import UniformFog
from torchrefract.data.road_scenes import render_road_scenes


def test_both_searches_make_as_many_calls_on_the_same_frames():
    frames, seen = list(render_road_scenes(torch.arange(2), 27, 48)[0]), []
    target_of, loss = worst_case.MODELS["segmenter"]

    def counted(images, target):
        seen.append(images)
        return loss(images, target)

    of = worst_case.rises(UniformFog(), frames, target_of, counted, steps=3, restarts=2)
    clean, calls = 1, 3 * 2 + 1  # the last call is that of the worst case
    assert len(seen) == 2 * (clean + 2 * calls)
    assert torch.equal(seen[0][0], frames[0])
    assert torch.equal(seen[clean], seen[clean + calls])  # both begin at the same draw
    assert (of.search > 0).all()
    assert (of.random > 0).all()


def test_a_ratio_is_that_of_the_mean_rises():
    of = worst_case.Rises(worst_case.np.array([3.0, 1.0]), worst_case.np.array([1.0, 1.0]))
    assert of.ratio() == (2.0, 1.0, 3.0)


@pytest.mark.filterwarnings("default")
def test_the_command_prints_a_row_for_each_model_and_effect(run_program):
    words = ["--count", "2", "--size", "27x48", "--steps", "2", "--restarts", "1", "--effects", "UniformFog", "lens"]
    _, *rows = run_program(worst_case, *words).splitlines()
    assert [row.split()[:2] for row in rows] == [[m, e] for m in worst_case.MODELS for e in ("UniformFog", "lens")]
    assert all("bar >= 1.3 x random search" in row for row in rows)
