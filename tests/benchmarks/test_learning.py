import json

import learning
import pytest

pytestmark = pytest.mark.filterwarnings(  # of Lightning: a training of seconds without workers, its own code
    "ignore:.*does not have many workers", "ignore:.*LeafSpec", "ignore:.*logging"
)


@pytest.mark.parametrize(
    ("task", "names", "seconds"), [("undistort", ["ddpm", "lens_net"], 1), ("deweather", ["fog_net"], 3)]
)
def test_models_are_trained_for_the_same_seconds_and_only_once(tmp_path, run_program, task, names, seconds):
    words = ["--task", task, "--models", *names, "--seconds", seconds, "--size", "32x56", "--scenes", "16"]
    first = run_program(learning, *words, "--val", "2", "--out", tmp_path)
    curves = {name: json.loads((tmp_path / f"{name}_{task}_32x56_16_2_{seconds}s.json").read_text()) for name in names}
    score = learning.KINDS[task].score
    for points in curves.values():
        assert [p["seconds"] for p in points] == sorted(p["seconds"] for p in points)
        assert [p["steps"] for p in points] == [(i + 1) * points[0]["steps"] for i in range(6)]
        assert points[-1]["seconds"] == pytest.approx(seconds, rel=0.8)
        assert points[-1][f"val/{score}_identity"] == curves[names[0]][0][f"val/{score}_identity"]
    assert {name for name in names if 0 <= curves[name][-1].get("val/coverage", -1) <= 1} == {"ddpm"} & {*names}
    assert (tmp_path / f"{task}.png").stat().st_size > 0
    assert first.endswith(again := run_program(learning, *words, "--val", "2", "--out", tmp_path))
    assert again.count("|\n") == 2 + len(names)  # the table alone
