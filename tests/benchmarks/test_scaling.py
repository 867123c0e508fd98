import json
import sys

import pytest
import scaling
import timing
from scaling import Growth, Step, slope, table

from torchrefract import LensFlare, UniformFog


@pytest.mark.parametrize("power", [0.0, 0.7, 1.0, 2.0])
def test_the_slope_is_the_power(power):
    at = [64, 256, 1024, 5000]
    assert slope(at, [0.3 * n**power for n in at]) == pytest.approx(power, abs=1e-9)


def test_one_size_has_no_slope():
    assert slope([64], [1.0]) is None


def test_what_does_not_fit_into_memory_is_skipped_and_told(monkeypatch):
    monkeypatch.setattr(timing, "_STRETCH_S", 0.0)
    steps = [Step(n * n, (1, 3, n, n), {"fog": UniformFog(), "flare": LensFlare()}) for n in (32, 64, 128)]
    # Each holds its result at least, 12 bytes a pixel, and no more than three of them.
    limit = 64 * 64 * 12 * 3.5
    found = scaling.grow("pixels", steps, limit=limit, repeats=15, threads=1)
    assert [growth.effect for growth in found] == ["fog", "flare"]
    for growth in found:
        assert growth.at == [32 * 32, 64 * 64]
        assert growth.skipped == ["16384: needs about 0.0 GiB"]
        assert f"{growth.effect} skipped at 16384: needs about 0.0 GiB" in table(found)


def test_the_table_has_a_column_for_each_size():
    one = Growth("batch", "lens", [1, 4], [2.0, 8.0], [1.0, 1.0])
    other = Growth("batch", "fog", [1], [0.5], [0.1], ["4: needs about 9.0 GiB"])
    head, first, second, skipped = table([one, other])
    assert head.split() == ["ms", "by", "batch", "1", "4", "slope"]
    assert first.split() == ["lens", "2", "8", "1.00"]
    assert second.split() == ["fog", "0.5", "-"]
    assert skipped == "fog skipped at 4: needs about 9.0 GiB"


def test_all_that_is_free_is_more_than_nothing():
    assert scaling.free_bytes() > 2**20


def test_the_command_measures_along_every_axis(monkeypatch, tmp_path, capsys, on_threads):
    on_threads(1)
    monkeypatch.setattr(timing, "_STRETCH_S", 0.0)
    small = {"SIZES": ((16, 24), (32, 48)), "BATCHES": (1, 2), "COUNTS": (1, 2), "FRAMES": (1, 3)}
    for name, values in (small | {"SIDE": 24, "COMPOSED": (24, 32)}).items():
        monkeypatch.setattr(scaling, name, values)
    monkeypatch.setattr(scaling, "effects", lambda: {"fog": UniformFog()})
    monkeypatch.setattr(scaling, "WARPS", {"mild lens": scaling.WARPS["mild lens"]})
    out = tmp_path / "new" / "scaling.json"
    monkeypatch.setattr(sys, "argv", ["scaling.py", "--threads", "1", "--memory", "2", "--out", str(out)])
    scaling.main()
    assert "At most 2.0 GiB" in capsys.readouterr().out
    growth = json.loads(out.read_text())["growth"]
    at = {along: [row["at"] for row in growth if row["along"] == along] for along in scaling.AXES}
    assert at["pixels"] == [[16 * 24, 32 * 48]] * 2
    assert at["batch"] == [[1, 2]]
    assert at["effects"] == [[1, 2]] * 2
    assert at["frames"] == [[1, 3]]
    assert all(row["slope"] == pytest.approx(slope(row["at"], row["milliseconds"])) for row in growth)
