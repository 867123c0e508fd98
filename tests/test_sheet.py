import math
import re
from typing import Any

import matplotlib.image
import numpy as np
import pytest
import torch
from matplotlib.figure import Figure
from torch import Tensor
from torch.testing import assert_close

import torchrefract as tr
from torchrefract.visualization.figures import resize_for_display
from torchrefract.visualization.figures import Scale, SheetRow, drawn, make_row, sheet
from torchrefract.visualization.color import checkerboard, flow_to_rgb, flow_wheel, transmission_to_rgb
from torchrefract.warping.flow import folded

SIZE = (32, 40)  # drawn with 8 x 8 px for each
SWIRL = tr.DivergenceFree(amplitude_range=(1.0, 1.0), length_range=(12.0, 12.0))
FOLDING = tr.DivergenceFree(amplitude_range=(4.0, 4.0), length_range=(8.0, 8.0))
FOG = tr.UniformFog(visibility_range=(100.0, 100.0))
SUN = tr.LensFlare(strength_range=(0.5, 0.5))


@pytest.fixture
def frame() -> Tensor:
    return torch.rand(1, 3, *SIZE, generator=torch.Generator().manual_seed(0))


def enlarged(value: Tensor) -> Tensor:
    """(C, 32, 40) or (32, 40) as drawn."""
    return torch.repeat_interleave(torch.repeat_interleave(value, 8, dim=-1), 8, dim=-2)


def number(pattern: str, text: str) -> float:
    found = re.search(pattern, text)
    assert found is not None, text
    return float(found[1])


def psnr(image: Tensor, frame: Tensor, valid: Tensor) -> float:
    """By its definition, on the pixels that count."""
    difference = (image.clamp(0, 1) - frame)[valid.expand_as(frame)]
    return 10 * math.log10(1 / difference.square().mean().item())


def texts(figure: Figure) -> list[str]:
    return [text.get_text() for text in figure.texts]


def pictures(figure: Figure) -> list[Tensor]:
    """What is drawn, each (3, h, w) in whole numbers up to 255."""
    return [torch.from_numpy(np.asarray(axes.images[0].get_array())).movedim(-1, 0) for axes in figure.axes]


def test_each_column_holds_what_the_effect_makes_of_the_frame(frame):
    row = make_row("swirl", SWIRL, frame=frame, seed=5)
    d = SWIRL.degrade(frame, seed=5)
    assert_close(row.frame, enlarged(frame[0]))
    assert_close(row.corrupted, enlarged(d.image[0]))
    assert (d.image - frame).abs().max() > 0.1
    valid, back = enlarged(d.valid[0, 0]), enlarged(d.restore_valid[0, 0])
    assert 0.5 < back.float().mean() < 1
    board = SWIRL.apply(checkerboard(*SIZE, cell=2), d.params).image
    assert_close(row.checkerboard[:, valid], enlarged(board[0])[:, valid])
    assert row.map is not None
    assert_close(row.map[:, valid], enlarged(flow_to_rgb(d.flow, max_px=row.scales[0].top)[0])[:, valid])
    restored = tr.warp(d.image, d.restore_flow, interpolation="bicubic")[0].clamp(0, 1)
    assert row.restored is not None
    assert_close(row.restored[:, back], enlarged(restored[0])[:, back])
    for picture, kept in ((row.checkerboard, valid), (row.map, valid), (row.restored, back)):
        assert_close(picture[:, ~kept].unique(), torch.tensor([0.62, 0.86]))


def test_folded_pixels_are_marked_exactly_where_the_flow_folds(frame):
    row = make_row("folding", FOLDING, frame=frame, seed=0)
    d = FOLDING.degrade(frame, seed=0)
    folds = folded(d.flow, d.valid)
    assert not folds[~d.valid].any()
    assert 0.03 < folds.float().mean() < 0.5
    board = enlarged(FOLDING.apply(checkerboard(*SIZE, cell=2), d.params).image[0])
    there, valid = enlarged(folds[0, 0]), enlarged(d.valid[0, 0])
    magenta = torch.tensor([1.0, 0.0, 1.0])[:, None]
    assert_close(row.checkerboard[:, there], 0.25 * board[:, there] + 0.75 * magenta)
    assert_close(row.checkerboard[:, valid & ~there], board[:, valid & ~there])
    assert number(r"([\d.]+)% folded", row.scores) == pytest.approx(100 * d.folding.fraction.item(), rel=0.05)
    assert "folded" not in make_row("swirl", SWIRL, frame=frame, seed=5).scores


def test_scores_are_those_of_the_pixels_that_can_be_restored(frame):
    row = make_row("swirl", SWIRL, frame=frame, seed=5)
    d = SWIRL.degrade(frame, seed=5)
    restored = tr.warp(d.image, d.restore_flow, interpolation="bicubic")[0]
    longest = d.flow.norm(dim=1)[d.valid[:, 0]].max().item()
    assert number(r"longest displacement ([\d.]+) px", row.scores) == pytest.approx(longest, rel=0.005)
    assert longest <= row.scales[0].top <= 1.1 * longest
    share = d.restore_valid.float().mean().item()
    assert number(r"([\d.]+)% valid", row.scores) == pytest.approx(100 * share, abs=0.051)
    for name, image in (("corrupted", d.image), ("restored", restored)):
        found = number(rf"([\d.]+) dB {name}", row.scores)
        assert found == pytest.approx(psnr(image, frame, d.restore_valid), abs=0.051)


def test_fog_has_a_map_of_its_transmission_and_is_removed_from_8_bits(frame):
    depth = torch.full((1, 1, *SIZE), 50.0)
    depth[..., 20:] = math.inf
    row = make_row("fog", FOG, frame=frame, seed=1, depth=depth)
    d = FOG.degrade(frame, seed=1, depth=depth)
    assert row.scales == (Scale("transmission", 1.0),)
    near = enlarged(d.valid[0, 0])
    assert near.float().mean() == 0.5
    board = FOG.apply(checkerboard(*SIZE, cell=2), d.params, depth=depth).image
    assert_close(row.checkerboard[:, near], enlarged(board[0])[:, near])
    assert row.map is not None
    assert_close(row.map, enlarged(transmission_to_rgb(d.transmission)[0]))
    airlight = d.params.airlight.view(1, 3, 1, 1)
    removed = airlight + ((255 * d.image).round() / 255 - airlight) / d.transmission
    assert row.restored is not None
    assert_close(row.restored[:, near], enlarged(removed[0].clamp(0, 1))[:, near])
    for picture in (row.checkerboard, row.restored):
        assert_close(picture[:, ~near].unique(), torch.tensor([0.62, 0.86]))
    before, after = psnr(d.image, frame, d.valid), psnr(removed, frame, d.valid)
    assert after > before + 10
    assert row.scores == f"50.0% valid; {before:.1f} dB corrupted, {after:.1f} dB restored from 8 bits"
    shown = texts(sheet([row], title="fog"))
    assert {"0", "1 transmission"} < set(shown)
    assert not any("full color" in text or "undo" in text for text in shown)


def test_fog_in_linear_light_is_removed_in_it(frame):
    fog = tr.UniformFog(visibility_range=(300.0, 300.0), linear_light=True)
    d = fog.degrade(frame, seed=1)
    stored = (255 * d.image).round() / 255
    removed, valid = tr.remove_fog(stored, d.transmission, d.params.airlight, linear_light=True)
    assert f"{psnr(removed, frame, valid):.1f} dB restored" in make_row("fog", fog, frame=frame, seed=1).scores


def test_fog_in_drifts_shows_its_extinction_beside_its_transmission(frame):
    fog = tr.HeterogeneousFog(visibility_range=(100.0, 100.0))
    row = make_row("drifts", fog, frame=frame, seed=1)
    d = fog.degrade(frame, seed=1)
    top = row.scales[1].top
    assert row.scales == (Scale("transmission", 1.0), Scale("extinction", top))
    assert d.extinction.max() <= top <= 1.1 * d.extinction.max()
    left, right = (transmission_to_rgb(light)[0] for light in (d.transmission, d.extinction / top))
    assert row.map is not None
    assert_close(row.map, enlarged(torch.cat([left[..., :20], right[..., 20:]], dim=-1)))
    assert {"1 transmission (left)", f"{top:g}/m extinction (right)"} < set(texts(sheet([row], title="drifts")))


def test_a_flare_has_a_map_of_its_intensity_with_its_own_scale_and_nothing_to_undo(frame):
    row = make_row("sun", SUN, frame=frame, seed=1)
    d = SUN.degrade(frame, seed=1)
    (scale,) = row.scales
    assert (scale.name, row.restored) == ("intensity", None)
    assert d.intensity.max() <= scale.top <= 1.1 * d.intensity.max()
    assert not d.valid.all()
    assert row.map is not None
    assert_close(row.map, enlarged(transmission_to_rgb(d.intensity / scale.top)[0]))
    assert row.scores == f"{d.valid.float().mean():.1%} valid; {psnr(d.image, frame, d.valid):.1f} dB corrupted"
    assert {"no flow to undo", f"{scale.top:g} intensity"} < set(texts(sheet([row], title="sun")))


@pytest.mark.parametrize("seed", range(6))
def test_of_several_lights_the_one_that_was_drawn_is_mapped(frame, seed):
    effect = tr.OneOf([FOG, SUN])
    fog, sun = (child.applied.item() for child in effect.degrade(frame, seed=seed).params.children)
    assert fog != sun
    row = make_row("one", effect, frame=frame, seed=seed)
    assert [scale.name for scale in row.scales] == ["transmission" if fog else "intensity"]
    assert row.restored is None


def test_what_is_left_alone_is_told_so(frame):
    row = make_row("fog", tr.UniformFog(p=0.0), frame=frame, seed=0)
    assert row.title == "fog: left alone"
    assert torch.equal(row.corrupted, row.frame)
    assert row.scales == (Scale("transmission", 1.0),)


def test_fog_behind_a_lens_says_that_the_light_stays(frame):
    effect = tr.Compose([FOG, tr.LensDistortion()])
    row = make_row("both", effect, frame=frame, seed=1)
    assert [scale.name for scale in row.scales] == ["flow"]
    assert "dB restored, the light left as it is" in row.scores
    assert "light" not in make_row("lens", tr.LensDistortion(), frame=frame, seed=1).scores


class Away(tr.ThinPlateSpline):
    """A plate that leaves the frame."""

    def draw(self, source, image):
        params = super().draw(source, image)
        return params._replace(displacement=torch.full_like(params.displacement, 400.0))


def test_an_effect_that_leaves_nothing_to_restore_has_no_score(frame):
    row = make_row("away", Away(), frame=frame, seed=0)
    assert row.scores == "longest displacement 0 px; 0.0% valid"


def test_what_was_drawn_is_said_with_its_units(frame):
    lens = tr.LensDistortion(k1_range=(-0.25, -0.25), k2_range=(0.0, 0.0), p1_range=(0, 0), focal_range=(0.8, 0.8))
    params = lens.sample(frame, seed=0)
    params = params._replace(center=torch.zeros_like(params.center))
    words = drawn(lens, params._replace(coefficients=params.coefficients * (params.coefficients.abs() > 0.01)))
    assert words == "k1 -0.25, focal length 0.80 widths"
    still: dict[str, Any] = {"wind_x_range": (0.0, 0.0), "wind_y_range": (0.0, 0.0)}
    air = tr.Turbulence(amplitude_range=(2.3, 2.3), length_range=(31.0, 31.0), aperture_range=(0.0, 0.0), **still)
    assert drawn(air, air.sample(frame, seed=0)) == "amplitude 2.3 px, length 31 px"
    air = tr.Turbulence(amplitude_range=(2.3, 2.3), length_range=(31.0, 31.0), wind_x_range=(1.5, 1.5))
    assert "wind (1.5, " in drawn(air, air.sample(frame, seed=0))
    plate = tr.ThinPlateSpline(lattice=(2, 3))
    params = plate.sample(frame, seed=0)
    moved = params._replace(displacement=torch.full_like(params.displacement, -2.0))
    assert drawn(plate, moved) == "6 points moved by 2 px rms in x and y"


def test_one_name_is_said_by_what_it_means(frame):
    sun = tr.LensFlare(center_x_range=(0.25, 0.25), center_y_range=(0.5, 0.5), radius_range=(0.3, 0.3))
    words = "sun at 0.25 widths, 0.50 heights, radius 0.3 diagonals, strength 0."
    assert drawn(sun, sun.sample(frame, seed=0)).startswith(words)
    lens = tr.LensDistortion(k1_range=(-0.2, -0.2), center_x_range=(0.02, 0.02), center_y_range=(-0.01, -0.01))
    assert drawn(lens, lens.sample(frame, seed=0)).endswith("center off by (0.02, -0.01) widths")
    numbers: dict[str, Any] = {
        "visibility_range": (90.0, 90.0),
        "contrast_range": (0.5, 0.5),
        "wind_x_range": (0.3, 0.3),
    }
    plane, space = tr.HeterogeneousFog(**numbers), tr.HeterogeneousFog(mode="ray", wind_z_range=(-1, -1), **numbers)
    assert drawn(plane, plane.sample(frame, seed=0)) == "visibility 90 m, wind (0.3, 0) px/frame"
    assert drawn(space, space.sample(frame, seed=0)) == "visibility 90 m, contrast 0.5, wind (0.3, 0, -1) m/frame"


def test_effects_that_leave_a_frame_alone_say_so(frame):
    absent = tr.UniformFog(p=0.0)
    assert drawn(absent, absent.sample(frame, seed=0)) == "left alone"
    both = tr.Compose([absent, FOG])
    assert drawn(both, both.sample(frame, seed=0)) == "UniformFog (visibility 100 m)"
    none = tr.Compose([FOG], p=0.0)
    assert drawn(none, none.sample(frame, seed=0)) == "left alone"


def test_a_sheet_shows_its_rows_in_order_each_with_its_own_scale(frame):
    rows = [make_row(name, effect, frame=frame, seed=5) for name, effect in (("a", SWIRL), ("b", FOLDING))]
    figure = sheet(rows, title="frame.png, 40 x 32 px")
    shown = texts(figure)
    assert shown[0] == "frame.png, 40 x 32 px"
    assert shown[1:6] == ["frame", "corrupted", "checkerboard", "map", "restored"]
    assert [text for text in shown if text.startswith("UV: full color")] == [
        f"UV: full color = {row.scales[0].top:g} px" for row in rows
    ]
    assert rows[0].scales != rows[1].scales
    drawn_there = pictures(figure)
    for i, row in enumerate(rows):
        cells = (row.frame, row.corrupted, row.checkerboard, row.map, row.restored)
        for picture, cell in zip(drawn_there[6 * i :], cells, strict=False):
            assert cell is not None
            assert torch.equal(picture, (255 * cell).round().byte())
        wheel = drawn_there[6 * i + 5]
        assert torch.equal(wheel, (255 * flow_wheel(wheel.shape[1])).round().byte())


@pytest.mark.parametrize(("side", "drawn_side"), [(1, 320), (40, 320), (250, 250), (319, 319), (480, 480), (481, 480)])
def test_a_frame_is_drawn_with_whole_pixels_and_no_larger_than_asked_for(side, drawn_side):
    assert max(resize_for_display(torch.rand(1, 3, side, 7 if side > 7 else 1), largest=480).shape) == drawn_side


def test_a_large_frame_is_degraded_in_its_own_pixels_and_shrunk_by_area():
    frame = torch.rand(1, 3, 540, 960)
    effect = tr.Turbulence(amplitude_range=(3.0, 3.0), length_range=(60.0, 60.0))
    row = make_row("air", effect, frame=frame, seed=2)
    image = effect.degrade(frame, seed=2).image[0]
    expected = image.view(3, 270, 2, 480, 2).mean(dim=(2, 4))
    assert_close(row.corrupted, expected, atol=1e-6, rtol=0)


@pytest.mark.parametrize("size", [(32, 40), (281, 501), (90, 30), (12, 240)])
def test_nothing_overlaps_and_nothing_leaves_the_page(size):
    frame = torch.rand(1, 3, *size)
    effects = {"LensDistortion": tr.LensDistortion(), "fog": FOG, "Compose": tr.Compose([FOG, SWIRL, FOLDING])}
    effects |= {"HeterogeneousFog": tr.HeterogeneousFog(), "LensFlare": SUN}
    figure = sheet([make_row(name, e, frame=frame, seed=0) for name, e in effects.items()], title="frame.png")
    figure.canvas.draw()
    boxes = [axes.get_window_extent() for axes in figure.axes] + [text.get_window_extent() for text in figure.texts]
    for i, box in enumerate(boxes):
        assert figure.bbox.x0 <= box.x0 < box.x1 <= figure.bbox.x1
        assert figure.bbox.y0 <= box.y0 < box.y1 <= figure.bbox.y1
        assert not any(box.padded(-0.5).overlaps(other) for other in boxes[i + 1 :])


def test_a_saved_sheet_holds_its_pictures_without_resampling(tmp_path, frame):
    row: SheetRow = make_row("swirl", SWIRL, frame=frame, seed=5)
    figure = sheet([row], title="frame.png")
    figure.savefig(tmp_path / "sheet.png")
    page = matplotlib.image.imread(tmp_path / "sheet.png")[..., :3]
    for axes, picture in zip(figure.axes, pictures(figure), strict=True):
        left, right = (round(x * page.shape[1]) for x in axes.get_position().intervalx)
        bottom, top = (round(y * page.shape[0]) for y in axes.get_position().intervaly)
        found = page[page.shape[0] - top : page.shape[0] - bottom, left:right]
        np.testing.assert_allclose(found, picture.movedim(0, -1) / 255, atol=1e-6)
