import itertools
import json
import random

import pytest
import tradeoff
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image
from tradeoff import Variant, frame_errors, pareto_front


def variants(name: str, setting: str) -> list[Variant]:
    return [variant for variant in tradeoff.settings()[name] if variant.setting == setting]


def test_errors_stay_within_each_tolerance_and_better_interpolation_is_closer_to_splines():
    (road,) = tradeoff.read_frames(tradeoff.SYNTHETIC, (96, 128), 1)
    nearest, bilinear, bicubic = frame_errors(variants("mild lens", "interpolation"), road, 0)
    assert 0 < bicubic.mean_levels < bilinear.mean_levels < nearest.mean_levels
    errors = frame_errors(variants("mild lens", "tolerance_px"), road, 0)
    limits = (1e-3, *tradeoff.TOLERANCES_PX)  # of the exact effect in float32 first
    assert all(0 < (error.largest_px or 0) <= px for px, error in zip(limits, errors, strict=True))


@pytest.mark.quick
@pytest.mark.parametrize("seed", range(3))
def test_the_pareto_front_is_what_no_other_cost_dominates(seed):
    dice = random.Random(seed)
    costs = [(dice.randint(0, 9), dice.randint(0, 9)) for _ in range(dice.randint(0, 40))]

    def dominates(a: tuple[int, int], b: tuple[int, int]) -> bool:
        return a[0] <= b[0] and a[1] <= b[1] and a != b

    assert set(pareto_front(costs)) == {i for i, b in enumerate(costs) if not any(dominates(a, b) for a in costs)}


@pytest.mark.quick
def test_labels_overlap_neither_markers_nor_one_another():
    figure = Figure(figsize=(4, 3))
    axes = figure.subplots()
    labels = [
        axes.annotate("bilinear", (x, 0.5), (4, 4), textcoords="offset points") for x in (0.5, 0.5, 0.51, 0.55, 0.1)
    ]
    tradeoff.separate_labels(figure, labels)
    renderer = FigureCanvasAgg(figure).get_renderer()
    boxes = [label.get_window_extent(renderer) for label in labels if label.get_visible()]
    assert len(boxes) == 5
    assert not any(one.overlaps(other) for one, other in itertools.combinations(boxes, 2))
    markers = axes.transData.transform([label.xy for label in labels])
    assert not any(box.contains(*marker) for box, marker in itertools.product(boxes, markers))
    crowd = [axes.annotate("bilinear", (0.9, 0.9), (4, 4), textcoords="offset points") for _ in range(20)]
    tradeoff.separate_labels(figure, crowd)
    assert 1 < sum(label.get_visible() for label in crowd) < 20


def test_the_command_writes_a_table_and_a_plot(monkeypatch, tmp_path, run_program):
    few = {"lens": variants("mild lens", "tolerance_px")[::3], "flare": variants("flare", "tolerance")}
    monkeypatch.setattr(tradeoff, "settings", lambda: few)
    words = ["--quick", "--frames", "synthetic", "--threads", "1", "--out", tmp_path / "new"]
    assert "| flare | tolerance | None |" in run_program(tradeoff, *words)
    rows = json.loads((tmp_path / "new" / "tradeoff.json").read_text())["rows"]
    assert [row["value"] for row in rows] == ["None", "0.05", "1", "None", "0.1", "0.3", "1"]
    for cost in ("mean_levels", "ratio"):
        assert min(rows[:3], key=lambda row: row[cost])["is_pareto"]
    with Image.open(tmp_path / "new" / "tradeoff.png") as picture:
        assert picture.width > 500
