import importlib
import json
import sys
from types import ModuleType

import peer_fields
import peer_warps
import peers
import pytest
import timing
import torch
from timing import Spread, Timing
from torch.testing import assert_close

SIZE = (168, 200)


@pytest.fixture
def ramps():
    """A frame (1, 3, H, W) whose channels tell where a pixel came from: x and y in px, and a constant."""
    height, width = SIZE
    y, x = torch.meshgrid(torch.arange(height).float(), torch.arange(width).float(), indexing="ij")
    return torch.stack([x, y, torch.ones_like(x)])[None]


@pytest.fixture
def installed(monkeypatch):
    """Makes peers present or missing, whatever is installed."""

    def only(*names: str) -> dict[str, ModuleType]:
        found = {name: ModuleType(name) for name in names}

        def import_module(name: str) -> ModuleType:
            if name in found:
                return found[name]
            raise ModuleNotFoundError(f"No module named {name!r}")

        monkeypatch.setattr(importlib, "import_module", import_module)
        return found

    monkeypatch.setenv("NO_ALBUMENTATIONS_UPDATE", "1")
    return only


def timed(name: str, ratio: float) -> Timing:
    return Timing(name, 1, Spread(ratio, ratio, ratio), {timing.GRID_SAMPLE: Spread(ratio, ratio, ratio)})


def test_a_peer_that_is_not_installed_is_told_with_what_installs_it(installed):
    modules = installed("kornia", "cv2")
    found, missing = peers.find_peers()
    assert found == {"cv2": modules["cv2"], "kornia": modules["kornia"]}
    assert [line.split()[0] for line in missing] == ["torchvision", "torch_tps", "gstools", "albumentations"]
    assert missing[0] == (
        "torchvision is left out (No module named 'torchvision'); to have it: pip install torchvision"
    )
    assert "--no-deps albumentations" in missing[-1]


def test_albumentations_is_not_let_on_the_network(installed, monkeypatch):
    monkeypatch.delenv("NO_ALBUMENTATIONS_UPDATE")
    installed()
    peers.find_peers()
    assert peers.os.environ["NO_ALBUMENTATIONS_UPDATE"] == "1"


def test_without_peers_ours_remain(ramps):
    names = list(peers.candidates(ramps, {}))
    assert names[:2] == [timing.GRID_SAMPLE, timing.COPY]
    assert {name.split(": ")[0] for name in names[2:]} == set(peers.JOBS)
    assert all(": ours " in name for name in names[2:])


def test_candidates_come_by_job_and_keep_the_size_of_the_frame(monkeypatch):
    monkeypatch.setattr(peer_fields, "MODES", 10)
    monkeypatch.setenv("NO_ALBUMENTATIONS_UPDATE", "1")
    height, width = 88, 96
    found, _ = peers.find_peers()
    candidates = peers.candidates(torch.rand(1, 3, height, width), found)
    jobs = [name.split(": ")[0] for name in list(candidates)[2:]]
    assert jobs == sorted(jobs, key=peers.JOBS.index)
    for name, call in candidates.items():
        image = torch.as_tensor(call())
        assert tuple(image.shape) in {(1, 3, height, width), (height, width, 3)}, name


@pytest.fixture
def wide(ramps):
    """The same frame (1, 3, H, W) as HxWx3 of float32, which OpenCV looks up without rounding."""
    return ramps[0].movedim(0, -1).contiguous().numpy()


@pytest.mark.parametrize(("peer", "draws"), [("kornia", 8), ("torchvision", 2)])
def test_the_fields_of_the_peers_move_about_a_pixel(ramps, peer, draws):
    pytest.importorskip(peer, reason="a peer that is not installed cannot be held against ours")
    torch.manual_seed(0)
    own = {"kornia": peer_fields._kornia, "torchvision": peer_fields._torchvision}[peer]
    (call,) = own(ramps).values()
    inner = (..., slice(70, -70), slice(70, -70))  # away from what lies outside
    moved = torch.stack([(torch.as_tensor(call()) - ramps)[inner][0, :2] for _ in range(draws)])
    # A draw shows a handful of independent displacements, which is why this is no sharper.
    assert 0.5 < moved.square().mean().sqrt() < 1.6


def test_the_fields_of_the_paper_have_a_deviation_of_a_pixel_over_the_frame(wide, monkeypatch):
    gstools, cv2 = (pytest.importorskip(name, reason="the stack of the paper") for name in ("gstools", "cv2"))
    monkeypatch.setattr(peer_fields, "MODES", 50)
    (call,) = peer_fields._paper(gstools, cv2, wide).values()
    first, second = (torch.from_numpy(call() - wide)[4:-4, 4:-4, :2] for _ in range(2))
    # The frame's own edge is left out here and not in what they divide by.
    assert_close(first.std(dim=(0, 1)), torch.ones(2), atol=0.1, rtol=0)
    assert (first - second).abs().max() > 1  # a new draw in each call


def test_the_spline_of_torch_tps_is_the_one_through_its_points(ramps):
    package = pytest.importorskip("torch_tps", reason="a peer that is not installed cannot be held against ours")
    torch.manual_seed(0)
    (call,) = peer_warps._torch_tps(package, ramps).values()
    moved = (torch.as_tensor(call()) - ramps)[0, :2]
    torch.manual_seed(0)
    told = peer_warps.SPLINE_PX * torch.randn(16, 2)
    # Of the lattice of 4 x 4 points, x first, the four inner ones whose look-up stays in the frame.
    at = [(column, row) for column in (1, 2) for row in (1, 2)]
    height, width = SIZE
    for column, row in at:
        x, y = column * (width - 1) / 3, row * (height - 1) / 3
        near = moved[:, round(y), round(x)]
        assert_close(near, told[4 * column + row], atol=0.5, rtol=0)  # a point lies between pixels


def test_lenses_in_closed_form_do_what_the_peers_do(ramps, wide):
    pytest.importorskip("kornia", reason="kornia is in the extra train")
    cv2 = pytest.importorskip("cv2", reason="OpenCV is in the extra calibration")
    ours = torch.as_tensor(peer_warps._ours(ramps, wide)["lens: ours closed form"]())
    kornia = torch.as_tensor(peer_warps._kornia(ramps)["lens: kornia undistort_image"]())
    (call,) = peer_warps._opencv(cv2, wide).values()
    opencv = torch.as_tensor(call()).movedim(-1, 0)[None]
    inner = (..., slice(20, -20), slice(20, -20))
    assert (ours - ramps)[inner].abs().max() > 1
    assert_close(ours[inner], kornia[inner], atol=2e-3, rtol=0)
    assert_close(ours[inner], opencv[inner], atol=2e-3, rtol=0)


def test_each_of_ours_is_told_beside_the_peers_at_the_same_job():
    ratios = {"lens: ours A": 8.0, "lens: kornia B": 9.0, "lens: OpenCV C": 0.7, "fog: ours D": 0.3, "fog: E": 38.0}
    lens, fog = peers.standings([timed(name, ratio) for name, ratio in ratios.items()])
    assert lens == "lens: ours A 8 x; faster: OpenCV C 0.7 x; slower: kornia B 9 x"
    assert fog == "fog: ours D 0.3 x; faster: none; slower: E 38 x"


def test_the_command_measures_what_is_there(monkeypatch, tmp_path, capsys, on_threads):
    on_threads(1)
    monkeypatch.setattr(timing, "_STRETCH_S", 0.0)
    monkeypatch.setattr(peers, "find_peers", lambda: ({}, ["kornia is left out"]))
    out = tmp_path / "peers.json"
    monkeypatch.setattr(sys, "argv", ["peers.py", "--size", "24x40", "--threads", "1", "--out", str(out)])
    peers.main()
    printed = capsys.readouterr().out
    assert "kornia is left out" in printed
    assert "fog: ours UniformFog" in printed
    names = [row["name"] for row in json.loads(out.read_text())["timings"]]
    assert "spline: ours ThinPlateSpline, exact" in names
