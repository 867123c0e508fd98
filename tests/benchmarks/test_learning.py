import json

import learning
import pytest

pytestmark = pytest.mark.filterwarnings(  # of Lightning: a training of seconds without workers, its own code
    "ignore:.*does not have many workers", "ignore:.*LeafSpec", "ignore:.*logging"
)


def test_models_are_trained_for_the_same_seconds_and_only_once(tmp_path, monkeypatch, capsys):
    words = ["learning.py", "--models", "ddpm", "lens_net", "--seconds", "1", "--size", "32x56", "--scenes", "16"]
    monkeypatch.setattr("sys.argv", [*words, "--val", "2", "--out", str(tmp_path)])
    learning.main()
    first = capsys.readouterr().out
    names = ["ddpm", "lens_net"]
    curves = {name: json.loads((tmp_path / f"{name}_32x56_16_2_1s.json").read_text()) for name in names}
    for points in curves.values():
        assert [p["seconds"] for p in points] == sorted(p["seconds"] for p in points)
        assert [p["steps"] for p in points] == [(i + 1) * points[0]["steps"] for i in range(6)]
        assert points[-1]["seconds"] == pytest.approx(1, rel=0.8)
        assert points[-1]["val/epe_identity"] == curves["ddpm"][0]["val/epe_identity"]
    assert 0 <= curves["ddpm"][-1]["val/coverage"] <= 1
    assert "val/coverage" not in curves["lens_net"][-1]
    assert (tmp_path / "curves.png").stat().st_size > 0
    learning.main()
    assert first.endswith(again := capsys.readouterr().out)
    assert again.count("|\n") == 2 + len(names)  # the table alone
