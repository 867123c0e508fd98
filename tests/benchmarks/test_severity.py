import pytest
import severity
import torch
from severity import quantity, score
from torch import Tensor

from torchrefract import LensDistortion, UniformFog, presets
from torchrefract.data.road_scenes import render_road_scenes


@pytest.fixture(scope="module")
def road() -> tuple[Tensor, Tensor]:
    """Return a frame (1, 3, H, W) and its depth."""
    return render_road_scenes(torch.tensor([3]), 180, 320)


@pytest.mark.quick
def test_an_unchanged_frame_keeps_all_and_a_gray_one_nothing(road):
    clean = road[0][0]
    assert score(clean, clean) == (1, 1)
    assert score(clean, torch.full_like(clean, 0.5)) == (0, 0)
    assert score(clean, clean).taken == 0


def test_a_lens_keeps_edges_at_their_true_place_which_its_flow_knows(road):
    lens = LensDistortion(k1_range=(-0.2, -0.2), k2_range=(0.03, 0.03), focal_range=(0.9, 0.9))
    d = lens.degrade(road[0], seed=0)
    clean, degraded, flow = road[0][0], d.image[0], d.flow[0]
    assert flow.norm(dim=0).median() > 3 * severity.NEAR_PX
    true, wrong = score(clean, degraded, flow), score(clean, degraded, -flow)
    assert true.edges > wrong.edges + 0.2
    assert true.corners > wrong.corners + 0.4


def test_thicker_fog_takes_more(road):
    image, depth = road
    taken = []
    for v in (1000.0, 200.0, 50.0):
        fog = UniformFog(visibility_range=(v, v)).degrade(image, seed=0, depth=depth)
        taken.append(score(image[0], fog.image[0]).taken)
    assert 0 < taken[0] < taken[1] - 0.05 < taken[2] - 0.1


@pytest.mark.quick
def test_the_quantity_of_a_severity_is_that_of_each_of_its_effects():
    assert quantity(presets.cape_town_fog(3)) == "60 … 200 m"
    assert quantity(presets.limpopo_sun_glare(1)) == "0.5 … 1.5 % scattered"
    assert quantity(presets.unpaved_road(3)).split("; ")[0] == "60 … 150 m"
    assert quantity(presets.unpaved_road(3)).split("; ")[2] == "25 ms"


def test_the_command_prints_a_row_for_each_severity_and_saves_a_picture(tmp_path, run_program):
    words = ["--scenes", "paper_weather", "--count", "1", "--size", "90", "160"]
    lines = run_program(severity, *words).splitlines()
    assert [line.split(" | ")[1] for line in lines[2:]] == ["1", "2", "3", "4", "5"]
    run_program(severity, *words, "--figure", tmp_path / "scenes.png")
    assert (tmp_path / "scenes.png").stat().st_size > 1000


# Level 3 of the scenes that take light; warps take less, as edges are found again where their flow says.
@pytest.mark.filterwarnings("ignore:depth is that of a road")  # scenes assume a depth; the test is of others
@pytest.mark.parametrize("name", ["cape_town_fog", "limpopo_sun_glare", "unpaved_road"])
def test_level_3_takes_a_like_share_of_real_frames(shared_data, name):
    frames = severity.frames_in(shared_data / "frames" / "train", 4, ["br_", "us_atx"])
    kept, _ = severity.measure(severity.scene_for_width(name, 3, 640), frames, [None] * len(frames))
    assert 0.35 < kept.taken < 0.65  # 0.49 to 0.58 over 24 frames
