import math
from dataclasses import replace
from pathlib import Path

import matplotlib.image
import numpy as np
import pytest
import torch
from matplotlib.figure import Figure
from torch import Tensor

from torchrefract.restoration.report import PanelRows, _curves, _panel, save_curves, save_panel
from torchrefract.visualization.color import flow_to_rgb

# As CSVLogger writes it: columns by name, a validation row and a training row an epoch, most cells empty.
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
    """Label of the vertical axis -> label of the curve without its last value -> epochs, values."""
    return {
        axes.get_ylabel(): {
            str(line.get_label()).split(" (")[0]: (
                list(np.asarray(line.get_xdata())),
                list(np.asarray(line.get_ydata())),
            )
            for line in axes.lines
        }
        for axes in figure.axes
    }


def test_curves_show_each_quantity_with_its_unit_and_what_needs_no_network(metrics):
    drawn = curves(_curves(metrics.parent, epe_unit="px at 1920x1080"))
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
    assert list(drawn["loss"]) == ["training", "validation"]


def test_a_nan_leaves_a_gap_in_its_curve_only(metrics):
    drawn = curves(_curves(metrics.parent, epe_unit="px"))["loss"]
    assert drawn["training"] == ([0, 1, 2], [0.6, 0.4, 0.3])
    np.testing.assert_array_equal(drawn["validation"][1], [0.5, math.nan, 0.2])


def test_references_are_dashed_and_results_are_not(metrics):
    for axes in _curves(metrics.parent, epe_unit="px").axes:
        for line in axes.lines:
            is_result = str(line.get_label()).startswith(("training", "validation"))
            assert line.get_linestyle() == ("-" if is_result else "--")


def test_several_rows_of_an_epoch_are_a_mean_in_training_and_the_last_in_validation(metrics):
    metrics.write_text("epoch,step,train/loss,val/loss\n0,1,1.0,\n0,2,3.0,\n0,2,,8.0\n0,3,,5.0\n")
    assert curves(_curves(metrics.parent, epe_unit="px"))["loss"] == {"training": ([0], [2]), "validation": ([0], [5])}


def test_one_epoch_still_shows_its_references_and_whole_epochs_on_the_axis(metrics):
    metrics.write_text("".join(METRICS.splitlines(keepends=True)[:3]))
    figure = _curves(metrics.parent, epe_unit="px")
    figure.canvas.draw()
    epe = figure.axes[2]
    left, right = epe.get_xlim()
    assert [tick for tick in epe.get_xticks() if left <= tick <= right] == [0]
    reference = next(line for line in epe.lines if str(line.get_label()).startswith("do nothing"))
    assert list(np.asarray(reference.get_ydata())) == [14, 14]
    assert np.ptp(reference.get_window_extent().get_points()[:, 0]) == pytest.approx(epe.bbox.width)


def test_a_quantity_without_columns_has_no_panel(metrics):
    metrics.write_text("epoch,step,val/psnr,lr\n0,9,20.0,\n,9,,0.001\n1,19,22.0,\n")
    assert curves(_curves(metrics.parent, epe_unit="px")) == {"PSNR (dB)": {"validation": ([0, 1], [20, 22])}}


@pytest.mark.parametrize("text", ["", "epoch,step,val/loss\n", "epoch,step,val/loss\n0,9,\n", "epoch,step,lr\n0,9,1\n"])
def test_metrics_without_a_value_to_draw_are_refused_and_the_old_picture_stays(metrics, text):
    metrics.write_text(text)
    out = metrics.with_name("curves.png")
    out.write_text("old")
    with pytest.raises(ValueError, match="metrics must hold a loss, psnr or epe of some epoch"):
        save_curves(metrics.parent, out)
    assert out.read_text() == "old"


def test_saved_curves_are_a_picture_and_the_only_new_file(metrics):
    out = metrics.with_name("curves.png")
    save_curves(metrics.parent, out, epe_unit="px at 1920x1080")
    assert sorted(out.parent.iterdir()) == [out, metrics]
    assert np.ptp(matplotlib.image.imread(out)[..., :3]) > 0.5


CAPTION = r"run_$\no$"  # an error where it is taken for a formula


def rows(*, flow: Tensor | None = None, predicted_flow: Tensor | None = None, size: tuple[int, int] = (8, 10)):
    """Two rows of random images whose left half is not valid in the second."""
    degraded, clean, restored = torch.rand(3, 2, 3, *size)
    valid = torch.ones(2, 1, *size, dtype=torch.bool)
    valid[1, :, :, : size[1] // 2] = False
    return PanelRows(degraded, clean, restored, valid, ["20 -> 25 dB", CAPTION], flow, predicted_flow)


def cells(figure: Figure, columns: int) -> list[list[Tensor]]:
    """The picture of each column and row, (3, height, width) in [0, 1]."""
    drawn = [torch.from_numpy(np.asarray(axes.images[0].get_array())).movedim(-1, 0) / 255 for axes in figure.axes]
    return [drawn[2 * j : 2 * j + 2] for j in range(columns)]


def texts(figure: Figure) -> list[str]:
    return [text.get_text() for text in figure.texts]


def enlarged(image: Tensor) -> Tensor:
    """(3, 8, 10) as drawn: 10 px become the least multiple of 10 that is 320 or more."""
    return torch.kron(image.contiguous(), torch.ones(1, 32, 32))


def test_images_are_drawn_pixel_by_pixel_in_their_columns():
    sample = rows()
    figure = _panel(sample)
    drawn = cells(figure, 4)
    error = (4 * (sample.restored - sample.clean).abs()).clamp(max=1)
    for column, images in zip(drawn, (sample.clean, sample.degraded, sample.restored, error), strict=True):
        assert (column[0] - enlarged(images[0])).abs().max() <= 0.5 / 255 + 1e-6
    assert texts(figure)[:4] == ["clean", "corrupted", "restored", "|restored - clean| x 4"]
    assert {"20 -> 25 dB", CAPTION} < set(texts(figure))


def test_both_flows_have_the_scale_of_the_longest_valid_true_flow_and_the_key_states_it():
    flow = torch.randn(2, 2, 8, 10).clamp(-2, 2)
    flow[0, :, 4, 5] = torch.tensor([22.0, -29.2])  # |flow| = 36.56
    flow[0, 0, 1, 1] = math.inf
    flow[1, :, 0, 0] = 500.0  # not valid
    predicted_flow = 10 * torch.randn(2, 2, 8, 10)
    figure = _panel(rows(flow=flow, predicted_flow=predicted_flow))
    drawn = cells(figure, 5)
    for column, shown in ((drawn[3], flow), (drawn[4], predicted_flow)):
        expected = enlarged(flow_to_rgb(shown, max_px=37.0)[0])
        assert (column[0] - expected).abs().max() <= 0.5 / 255 + 1e-6
    assert texts(figure)[3:5] == ["true flow", "predicted flow"]
    assert "full color = 37 px at 10x8" in texts(figure)


def test_the_stripes_are_explained_where_there_are_any():
    striped, whole = rows(), replace(rows(), valid=torch.ones(2, 1, 8, 10, dtype=torch.bool))
    line = "not valid: lost in the corrupted image"
    assert line in texts(_panel(striped))
    assert line not in texts(_panel(whole))


def test_a_prediction_without_truth_has_its_own_scale():
    figure = _panel(rows(predicted_flow=torch.full((2, 2, 8, 10), 0.3)))  # |flow| = 0.424
    assert "predicted flow" in texts(figure)
    assert "true flow" not in texts(figure)
    assert "full color = 0.43 px at 10x8" in texts(figure)


def test_pixels_that_are_not_valid_are_striped_gray_after_the_second_column():
    flow = torch.randn(2, 2, 8, 10)
    for column, (first, second) in enumerate(cells(_panel(rows(flow=flow, predicted_flow=flow)), 5)):
        lost, kept = second[:, :, :160], second[:, :, 160:]
        is_gray = (lost == lost[:1]).all()
        assert is_gray == (column >= 2)
        assert not (kept == kept[:1]).all()
        assert not (first == first[:1]).all()
        if column >= 2:
            assert len(lost.unique()) == 2


@pytest.mark.parametrize("size", [(64, 112), (37, 53), (720, 1281)])
def test_the_saved_picture_holds_the_cells_without_resampling(tmp_path, size):
    sample = rows(size=size)
    save_panel(sample, tmp_path / "panel.png")
    page = matplotlib.image.imread(tmp_path / "panel.png")[..., :3]
    figure = _panel(sample)
    for axes in figure.axes:
        image = np.asarray(axes.images[0].get_array())
        left, right = (round(x * page.shape[1]) for x in axes.get_position().intervalx)
        bottom, top = (round(y * page.shape[0]) for y in axes.get_position().intervaly)
        np.testing.assert_allclose(
            page[page.shape[0] - top : page.shape[0] - bottom, left:right], image / 255, atol=1e-6
        )


@pytest.mark.parametrize("size", [(64, 112), (360, 640), (112, 48), (112, 8), (16, 16)])
def test_nothing_overlaps_and_nothing_leaves_the_page(size):
    flow = torch.randn(2, 2, *size)
    figure = _panel(rows(flow=flow, predicted_flow=flow, size=size))
    figure.canvas.draw()
    boxes = [axes.get_window_extent() for axes in figure.axes] + [text.get_window_extent() for text in figure.texts]
    for i, box in enumerate(boxes):
        assert figure.bbox.x0 <= box.x0 < box.x1 <= figure.bbox.x1
        assert figure.bbox.y0 <= box.y0 < box.y1 <= figure.bbox.y1
        assert not any(box.padded(-0.5).overlaps(other) for other in boxes[i + 1 :])


def test_a_restoration_that_diverged_is_drawn_gray(tmp_path):
    sample = rows()
    sample.restored[0, :, 0, 0] = math.nan
    save_panel(sample, tmp_path / "panel.png")
    drawn = cells(_panel(sample), 4)
    assert drawn[2][0][:, :32, :32].sub(0.5).abs().max() < 0.5 / 255 + 1e-6


def test_a_panel_that_cannot_be_saved_keeps_the_old_one(tmp_path, monkeypatch):
    def half_a_file(self, path):
        path.write_text("half")
        raise OSError("no space left")

    out = tmp_path / "panel.png"
    out.write_text("old")
    monkeypatch.setattr(Figure, "savefig", half_a_file)
    with pytest.raises(OSError, match="no space left"):
        save_panel(rows(), out)
    assert out.read_text() == "old"
    assert list(tmp_path.iterdir()) == [out]


def test_wrong_rows_are_refused():
    image, valid = torch.rand(2, 3, 4, 5), torch.ones(2, 1, 4, 5, dtype=torch.bool)
    with pytest.raises(ValueError, match=r"clean must have shape .* with N from 1 to 8, got"):
        PanelRows(image, torch.rand(9, 3, 4, 5), image, valid, ["", ""])
    with pytest.raises(ValueError, match=r"restored must have shape \(2, 3, 4, 5\), got \(1, 3, 4, 5\)"):
        PanelRows(image, image, image[:1], valid, ["", ""])
    with pytest.raises(ValueError, match=r"flow must have shape \(2, 2, 4, 5\)"):
        PanelRows(image, image, image, valid, ["", ""], flow=image)
    with pytest.raises(TypeError, match="valid must be of type bool"):
        PanelRows(image, image, image, valid.float(), ["", ""])
    with pytest.raises(ValueError, match="captions must be 2 texts, got 1"):
        PanelRows(image, image, image, valid, [""])
