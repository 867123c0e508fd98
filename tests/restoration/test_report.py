import csv
import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from figures import assert_nothing_overlaps, pixels_of, shown_images, texts
from matplotlib.figure import Figure
from pictures import save_picture
from torch import Tensor, nn

from torchrefract import Pair, Turbulence, presets
from torchrefract.data.frames import FrameFolder
from torchrefract.data.module import road_scenes
from torchrefract.restoration import report
from torchrefract.restoration.module import Restoration
from torchrefract.restoration.report import (
    RunSummary,
    border_name,
    carry_over,
    choose_examples,
    describe_scene,
    draw_panel,
    metrics_rows,
    plot_curves,
    summary,
    verdict,
)
from torchrefract.restoration.tasks import Restored, Undistort
from torchrefract.visualization.color import flow_to_rgb

# CSVLogger writes a row for validation and a row for training in each epoch, most cells empty.
METRICS = """\
epoch,step,train/loss,train/psnr,val/epe,val/epe_constant,val/epe_identity,val/loss,val/psnr,val/psnr_identity
0,9,,,6.0,9.5,14.0,0.5,20.0,21.0
0,9,0.6,19.0,,,,,,
1,19,,,3.0,9.5,14.0,nan,24.0,21.0
1,19,0.4,23.0,,,,,,
2,29,,,2.0,9.5,14.0,0.2,26.0,21.0
2,29,0.3,25.0,,,,,,
"""


@pytest.fixture
def metrics(tmp_path) -> Path:
    path = tmp_path / "metrics.csv"
    path.write_text(METRICS)
    return path


def curves(figure: Figure) -> dict[str, dict[str, tuple[list[float], list[float]]]]:
    """Return label of the vertical axis -> label of the curve without its last value -> epochs, values."""

    def points(line) -> tuple[list[float], list[float]]:
        return list(np.asarray(line.get_xdata())), list(np.asarray(line.get_ydata()))

    return {
        axes.get_ylabel(): {str(line.get_label()).split(" (")[0]: points(line) for line in axes.lines}
        for axes in figure.axes
    }


@pytest.mark.quick
def test_curves_show_each_quantity_and_the_baselines(metrics):
    figure = plot_curves(metrics.parent, epe_unit="px at 1920x1080")
    drawn = curves(figure)
    assert drawn["PSNR (dB)"] == {
        "training": ([0, 1, 2], [19, 23, 25]),
        "validation": ([0, 1, 2], [20, 24, 26]),
        "do nothing": ([0, 1, 2], [21, 21, 21]),
    }
    assert drawn["endpoint error (px at 1920x1080)"] == {
        "validation": ([0, 1, 2], [6, 3, 2]),
        "do nothing": ([0, 1, 2], [14, 14, 14]),
        "best constant flow": ([0, 1, 2], [9.5, 9.5, 9.5]),
    }
    assert drawn["loss"]["training"] == ([0, 1, 2], [0.6, 0.4, 0.3])
    np.testing.assert_array_equal(drawn["loss"]["validation"][1], [0.5, math.nan, 0.2])  # NaN leaves a gap
    for line in (line for axes in figure.axes for line in axes.lines):
        is_result = str(line.get_label()).startswith(("training", "validation"))
        assert line.get_linestyle() == ("-" if is_result else "--")


def test_an_epoch_is_the_mean_of_its_training_rows_and_its_last_validation_row(metrics):
    metrics.write_text("epoch,step,train/loss,val/loss\n0,1,1.0,\n0,2,3.0,\n0,2,,8.0\n0,3,,5.0\n,9,,\n")
    assert curves(plot_curves(metrics.parent, epe_unit="px")) == {
        "loss": {"training": ([0], [2]), "validation": ([0], [5])}
    }


def test_a_single_epoch_shows_its_baselines_as_lines_over_the_full_width(metrics):
    metrics.write_text("".join(METRICS.splitlines(keepends=True)[:3]))
    figure = plot_curves(metrics.parent, epe_unit="px")
    figure.canvas.draw()
    epe = figure.axes[2]
    left, right = epe.get_xlim()
    assert [tick for tick in epe.get_xticks() if left <= tick <= right] == [0]
    baseline = next(line for line in epe.lines if str(line.get_label()).startswith("do nothing"))
    assert list(np.asarray(baseline.get_ydata())) == [14, 14]
    assert np.ptp(baseline.get_window_extent().get_points()[:, 0]) == pytest.approx(epe.bbox.width)


@pytest.mark.parametrize("text", ["", "epoch,step,val/loss\n0,9,\n", "epoch,step,lr\n0,9,1\n"])
def test_metrics_without_a_value_are_rejected(metrics, text):
    metrics.write_text(text)
    with pytest.raises(ValueError, match="metrics must hold a loss, psnr or epe of an epoch"):
        plot_curves(metrics.parent, epe_unit="px")


def examples(*, has_flow: bool = False, size: tuple[int, int] = (8, 10), count: int = 2) -> tuple[Restored, Pair]:
    """Return examples of random images and flows; the left half of the second is invalid."""
    generator = torch.Generator().manual_seed(0)
    degraded, clean, restored = torch.rand(3, count, 3, *size, generator=generator)
    flow, predicted_flow = torch.randn(2, count, 2, *size, generator=generator)
    valid = torch.ones(count, 1, *size, dtype=torch.bool)
    valid[1, :, :, : size[1] // 2] = False
    pair = Pair(degraded, clean, flow, valid, torch.arange(count))
    return Restored(restored, predicted_flow if has_flow else None), pair


def cells(figure: Figure, columns: int) -> list[list[Tensor]]:
    """Return the drawn images by column and row, each (3, height, width) in [0, 1]."""
    drawn = [pixels_of(image) / 255 for image in shown_images(figure)]
    return [drawn[2 * j : 2 * j + 2] for j in range(columns)]


def enlarge(image: Tensor) -> Tensor:
    """Enlarge (3, 8, 10) by 32, the smallest factor that makes the longer side at least 320."""
    return torch.kron(image.contiguous(), torch.ones(1, 32, 32))


def test_a_panel_draws_images_in_their_columns_with_captions():
    restored, pair = examples()
    pair.clean[0] *= 0.8
    pair.degraded[0], restored.image[0] = pair.clean[0] + 0.1, pair.clean[0] + 0.01  # 20 dB and 40 dB
    pair.degraded[1, :, 0, 9] = math.nan
    figure = draw_panel(restored, pair)
    error = (4 * (restored.image.clamp(0, 1) - pair.clean).abs()).clamp(max=1)
    for column, image in zip(cells(figure, 4), (pair.clean, pair.degraded, restored.image, error), strict=True):
        assert (column[0] - enlarge(image[0].clamp(0, 1))).abs().max() <= 0.5 / 255 + 1e-6
    gray = cells(figure, 4)[1][1][:, :32, -32:]  # a value that is not finite
    assert (gray - 0.5).abs().max() <= 0.5 / 255 + 1e-6
    assert texts(figure)[:4] == ["clean", "corrupted", "restored", "|restored - clean| x 4"]
    assert {"20.0 -> 40.0 dB", "invalid: lost, or outside the frame"} < set(texts(figure))
    complete = draw_panel(restored, pair._replace(valid=torch.ones_like(pair.valid)))
    assert "invalid: lost, or outside the frame" not in texts(complete)


def test_both_flows_share_the_scale_of_the_longest_valid_true_flow():
    restored, pair = examples(has_flow=True)
    assert restored.flow is not None
    pair.flow[0, :, 4, 5] = torch.tensor([22.0, -29.2])  # |flow| = 36.56
    pair.flow[0, 0, 1, 1] = math.inf
    pair.flow[1, :, 0, 0] = 500.0  # invalid
    figure = draw_panel(restored._replace(flow=10 * restored.flow), pair)
    drawn = cells(figure, 5)
    for column, shown in ((drawn[3], pair.flow), (drawn[4], 10 * restored.flow)):
        expected = enlarge(flow_to_rgb(shown, max_px=37.0)[0])
        assert (column[0] - expected).abs().max() <= 0.5 / 255 + 1e-6
    assert texts(figure)[3:5] == ["true flow", "predicted flow"]
    assert "full color = 37 px" in texts(figure)


def test_invalid_pixels_are_hatched_from_the_third_column_on():
    for column, (first, second) in enumerate(cells(draw_panel(*examples(has_flow=True)), 5)):
        invalid, valid = second[:, :, :160], second[:, :, 160:]
        is_gray = (invalid == invalid[:1]).all()
        assert is_gray == (column >= 2)
        assert not (valid == valid[:1]).all()
        assert not (first == first[:1]).all()
        if column >= 2:
            assert len(invalid.unique()) == 2


@pytest.mark.parametrize("size", [(360, 640), (112, 8), (16, 16)])
def test_nothing_on_a_panel_overlaps_or_leaves_the_page(size):
    assert_nothing_overlaps(draw_panel(*examples(has_flow=True, size=size)))


# Of the model, the best constant flow, and doing nothing.
OF_METHODS = {"L": (0.03, 0.04, 0.05), "L_rec": (0.02, 0.025, 0.0301), "L_k": (0.01, 0.015, 0.0199)}
OF_METHODS |= {"psnr": (26.0, 25.25, 20.5), "ssim": (0.8, 0.75, 0.7), "epe": (5.0, 6.0, 20.0)}
SCORES = {"val/loss": 0.04, "train/psnr": 99.0}
for _name, _values in OF_METHODS.items():
    SCORES |= {f"val/{_name}{of}": value for of, value in zip(("", "_constant", "_identity"), _values, strict=True)}


def scores(**changes: float) -> dict[str, Tensor]:
    changed = {f"val/{name}": value for name, value in changes.items()}
    return {name: torch.tensor(value) for name, value in (SCORES | changed).items()}


def words(lines: list[str]) -> list[str]:
    return [" ".join(line.split()) for line in lines]


@pytest.mark.quick
def test_the_table_compares_the_model_with_the_baselines():
    head, *lines = summary(scores(), (1080, 1920))
    assert "px at 1920x1080" in head
    assert head.split()[:4] == ["validation", "L", "L_rec", "L_k"]
    assert words(lines) == [
        "do nothing 0.0500 0.0301 0.0199 20.50 (+0.00) 0.700 20.00 (1.00 x do nothing)",
        "best constant flow 0.0400 0.0250 0.0150 25.25 (+4.75) 0.750 6.00 (0.30 x do nothing)",
        "model 0.0300 0.0200 0.0100 26.00 (+5.50) 0.800 5.00 (0.25 x do nothing)",
    ]
    assert len({len(line) for line in lines}) == 1
    worse = words(summary(scores(psnr=18.0, epe=30.0), (1080, 1920)))[-1]
    assert worse.endswith(" 18.00 (-2.50) 0.800 30.00 (1.50 x do nothing)")
    assert len(summary(scores(epe=0.0, epe_constant=0.0, epe_identity=0.0), (1080, 1920))) == 4
    stopped = {name: value for name, value in scores().items() if "ssim" not in name}
    assert [line.split()[-6] for line in words(summary(stopped, (1080, 1920))[1:])] == ["nan"] * 3
    covered = words(summary(scores(coverage=0.934), (1080, 1920)))[-1]
    share = "93% of the values of the flow within two predicted standard deviations"
    assert covered == f"model {share}; 95% if they are right"
    head, *lines = summary(without_flow(), (1080, 1920))
    assert "endpoint" not in head
    assert "L_k" not in head
    assert words(lines) == ["do nothing 0.0500 0.0301 20.50 (+0.00) 0.700", "model 0.0300 0.0200 26.00 (+5.50) 0.800"]


@pytest.mark.quick
def test_table_and_verdict_of_fog_name_what_the_true_fog_allows():
    fog = {"psnr_fog": 24.5, "ssim_fog": 0.9, "L_fog": 0.01, "L_rec_fog": 0.01}
    fog |= {"psnr_seen": 27.0, "psnr_seen_identity": 19.0, "psnr_seen_fog": 38.0}
    values = without_flow(**fog)
    head, *lines = summary(values, (1080, 1920))
    assert "PSNR where t >= 1/255 (dB)" in head
    assert words(lines) == [
        "do nothing 0.0500 0.0301 20.50 (+0.00) 0.700 19.00 (+0.00)",
        "true fog, 8 bits 0.0100 0.0100 24.50 (+4.00) 0.900 38.00 (+19.00)",
        "model 0.0300 0.0200 26.00 (+5.50) 0.800 27.00 (+8.00)",
    ]
    better = "the model: better than doing nothing by 5.50 dB (the true fog, in 8 bits, by 4.00 dB)"
    assert verdict(values) == better
    assert verdict(without_flow(**fog, psnr=20.0)) == "the model: NOT better than doing nothing (-0.50 dB)" + ADVICE


def without_flow(**changes: float) -> dict[str, Tensor]:
    """Return the scores of a task without a flow."""
    flow = ("epe", "constant", "L_k")
    return {name: value for name, value in scores(**changes).items() if not any(word in name for word in flow)}


ADVICE = ": train longer, on more frames, or at a larger data.size"


@pytest.mark.quick
def test_the_verdict_compares_the_model_with_each_baseline_in_the_unit_of_the_task():
    assert verdict(scores()) == "the model: better than doing nothing by 15.00 px and than the constant flow by 1.00 px"
    best = torch.tensor(1.8)
    assert verdict(scores(), best=best).startswith("best.ckpt: better than doing nothing by 18.20 px and than ")
    between = "the model: better than doing nothing by 13.50 px, but NOT than the constant flow (-0.50 px)"
    assert verdict(scores(epe=6.5)) == between + ADVICE
    neither = "the model: NOT better than doing nothing (-5.00 px) or the constant flow (-19.00 px)"
    assert verdict(scores(epe=25.0)) == neither + ADVICE
    assert verdict(scores(epe=math.nan)).startswith("the model: NOT better than doing nothing (+nan px) or ")
    assert verdict(without_flow()) == "the model: better than doing nothing by 5.50 dB"
    assert verdict(without_flow(psnr=20.5)) == "the model: NOT better than doing nothing (+0.00 dB)" + ADVICE


@pytest.mark.quick
@pytest.mark.parametrize(
    ("effect", "border", "name"),
    [
        (presets.cheap_dashcam(), None, ""),
        (presets.cheap_dashcam(), "black", "black border"),
        (presets.cheap_dashcam(), "mirrored", "mirrored border"),
        (presets.paper_refractive(), None, "padded frames"),
        (presets.paper_refractive(frame="fill"), None, ""),
    ],
)
def test_a_border_names_the_scene_and_the_rows(effect, border, name):
    data = road_scenes(effect=effect, border=border)
    assert border_name(data) == name
    scene = describe_scene(data, {"_target_": "torchrefract.presets.a_scene", "severity": 3})
    assert scene == "a_scene of severity 3" + (f", {name}" if name else "")
    rows = [line[:36].rstrip() for line in summary(scores(), (1080, 1920), border=name)]
    methods = ["do nothing", "best constant flow", "model"]
    assert rows == ["validation", *(f"{method}, {name}" if name else method for method in methods)]


def test_the_panel_shows_four_examples_by_degradation():
    restored, pair = examples(has_flow=True, count=6)
    offset = torch.tensor([0.01, 0.1, 0.02, 0.2, 0.05, 0.04])
    pair.clean.mul_(0.8)
    pair = pair._replace(degraded=pair.clean + offset.view(6, 1, 1, 1))
    chosen = [3, 1, 5, 2]  # of 3 1 4 5 2 0
    chosen_restored, chosen_pair = choose_examples(restored, pair)
    for value, every in zip((*chosen_restored[:2], *chosen_pair[:5]), (*restored[:2], *pair[:5]), strict=True):
        assert value is not None
        assert every is not None
        assert torch.equal(value, every[chosen])
    restored, pair = choose_examples(*examples())
    assert (restored.flow, len(pair.clean)) == (None, 2)


@pytest.mark.parametrize(("rank", "num_batches"), [(1, 1), (0, 0)])
def test_other_ranks_and_runs_without_validation_write_nothing(tmp_path, capsys, rank, num_batches):
    trainer: Any = SimpleNamespace(is_global_zero=rank == 0, callback_metrics=scores())
    model = Restoration(lambda channels, smooth: nn.Conv2d(3, channels, 1), Undistort())
    callback, (restored, pair) = RunSummary(str(tmp_path)), examples(has_flow=True)
    for number in range(num_batches):
        callback.on_validation_batch_end(trainer, model, restored._asdict(), pair, number)
    callback.teardown(trainer, model, "validate")
    assert capsys.readouterr().out == ""
    assert list(tmp_path.iterdir()) == []


def test_a_training_warns_of_drives_whose_camera_has_a_lens(tmp_path, capsys, monkeypatch):
    save_picture(tmp_path / "drive_1.png", np.zeros((40, 60, 3), np.uint8))
    frames = FrameFolder(tmp_path, size=(40, 60))
    monkeypatch.setattr(report, "describe_training", lambda *_: ["frames 1"])
    monkeypatch.setattr(report, "bent_drives", lambda given: {"fort": 0.0213, "reef": 0.004} if given is frames else {})
    model = Restoration(lambda channels, smooth: nn.Conv2d(3, channels, 1), Undistort())
    for effect in (presets.paper_refractive(), Turbulence(), None):  # the first one draws lenses, among others
        data = SimpleNamespace(train=frames, effect=effect)
        trainer: Any = SimpleNamespace(is_global_zero=True, datamodule=data)
        RunSummary(str(tmp_path)).on_train_start(trainer, model)
    first, warning, *others = capsys.readouterr().out.splitlines()
    assert [first, *others] == 3 * ["frames 1"]
    assert warning.startswith("warning: the camera of fort, reef has a lens")
    assert "up to 2.1% of the width" in warning
    assert "torchrefract.estimate_lens" in warning


def test_a_resumed_run_copies_complete_metrics_of_the_epochs_before_its_checkpoint(tmp_path):
    stopped, run = tmp_path / "stopped", tmp_path / "run"
    stopped.mkdir()
    run.mkdir()
    carry_over(stopped, run, before_epoch=5)
    assert list(run.iterdir()) == []
    # This run was itself resumed, and was killed while it wrote a row.
    (stopped / "metrics_before.csv").write_text("epoch,val/loss\n0,9\n")
    (stopped / "metrics.csv").write_text("epoch,val/loss,val/epe\n1,8,70\n2,7,60\n2")
    carry_over(stopped, run, before_epoch=2)
    (run / "metrics.csv").write_text("epoch,val/loss\n2,6\n3,5\n")
    assert [(row["epoch"], row["val/loss"]) for row in metrics_rows(run)] == [*zip("0123", "9865", strict=True)]
    with (run / "metrics_before.csv").open(newline="") as file:
        assert [row["val/epe"] for row in csv.DictReader(file)] == ["", "70"]
    carry_over(stopped, tmp_path, before_epoch=3)
    assert [(row["epoch"], row["val/loss"]) for row in metrics_rows(tmp_path)] == [*zip("012", "987", strict=True)]
