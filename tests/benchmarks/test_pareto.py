import itertools
import random

import numpy as np
import pareto
import pytest
import torch
from matplotlib.figure import Figure
from pareto import Point, draw, front
from PIL import Image


def beats(one: tuple[float, float], other: tuple[float, float]) -> bool:
    return one[0] <= other[0] and one[1] <= other[1] and one != other


@pytest.mark.parametrize("seed", range(20))
def test_the_front_is_what_no_other_beats(seed):
    dice = random.Random(seed)
    # Whole numbers: many share a time, an error, or both.
    costs = [(dice.randint(0, 9), dice.randint(0, 9)) for _ in range(dice.randint(1, 40))]
    found = front(costs)
    assert set(found) == {i for i, own in enumerate(costs) if not any(beats(other, own) for other in costs)}
    assert [costs[i][0] for i in found] == sorted(costs[i][0] for i in found)


def test_without_choices_there_is_no_front():
    assert front([]) == []


def test_a_picture_has_a_panel_for_each_effect(tmp_path):
    points = [Point("exact", "tolerance", 10.0, 0.0, True), Point("1", "tolerance", 1.0, 2.0, True)]
    small, large = tmp_path / "new" / "one.png", tmp_path / "three.png"
    draw(small, {"lens": points}, x="time", y="error")
    draw(large, {"lens": points, "fog": points[:1], "air": points}, x="time", y="error")
    with Image.open(small) as one, Image.open(large) as three:
        assert three.height == pytest.approx(2 * one.height, rel=0.02)
        # Exact is drawn at the foot, in the color of its series, though 0 has no place on a logarithmic axis.
        lens = torch.from_numpy(np.array(three.convert("RGB")))[100:300, : three.width // 2]
    dots = (lens == torch.tensor([31, 119, 180])).all(dim=2).nonzero()[:, 0]
    assert dots.max() - dots.min() > 100


def test_labels_of_points_that_lie_together_are_apart_and_off_the_line(tmp_path, monkeypatch):
    figures = []
    monkeypatch.setattr(Figure, "savefig", lambda figure, path: (figures.append(figure), path.write_bytes(b"")))
    points = [Point(f"{0.01 * (i + 1):.2f}", "tolerance", 1 + 0.02 * (i % 3), 0.1**i, i != 2) for i in range(5)]
    points += [Point("None", "tolerance", 9.0, 1e-6, True), Point("", "itself", 1.0, 1.0, False)]
    draw(tmp_path / "one.png", {"lens": points}, x="time", y="error")
    axes = figures[0].axes[0]
    texts = [text for text in axes.texts if text.get_text()]
    assert {text.get_text() for text in texts} == {point.label for point in points} - {""}
    boxes = [text.get_window_extent() for text in texts]
    assert not any(one.overlaps(other) for one, other in itertools.combinations(boxes, 2))
    (line,) = (line for line in axes.get_lines() if line.get_linestyle() != "None" and len(line.get_xdata()) > 1)
    path = line.get_transform().transform_path(line.get_path())
    assert not any(path.intersects_bbox(box, filled=False) for box in boxes)
    near = [abs(np.array(text.get_position())).max() for text in texts]
    assert max(near) <= pareto._STEP * pareto._MOST_STEPS
