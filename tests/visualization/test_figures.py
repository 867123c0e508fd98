import math
import re
from typing import Any

import matplotlib.image
import numpy as np
import pytest
import torch
from figures import assert_nothing_overlaps, pixels_of, shown_images, texts
from torch import Tensor
from torch.testing import assert_close

import torchrefract as tr
from torchrefract.visualization.color import checkerboard, flow_to_rgb, flow_wheel, transmission_to_rgb
from torchrefract.visualization.figures import MapScale, contact_sheet, contact_sheet_row, describe_params
from torchrefract.visualization.layout import resize_for_display

SIZE = (32, 40)  # displayed with 8 x 8 px for each pixel
WARP = tr.DivergenceFree(amplitude_range=(1.0, 1.0), length_range=(12.0, 12.0))
FOLDING_WARP = tr.DivergenceFree(amplitude_range=(4.0, 4.0), length_range=(8.0, 8.0))
FOG = tr.UniformFog(visibility_range=(100.0, 100.0))
FLARE = tr.LensFlare(strength_range=(0.5, 0.5))


@pytest.fixture
def frame() -> Tensor:
    return torch.rand(1, 3, *SIZE, generator=torch.Generator().manual_seed(0))


def enlarged(value: Tensor) -> Tensor:
    """Repeat each pixel of (..., 32, 40) as displayed."""
    return value.repeat_interleave(8, dim=-1).repeat_interleave(8, dim=-2)


def number(pattern: str, text: str) -> float:
    match = re.search(pattern, text)
    assert match is not None, text
    return float(match[1])


def psnr(image: Tensor, frame: Tensor, valid: Tensor) -> float:
    difference = (image.clamp(0, 1) - frame)[valid.expand_as(frame)]
    return 10 * math.log10(1 / difference.square().mean().item())


def assert_shows(image: Tensor | None, expected: Tensor, valid: Tensor | None = None) -> None:
    """Raise AssertionError unless an image is (1, 3, 32, 40) as displayed, where that is valid."""
    assert image is not None
    shown = torch.ones(image.shape[1:], dtype=torch.bool) if valid is None else enlarged(valid)
    assert_close(image[:, shown], enlarged(expected[0])[:, shown])


@pytest.mark.quick
def test_a_row_shows_frame_corrupted_checkerboard_flow_and_restored(frame):
    row, d = contact_sheet_row("warp", WARP, frame=frame, seed=5), WARP.degrade(frame, seed=5)
    valid, restorable = d.valid[0, 0], d.restore_valid[0, 0]
    assert 0.5 < restorable.float().mean() < 1
    board = WARP.apply(checkerboard(*SIZE, cell=2), d.params).image
    restored = tr.warp(d.image, d.restore_flow, interpolation="bicubic")[0].clamp(0, 1)
    assert_shows(row.frame, frame)
    assert_shows(row.corrupted, d.image)
    for image, expected, mask in (
        (row.checkerboard, board, valid),
        (row.map, flow_to_rgb(d.flow, max_px=row.scales[0].top), valid),
        (row.restored, restored, restorable),
    ):
        assert_shows(image, expected, mask)
        assert image is not None
        assert_close(image[:, ~enlarged(mask)].unique(), torch.tensor([0.62, 0.86]))  # hatched


def test_folded_pixels_of_the_checkerboard_are_marked_and_counted(frame):
    row, d = contact_sheet_row("folding", FOLDING_WARP, frame=frame, seed=0), FOLDING_WARP.degrade(frame, seed=0)
    board = enlarged(FOLDING_WARP.apply(checkerboard(*SIZE, cell=2), d.params).image[0])
    valid, magenta = enlarged(d.valid[0, 0]), torch.tensor([1.0, 0.0, 1.0])[:, None, None]
    marked = valid & ((row.checkerboard - (0.25 * board + 0.75 * magenta)).abs().amax(dim=0) < 1e-5)
    assert_close(row.checkerboard[:, valid & ~marked], board[:, valid & ~marked])
    fraction = marked.float().mean().item()
    assert fraction == pytest.approx(d.folding.fraction.item(), rel=1e-3)
    assert number(r"([\d.]+)% folded", row.scores) == pytest.approx(100 * fraction, rel=0.05)
    assert "folded" not in contact_sheet_row("warp", WARP, frame=frame, seed=5).scores


def test_scores_are_those_of_restorable_pixels(frame):
    row, d = contact_sheet_row("warp", WARP, frame=frame, seed=5), WARP.degrade(frame, seed=5)
    restored = tr.warp(d.image, d.restore_flow, interpolation="bicubic")[0]
    largest = d.flow.norm(dim=1)[d.valid[:, 0]].max().item()
    assert number(r"largest displacement ([\d.]+) px", row.scores) == pytest.approx(largest, rel=0.005)
    assert largest <= row.scales[0].top <= 1.1 * largest
    share = d.restore_valid.float().mean().item()
    assert number(r"([\d.]+)% valid", row.scores) == pytest.approx(100 * share, abs=0.051)
    for name, image in (("corrupted", d.image), ("restored", restored)):
        expected = psnr(image, frame, d.restore_valid)
        assert number(rf"([\d.]+) dB {name}", row.scores) == pytest.approx(expected, abs=0.051)


def test_a_frame_that_stays_is_unchanged_and_has_no_score(frame):
    for effect in (tr.NightGlow(), tr.Turbulence(amplitude_range=(0.0, 0.0))):
        row = contact_sheet_row("none", effect, frame=0.5 * frame, seed=0)
        assert row.scores.endswith("100.0% valid; unchanged")


@pytest.mark.parametrize("linear_light", [False, True])
def test_fog_has_a_map_of_its_transmission_and_is_removed_from_8_bits(frame, linear_light):
    fog = tr.UniformFog(visibility_range=(100.0, 100.0), linear_light=linear_light)
    depth = torch.full((1, 1, *SIZE), 50.0)
    depth[..., 20:] = math.inf
    row, d = contact_sheet_row("fog", fog, frame=frame, seed=1, depth=depth), fog.degrade(frame, seed=1, depth=depth)
    assert row.scales == (MapScale("transmission", 1.0),)
    assert_shows(row.map, transmission_to_rgb(d.transmission))
    stored = (255 * d.image).round() / 255
    removed, valid = tr.remove_fog(stored, d.transmission, d.params.airlight, linear_light=linear_light)
    assert_shows(row.restored, removed.clamp(0, 1), valid[0, 0])
    before, after = psnr(d.image, frame, valid), psnr(removed, frame, valid)
    assert row.scores == f"50.0% valid; {before:.1f} dB corrupted, {after:.1f} dB restored from 8 bits"
    assert {"0", "1 transmission"} < set(texts(contact_sheet([row], title="fog")))


def test_heterogeneous_fog_shows_its_extinction_right_of_its_transmission(frame):
    fog = tr.HeterogeneousFog(visibility_range=(100.0, 100.0))
    row, d = contact_sheet_row("fog", fog, frame=frame, seed=1), fog.degrade(frame, seed=1)
    top = row.scales[1].top
    assert row.scales == (MapScale("transmission", 1.0), MapScale("extinction", top))
    assert d.extinction.max() <= top <= 1.1 * d.extinction.max()
    left, right = (transmission_to_rgb(value) for value in (d.transmission, d.extinction / top))
    assert_shows(row.map, torch.cat([left[..., :20], right[..., 20:]], dim=-1))
    labels = {"1 transmission (left)", f"{top:g}/m extinction (right)"}
    assert labels < set(texts(contact_sheet([row], title="fog")))


def test_a_flare_has_a_map_of_its_intensity_and_nothing_to_undo(frame):
    row, d = contact_sheet_row("flare", FLARE, frame=frame, seed=1), FLARE.degrade(frame, seed=1)
    (scale,) = row.scales
    assert (scale.name, row.restored) == ("intensity", None)
    assert d.intensity.max() <= scale.top <= min(1, 1.1 * d.intensity.max())
    assert_shows(row.map, transmission_to_rgb(d.intensity / scale.top))
    assert row.scores == f"{d.valid.float().mean():.1%} valid; {psnr(d.image, frame, d.valid):.1f} dB corrupted"
    assert {"no flow or fog to undo", f"{scale.top:g} intensity"} < set(texts(contact_sheet([row], title="flare")))


def test_the_map_of_the_sun_ends_at_white_so_that_its_glare_shows(frame):
    sun = tr.SunGlare(center_x_range=(0.5, 0.5), center_y_range=(0.3, 0.3), scatter_range=(0.06, 0.06))
    row, d = contact_sheet_row("sun", sun, frame=frame, seed=1), sun.degrade(frame, seed=1)
    assert d.intensity.max() > 2
    assert row.scales == (MapScale("intensity", 1.0),)
    assert_shows(row.map, transmission_to_rgb(d.intensity))
    assert "1 or more, intensity" in texts(contact_sheet([row], title="sun"))


def test_the_map_of_one_of_several_effects_is_that_of_the_one_drawn(frame):
    effect, names = tr.OneOf([FOG, FLARE]), set()
    for seed in range(4):
        fog, _ = (child.applied.item() for child in effect.degrade(frame, seed=seed).params.children)
        row = contact_sheet_row("one", effect, frame=frame, seed=seed)
        assert [scale.name for scale in row.scales] == ["transmission" if fog else "intensity"]
        names.add(row.scales[0].name)
    assert len(names) == 2


def test_an_effect_that_is_not_applied_says_so(frame):
    row = contact_sheet_row("fog", tr.UniformFog(p=0.0), frame=frame, seed=0)
    assert row.title == "fog: not applied"
    assert torch.equal(row.corrupted, row.frame)
    both, none = tr.Compose([tr.UniformFog(p=0.0), FOG]), tr.Compose([FOG], p=0.0)
    assert describe_params(both, both.sample(frame, seed=0)) == "UniformFog (visibility 100 m)"
    assert describe_params(none, none.sample(frame, seed=0)) == "not applied"


def test_an_effect_without_parameters_has_no_parentheses(frame):
    effect = tr.Compose([FOG, tr.NightGlow()])
    assert describe_params(effect, effect.sample(frame, seed=0)) == "UniformFog (visibility 100 m) + NightGlow"


def test_the_score_of_fog_behind_a_lens_says_that_the_fog_remains(frame):
    row = contact_sheet_row("both", tr.Compose([FOG, tr.LensDistortion()]), frame=frame, seed=1)
    assert [scale.name for scale in row.scales] == ["flow"]
    assert row.scores.endswith("dB restored except fog")


def test_a_row_without_a_valid_pixel_has_no_score(frame):
    far = tr.ThinPlateSpline(amplitude_range=(0.0, 0.0))
    params = far.sample(frame, seed=0)
    params = params._replace(displacement=torch.full_like(params.displacement, 400.0))

    class FarAway(tr.ThinPlateSpline):
        def degrade(self, image, **_: Any):
            return self.apply(image, params)

    row = contact_sheet_row("far", FarAway(), frame=frame, seed=0)
    assert row.scores == "largest displacement 0 px; 0.0% valid"


NO_WIND: dict[str, Any] = {"wind_x_range": (0.0, 0.0), "wind_y_range": (0.0, 0.0)}
FOG_NUMBERS: dict[str, Any] = {"visibility_range": (90.0, 90.0), "contrast_range": (0.5, 0.5)}
FOG_NUMBERS |= {"wind_x_range": (0.3, 0.3)}


@pytest.mark.quick
@pytest.mark.parametrize(
    ("effect", "description"),
    [
        (
            tr.LensDistortion(k1_range=(-0.2, -0.2), center_x_range=(0.02, 0.02), center_y_range=(-0.01, -0.01)),
            r"k1 -0\.2, .*focal length \d\.\d\d widths, center off by \(0\.02, -0\.01\) widths",
        ),
        (
            tr.Turbulence(amplitude_range=(2.3, 2.3), length_range=(31.0, 31.0), aperture_range=(0.0, 0.0), **NO_WIND),
            r"amplitude 2\.3 px, length 31 px",
        ),
        (
            tr.Turbulence(wind_x_range=(1.5, 1.5), wind_y_range=(-2.0, -2.0)),
            r"amplitude .* px, length .* px, aperture .* px, wind \(1\.5, -2\) px/frame",
        ),
        (tr.ThinPlateSpline(lattice=(2, 3)), r"6 control points, .* px rms in x and y"),
        (
            tr.LensFlare(center_x_range=(0.25, 0.25), center_y_range=(0.5, 0.5), radius_range=(0.3, 0.3)),
            r"sun at 0\.25 widths, 0\.50 heights, radius 0\.3 diagonals, strength 0\.\d+.*",
        ),
        (tr.HeterogeneousFog(**FOG_NUMBERS), r"visibility 90 m, wind \(0\.3, 0\) px/frame"),
        (
            tr.HeterogeneousFog(mode="ray", wind_z_range=(-1, -1), **FOG_NUMBERS),
            r"visibility 90 m, contrast 0\.5, wind \(0\.3, 0, -1\) m/frame",
        ),
    ],
    ids=["lens", "turbulence", "wind", "thin plate", "flare", "heterogeneous fog", "volumetric fog"],
)
def test_parameters_are_described_with_their_units(frame, effect, description):
    assert re.fullmatch(description, describe_params(effect, effect.sample(frame, seed=0)))


def test_a_tilt_of_hundreds_of_microradians_is_written_without_an_exponent(frame):
    effect = tr.PhysicalTurbulence()
    params = effect.sample(frame, seed=0)._replace(tilt=torch.tensor([739.4]))
    assert describe_params(effect, params).startswith("tilt 739 microradians, wind")


def test_a_contact_sheet_shows_its_rows_in_order_each_with_its_own_scale(frame):
    rows = [contact_sheet_row(name, e, frame=frame, seed=5) for name, e in (("a", WARP), ("b", FOLDING_WARP))]
    figure = contact_sheet(rows, title="frame.png, 40 x 32 px")
    assert texts(figure)[:6] == ["frame.png, 40 x 32 px", "frame", "corrupted", "checkerboard", "map", "restored"]
    scales = [f"full color = {row.scales[0].top:g} px" for row in rows]
    assert [text for text in texts(figure) if text.startswith("full color")] == scales
    assert scales[0] != scales[1]
    for i, row in enumerate(rows):
        *shown, wheel, horizon, _, _, road, _ = map(pixels_of, shown_images(figure)[11 * i : 11 * i + 11])
        for image, expected in zip(
            shown, (row.frame, row.corrupted, row.checkerboard, row.map, row.restored), strict=True
        ):
            assert expected is not None
            assert torch.equal(image, (255 * expected).round().byte())
        assert torch.equal(horizon, (255 * row.details[0]).round().byte())
        assert torch.equal(road, (255 * row.details[3]).round().byte())
        assert torch.equal(wheel, (255 * flow_wheel(wheel.shape[1])).round().byte())


@pytest.mark.quick
@pytest.mark.parametrize(("side", "displayed"), [(1, 320), (40, 320), (250, 250), (319, 319), (480, 480), (481, 480)])
def test_an_image_is_displayed_with_whole_pixels_and_at_most_the_largest_side(side, displayed):
    assert max(resize_for_display(torch.rand(1, 3, side, 7 if side > 7 else 1), largest=480).shape) == displayed


def test_a_large_frame_is_degraded_at_its_own_size_and_reduced_by_area():
    frame = torch.rand(1, 3, 540, 960)
    row = contact_sheet_row("warp", WARP, frame=frame, seed=2)
    expected = WARP.degrade(frame, seed=2).image[0].view(3, 270, 2, 480, 2).mean(dim=(2, 4))
    assert_close(row.corrupted, expected, atol=1e-6, rtol=0)


@pytest.mark.parametrize("size", [(32, 40), (281, 501), (90, 30), (12, 240)])
def test_no_text_or_image_overlaps_another_or_leaves_the_figure(size):
    frame = torch.rand(1, 3, *size)
    effects = {"LensDistortion": tr.LensDistortion(), "fog": FOG, "Compose": tr.Compose([FOG, WARP, FOLDING_WARP])}
    effects |= {"HeterogeneousFog": tr.HeterogeneousFog(), "LensFlare": FLARE}
    rows = [contact_sheet_row(name, effect, frame=frame, seed=0) for name, effect in effects.items()]
    figure = contact_sheet(rows, title="frame.png")
    assert_nothing_overlaps(figure)


def test_a_saved_contact_sheet_holds_its_images_without_resampling(tmp_path, frame):
    figure = contact_sheet([contact_sheet_row("warp", WARP, frame=frame, seed=5)], title="frame.png")
    figure.savefig(tmp_path / "sheet.png")
    saved = matplotlib.image.imread(tmp_path / "sheet.png")[..., :3]
    (arrows,) = figure.axes
    boxes = [(shown, shown.get_window_extent()) for shown in shown_images(figure)]
    without_arrows = [(shown, box) for shown, box in boxes if not box.overlaps(arrows.get_window_extent())]
    assert len(without_arrows) == len(boxes) - 1
    for shown, box in without_arrows:
        left, bottom, right, top = (round(value) for value in box.extents)
        cell = saved[saved.shape[0] - top : saved.shape[0] - bottom, left:right]
        np.testing.assert_allclose(cell, pixels_of(shown).movedim(0, -1) / 255, atol=1e-6)
