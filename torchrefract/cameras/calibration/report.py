"""Quality of a calibration, and its report in Markdown with figures of the corners and of the errors."""

import contextlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from torchrefract._io import write_figure, write_file
from torchrefract.cameras.calibration.boards import Board
from torchrefract.cameras.calibration.choice import AUTO, FOLDS, Candidate, choose_model
from torchrefract.cameras.calibration.detection import Detection, View
from torchrefract.cameras.calibration.fit import Fit, LeaveOneOut, cross_validate, drop_outliers, rms
from torchrefract.cameras.calibration.uncertainty import MAX_DEVIATION_PX, rectified_deviation, undistort_pixels
from torchrefract.cameras.camera import Camera

CAMERA_FILE, REPORT_FILE = "camera.yaml", "report.md"
_FIGURES = ("coverage.png", "residuals.png", "uncertainty.png")
FIRST_MODEL, FIRST_PRIOR = "opencv4", "published"  # to find views that do not fit before the lens model is chosen
_UNCERTAINTY_GRID = (60, 80)  # rows and columns
_DPI = 100
_MAX_DRAWN = 12  # views in the figure of errors, those that cost the others most
_COLUMNS = 4  # of that figure
_ARROW = 0.05  # of the width of the frame: the length of an arrow for an error as large as the rms
CELLS = (6, 8)  # rows and columns of the cells that divide the frame
_NUM_DEVIATIONS = 2.0  # standard deviations within which a coefficient may be zero
_SIDES = {"left": np.s_[:, 0], "right": np.s_[:, -1], "top": np.s_[0], "bottom": np.s_[-1]}
_MIN_LINE = 3  # corners of a line; two always lie on one
_REPORT = """\
# Calibration

Board: `{board}`
Lens model: {model}{prior}, frames of {camera.width} x {camera.height} px
Used: {num_views} views of {num_pictures} pictures, {num_corners} corners

{errors}

Errors are distances in the picture, over all corners. A held-out view is not used to fit the camera; only
its pose is fitted.

## Camera

{parameters}

Standard deviation of the rectified position, px: {corners}, from the standard deviations above. It is of the chosen
lens model; where the frame has no corners, another model may differ by more.

![Standard deviation of the rectified position](uncertainty.png)

{warnings}

![Corners in the frame](coverage.png)

## Views

Each view was left out of the fit in turn. The view that costs the others most comes first. A view is an
outlier if its held-out error is above its limit. All errors are in px rms.

{views}

![Reprojection errors](residuals.png){models}"""
_MODELS = """

## Choice of the lens model

The number in a name counts the coefficients that are fitted. The chosen model is the one of fewest coefficients, of
those that are one-to-one over the frame, with an error of held-out views within one standard error of the best one and
within two standard errors of the difference to it; of equal numbers, the one of the smallest error. Coefficients and
principal point have weak priors: the spread of published lenses.

{table}"""


class Calibration(NamedTuple):
    """A calibrated camera with the data that it was fitted to."""

    board: Board
    detections: Sequence[Detection]
    views: list[View]  # that fit each other
    fit: Fit  # to these views
    ranking: list[LeaveOneOut]  # of these views, the one that costs the others most first
    dropped: dict[str, str]  # the reason by the name of each dropped view
    held_out_rms: float  # error of views that the camera was not fitted to, px, by `cross_validate`
    candidates: Sequence[Candidate] = ()  # lens models that were tried; empty if the model was given


def calibrate_camera(
    detections: Sequence[Detection], board: Board, *, model: str, size: tuple[int, int], max_drop_share: float
) -> Calibration:
    """Fit a camera to all usable detections, at least four, without views that do not fit the others.

    The model "auto" is chosen by `choose_model`. The other arguments are those of `drop_outliers`. Raises ValueError if
    no camera fits the views.
    """
    views = [detection.view for detection in detections if not detection.problem]
    prior, candidates = "none", list[Candidate]()
    if model == AUTO:
        good = views
        with contextlib.suppress(ValueError):  # another model may fit
            first = drop_outliers(
                views, board, model=FIRST_MODEL, size=size, max_share=max_drop_share, prior=FIRST_PRIOR
            )
            good = first.views
        chosen, candidates = choose_model(good, board, size=size)
        model, prior = chosen.model, chosen.prior
    selection = drop_outliers(views, board, model=model, size=size, max_share=max_drop_share, prior=prior)
    held_out = cross_validate(selection.views, board, selection.fit)
    return Calibration(board, detections, *selection, rms(np.concatenate(held_out)), candidates)


def write_report(calibration: Calibration, read_gray: Callable[[str], np.ndarray], folder: Path) -> None:
    """Write report.md and its figures; `read_gray` returns (H, W), uint8, by the name of a view."""
    figures = _draw_coverage(calibration), _draw_residuals(calibration, read_gray), _draw_uncertainty(calibration.fit)
    for name, figure in zip(_FIGURES, figures, strict=True):
        write_figure(folder / name, figure)
    write_file(folder / REPORT_FILE, _report(calibration) + "\n")


def write_failure(board: Board, detections: Sequence[Detection], problem: str, folder: Path) -> None:
    """Write report.md of a failed calibration, and rename the results of an earlier one.

    An earlier camera.yaml becomes camera_before.yaml, so that it is not mistaken for the result of this run.
    """
    for name in (CAMERA_FILE, *_FIGURES):
        if (folder / name).is_file():
            (folder / name).replace(_earlier(folder / name))
    text = f"# Calibration\n\nThe calibration failed: {problem}\n\nBoard: `{board.describe()}`\n\n"
    if _earlier(folder / CAMERA_FILE).is_file():
        text += f"`{_earlier(folder / CAMERA_FILE).name}` is the camera of an earlier calibration.\n\n"
    rows = [(d.view.name, str(len(d.view.ids)), d.problem) for d in detections]
    write_file(folder / REPORT_FILE, text + _table(("picture", "corners", "problem"), rows) + "\n")


def _earlier(path: Path) -> Path:
    return path.with_name(f"{path.stem}_before{path.suffix}")


def _report(calibration: Calibration) -> str:
    fit, views, camera, board = calibration.fit, calibration.views, calibration.fit.camera, calibration.board
    errors = {
        "reprojection error": fit.rms,
        "reprojection error of held-out views": calibration.held_out_rms,
        "corners off straight lines, in the pictures": straightness(views, board),
        "corners off straight lines, rectified": straightness(undistort_views(views, camera), board),
    }
    parameters = zip(fit.names, fit.values, fit.deviations, strict=True)
    results = {view.name: (str(len(view.ids)), rms(e)) for view, e in zip(views, fit.errors, strict=True)}
    view_rows = []
    for one in calibration.ranking:
        num_corners, error = results[one.name]
        numbers = (f"{value:.3f}" for value in (error, one.error, one.limit, one.others))
        view_rows.append((one.name, num_corners, *numbers))
    text = _REPORT.format(
        board=board.describe(),
        model=fit.model,
        camera=camera,
        num_views=len(views),
        num_pictures=len(calibration.detections),
        num_corners=sum(len(view.ids) for view in views),
        errors=_table(("error", "px rms"), [(name, f"{value:.4f}") for name, value in errors.items()]),
        parameters=_table(
            ("parameter", "value", "standard deviation"),
            [(name, f"{value:.6g}", f"{deviation:.2g}") for name, value, deviation in parameters],
        ),
        prior=", principal point in the middle of the frame" if fit.prior == "centered" else "",
        corners=describe_corners(fit),
        models=_describe_models(calibration),
        warnings="\n".join(f"- {message}" for message in calibration_warnings(views, fit, calibration.candidates)),
        views=_table(("view", "corners", "error", "held-out error", "limit", "others without it"), view_rows),
    )
    unused = [(name, f"dropped: {reason}") for name, reason in calibration.dropped.items()]
    unused += [(d.view.name, d.problem) for d in calibration.detections if d.problem]
    return f"{text}\n\n## Pictures not used\n\n{_table(('picture', 'reason'), unused)}" if unused else text


def corner_deviations(fit: Fit) -> np.ndarray:
    """Return the standard deviations of the rectified position in the four corners, px; NaN without a ray."""
    right, bottom = fit.camera.width - 1.0, fit.camera.height - 1.0
    pixels = np.array([[0.0, 0.0], [right, 0.0], [0.0, bottom], [right, bottom]])
    return rectified_deviation(fit.camera, fit.covariance, pixels)


def describe_corners(fit: Fit) -> str:
    """Return the standard deviations of the rectified position in the corners of the frame as text."""
    names = ("upper left", "upper right", "lower left", "lower right")
    return ", ".join(f"{name} {value:.2g}" for name, value in zip(names, corner_deviations(fit), strict=True))


def _describe_models(calibration: Calibration) -> str:
    if not calibration.candidates:
        return ""
    fit, rows = calibration.fit, []
    for one in sorted(calibration.candidates, key=lambda one: (one.num_coefficients, one.held_out)):
        center = "in the middle" if one.prior == "centered" else "fitted"
        note = "chosen" if (one.model, one.prior) == (fit.model, fit.prior) else one.problem
        numbers = (f"{one.held_out:.4f}", f"{one.excess:.2f}", f"{one.paired_excess:.2f}")
        rows.append((one.model, center, str(one.num_coefficients), *numbers, note))
    head = ("lens model", "principal point", "coefficients", "held-out error, px rms")
    table = _table((*head, "excess, standard errors", "excess, standard errors of the difference", ""), rows)
    return _MODELS.format(table=table)


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    return "\n".join(f"| {' | '.join(cells)} |" for cells in (head, ["---"] * len(head), *rows))


def _draw_coverage(calibration: Calibration) -> Figure:
    """Draw all corners, over the number of corners in each cell of the frame."""
    camera, views = calibration.fit.camera, calibration.views
    figure, axes, extent = _frame_axes(camera)
    counts, (rows, columns) = corner_counts(views, (camera.width, camera.height)), CELLS
    image = axes.imshow(np.where(counts > 0, counts, np.nan), extent=extent, cmap="Blues", alpha=0.6, vmin=0)
    for j, i in zip(*np.nonzero(counts == 0), strict=True):
        place = ((i + 0.5) * camera.width / columns, (j + 0.5) * camera.height / rows)
        axes.text(*place, "none", ha="center", va="center", color="#b03000")
    corners = np.concatenate([view.corners for view in views])
    axes.plot(*corners.T, ".", markersize=3, color="#08306b")
    axes.set_title(f"{len(corners)} corners of {len(views)} views")
    figure.colorbar(image, ax=axes, label="corners in a cell of the frame", shrink=0.8)
    return figure


def _draw_residuals(calibration: Calibration, read_gray: Callable[[str], np.ndarray]) -> Figure:
    """Draw the views that cost the others most, each with the errors of its corners."""
    names, fit = [result.name for result in calibration.ranking[:_MAX_DRAWN]], calibration.fit
    results = {view.name: (view.corners, e) for view, e in zip(calibration.views, fit.errors, strict=True)}
    rows, aspect = -(-len(names) // _COLUMNS), fit.camera.height / fit.camera.width
    figure = Figure(figsize=(16, rows * (4 * aspect + 0.4) + 0.6), dpi=_DPI, layout="constrained")
    scale = _ARROW * fit.camera.width / max(fit.rms, 1e-6)
    figure.suptitle(f"detected minus projected corners, {scale:.0f} times enlarged; rms of all {fit.rms:.3f} px")
    for k, name in enumerate(names):
        axes, (corners, errors) = figure.add_subplot(rows, _COLUMNS, k + 1), results[name]
        gray = read_gray(name)
        axes.imshow(gray, cmap="gray", vmin=-255, vmax=255)  # pale, so that the arrows stand out
        options = {"angles": "xy", "scale_units": "xy", "scale": 1 / scale, "color": "#d00000", "width": 0.004}
        axes.quiver(*corners.T, *errors.T, **options)
        axes.set_xlim(-0.5, gray.shape[1] - 0.5)
        axes.set_ylim(gray.shape[0] - 0.5, -0.5)
        axes.set_axis_off()
        axes.set_title(f"{name}: {rms(errors):.3f} px", fontsize=10, parse_math=False)
    return figure


def _draw_uncertainty(fit: Fit) -> Figure:
    """Draw the standard deviation of the rectified position over the frame."""
    camera, (rows, columns) = fit.camera, _UNCERTAINTY_GRID
    x, y = np.meshgrid(np.linspace(0, camera.width - 1, columns), np.linspace(0, camera.height - 1, rows))
    deviation = rectified_deviation(camera, fit.covariance, np.stack([x.ravel(), y.ravel()], axis=1)).reshape(x.shape)
    figure, axes, extent = _frame_axes(camera)
    image = axes.imshow(deviation, extent=extent, cmap="viridis", vmin=0, interpolation="bilinear")
    if np.nanmax(deviation, initial=0.0) > MAX_DEVIATION_PX:
        axes.contour(x, y, deviation, levels=[MAX_DEVIATION_PX], colors="#ff5030")
    axes.set_title(f"standard deviation of the rectified position, px; the line is at {MAX_DEVIATION_PX:g} px")
    figure.colorbar(image, ax=axes, shrink=0.8)
    return figure


def _frame_axes(camera: Camera) -> tuple[Figure, Axes, tuple[float, float, float, float]]:
    """Return a figure of the frame of a camera, its axes, and the extent of a picture of the frame in them."""
    figure = Figure(figsize=(9.6, 9.6 * camera.height / camera.width + 0.9), dpi=_DPI, layout="constrained")
    return figure, figure.add_subplot(), (-0.5, camera.width - 0.5, camera.height - 0.5, -0.5)


def corner_counts(views: Sequence[View], size: tuple[int, int]) -> np.ndarray:
    """Count the corners in each of 6 x 8 cells of a frame of (width, height) px."""
    corners = np.concatenate([view.corners for view in views]) + 0.5
    limits = [(0, size[1]), (0, size[0])]
    return np.histogram2d(corners[:, 1], corners[:, 0], bins=CELLS, range=limits)[0].astype(int)


def calibration_warnings(views: Sequence[View], fit: Fit, candidates: Sequence[Candidate] = ()) -> list[str]:
    """Return warnings about a calibration: sides without corners, vague coefficients, refused models, the camera."""
    counts, messages = corner_counts(views, (fit.camera.width, fit.camera.height)), []
    empty = [
        f"{side} ({np.sum(counts[cells] == 0)} of {counts[cells].size} cells)"
        for side, cells in _SIDES.items()
        if (counts[cells] == 0).mean() >= 0.5
    ]
    if empty:
        messages.append(
            f"The frame has few corners at the {', '.join(empty)}: the model is extrapolated there. Add pictures with "
            "the board near the border."
        )
    rows = zip(fit.names[4:], fit.values[4:], fit.deviations[4:], strict=True)
    vague = [
        f"{name} = {value:.4g} +- {deviation:.2g}"
        for name, value, deviation in rows
        if deviation > 0 and abs(value) < _NUM_DEVIATIONS * deviation
    ]
    if vague and not candidates:  # held-out views choose the fewest coefficients
        messages.append(
            f"These coefficients are zero within two standard deviations: {', '.join(vague)}. A lens_model with fewer "
            "coefficients may be enough."
        )
    best = min((one for one in candidates if one.problem == FOLDS), key=lambda one: one.excess, default=None)
    if best is not None and best.excess < -1:
        messages.append(
            f"{best.model} has a held-out error of only {best.held_out:.3f} px rms, but {best.problem}. If the frame "
            f"is black there, as behind a circular fisheye, set lens_model={best.model}."
        )
    if (worst := np.nanmax(corner_deviations(fit), initial=0.0)) > MAX_DEVIATION_PX:
        messages.append(
            f"The rectified position of a corner of the frame has a standard deviation of {worst:.1f} px. Add pictures "
            "with the board in the corners, or use rectify with crop=true."
        )
    return [*messages, *camera_warnings(fit.camera)]


def camera_warnings(camera: Camera) -> list[str]:
    """Return warnings about a model that folds back, or has a pole, inside the frame."""
    messages = []
    if (share := camera.coverage()) < 1:
        messages.append(
            f"The model folds back inside the frame: {1 - share:.1%} of it has no ray. Use a lens_model with fewer "
            "coefficients, or add pictures with corners near the border."
        )
    try:
        camera.check_pole()
    except ValueError as error:
        messages.append(f"The model has a pole inside the frame: {error}. Use a lens_model with fewer coefficients.")
    return messages


def straightness(views: Sequence[View], board: Board) -> float:
    """Return the distance of corners of one row or column of a board from the line that fits them best, px rms.

        sqrt(sum d^2 / sum (n - 2)),  d the distances of the n corners of a line, over all lines with n >= 3

    A line has two parameters, so that noise of s px in each coordinate gives s.

    Raises:
        ValueError: no row or column has three corners.
    """
    squares, degrees_of_freedom = 0.0, 0
    for view in views:
        for axis in np.divmod(view.ids, board.num_corners[0]):  # rows, then columns
            for line in (view.corners[axis == k] for k in np.unique(axis)):
                if len(line) >= _MIN_LINE:
                    # The smaller singular value is the root of the sum of squared distances from the line.
                    squares += float(np.linalg.svd(line - line.mean(axis=0), compute_uv=False)[1]) ** 2
                    degrees_of_freedom += len(line) - 2
    if degrees_of_freedom == 0:
        raise ValueError(f"views must have {_MIN_LINE} corners of one row or column, got {len(views)} views without")
    return (squares / degrees_of_freedom) ** 0.5


def undistort_views(views: Sequence[View], camera: Camera) -> list[View]:
    """Undistort the corners of views, as the camera's pinhole shows them; corners without a ray are dropped."""
    results = [undistort_pixels(camera, view.corners) for view in views]
    return [view._replace(corners=pixels).only(valid) for view, (pixels, valid) in zip(views, results, strict=True)]
