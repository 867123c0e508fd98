import importlib

import peers
import pytest
import torch
from timing import GRID_SAMPLE, Spread, Timing

SIZE = (168, 200)
INNER = (..., slice(20, -20), slice(20, -20))


def test_a_missing_package_is_reported_with_its_installation(monkeypatch):
    def import_module(name: str):
        raise ModuleNotFoundError(f"No module named {name!r}")

    monkeypatch.setattr(importlib, "import_module", import_module)
    monkeypatch.delenv("NO_ALBUMENTATIONS_UPDATE", raising=False)
    packages, missing = peers.find_packages()
    assert packages == {}
    assert [line.split()[0] for line in missing] == ["cv2", "kornia", "albumentations"]
    assert "pip install kornia" in missing[1]
    assert peers.os.environ["NO_ALBUMENTATIONS_UPDATE"] == "1"  # it would ask the network otherwise


def test_candidates_are_sorted_by_task_and_keep_the_size_of_the_frame(monkeypatch):
    monkeypatch.setenv("NO_ALBUMENTATIONS_UPDATE", "1")
    height, width = 88, 96
    packages, _ = peers.find_packages()
    candidates = peers.candidates(torch.rand(1, 3, height, width), packages)
    tasks = [name.split(": ")[0] for name in list(candidates)[2:]]
    assert tasks == sorted(tasks, key=peers.TASKS.index)
    assert set(tasks) == set(peers.TASKS)
    for name, call in candidates.items():
        assert tuple(torch.as_tensor(call()).shape) in {(1, 3, height, width), (height, width, 3)}, name


@pytest.mark.quick
def test_standings_list_the_other_packages_of_each_task():
    ratios = {"lens: torchrefract A": 8.0, "lens: kornia B": 9.0, "lens: OpenCV C": 0.7, "fog: torchrefract D": 0.3}
    timings = [Timing(n, 1, Spread(r, r, r), {GRID_SAMPLE: Spread(r, r, r)}) for n, r in ratios.items()]
    lens, fog = peers.standings(timings)
    assert lens == "lens: torchrefract A 8 x; faster: OpenCV C 0.7 x; slower: kornia B 9 x"
    assert fog == "fog: torchrefract D 0.3 x; faster: none; slower: none"
