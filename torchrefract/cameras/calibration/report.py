"""What a calibration came to: a report in Markdown and its pictures."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from torchrefract._io import replace_file
from torchrefract.cameras.calibration.boards import Board
from torchrefract.cameras.calibration.coverage import CELLS, coverage, doubts
from torchrefract.cameras.calibration.fit import Fit, rms
from torchrefract.cameras.calibration.outliers import Kept
from torchrefract.cameras.calibration.straightness import rectified, straightness
from torchrefract.cameras.camera import Camera
from torchrefract.cli.calibration import Look, read_gray

CAMERA_FILE = "camera.yaml"
_PICTURES = ("coverage.png", "residuals.png")
_DPI = 100
_SHOWN = 12  # views whose corners are drawn, those that cost the others most
_ACROSS = 4  # of them in a row
_ARROW = 0.05  # of the width of the frame, an error as long as the rms of all


class Calibration(NamedTuple):
    """A camera, and what it was found from."""

    board: Board
    looks: Sequence[Look]
    kept: Kept
    held: Sequence[np.ndarray]  # (N, 2) of each view, px, of `held_out`
    camera: Camera

    @property
    def fitted(self) -> Fit:
        """The camera and the poses."""
        return self.kept.fitted

    @property
    def held_rms(self) -> float:
        """px, of views that the camera was not fitted to."""
        return rms(np.concatenate(self.held))


def camera_of(fitted: Fit, size: tuple[int, int]) -> Camera:
    """The camera of a fit to pictures of that width and height."""
    fx, fy, cx, cy, *coefficients = fitted.lens.numbers.tolist()
    model = "fisheye" if fitted.lens.model == "fisheye" else "opencv"
    pinhole = {"width": size[0], "height": size[1], "fx": fx, "fy": fy, "cx": cx, "cy": cy}
    return Camera(**pinhole, coefficients=tuple(coefficients), model=model)


def write_report(found: Calibration, files: dict[str, Path], out: Path) -> None:
    """report.md, coverage.png and residuals.png in a folder.

    Args:
        found: the calibration.
        files: the pictures by the names of their views.
        out: the folder.
    """
    for name, figure in zip(_PICTURES, (_coverage(found), _residuals(found, files)), strict=True):
        with replace_file(out / name) as path:
            figure.savefig(path)
    _write(out / "report.md", _report(found))


def set_aside(out: Path) -> str:
    """What a calibration of before has left in a folder gets other names, so that it is not taken for that of today.

    Returns:
        The new name of its camera, or empty.
    """
    for name in (CAMERA_FILE, *_PICTURES):
        path = out / name
        if path.is_file():
            path.replace(_before(path))
    return _before(out / CAMERA_FILE).name if _before(out / CAMERA_FILE).is_file() else ""


def write_looks(board: Board, looks: Sequence[Look], problem: str, aside: str, out: Path) -> None:
    """report.md of a calibration that could not be: the problem, and what was seen in each picture.

    Args:
        board: that was looked for.
        looks: at the pictures.
        problem: why there is no camera.
        aside: the name of the camera of a calibration before, or empty.
        out: the folder.
    """
    lines = ["# Calibration", "", f"There is no camera: {problem}", "", f"Board: `{board.describe()}`", ""]
    if aside:
        lines += [f"`{aside}` is of a calibration before.", ""]
    _write(out / "report.md", [*lines, *_table(("picture", "corners", "remark"), [_looked(look) for look in looks])])


def _before(path: Path) -> Path:
    return path.with_name(f"{path.stem}_before{path.suffix}")


def _write(path: Path, lines: Sequence[str]) -> None:
    with replace_file(path) as temporary:
        temporary.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _looked(look: Look) -> tuple[str, ...]:
    return look.view.name, str(len(look.view.ids)), look.reason


def _report(found: Calibration) -> list[str]:
    fitted, views, camera = found.fitted, found.kept.views, found.camera
    corners = sum(len(view.ids) for view in views)
    numbers = zip(fitted.lens.names, fitted.lens.numbers, fitted.deviations, strict=True)
    lines = [
        "# Calibration",
        "",
        f"Board: `{found.board.describe()}`",
        f"Model: {fitted.lens.model}, frames of {camera.width} x {camera.height} px",
        f"Used: {len(views)} views of {len(found.looks)} pictures, {corners} corners",
        "",
        "| px | rms |",
        "| --- | --- |",
        f"| reprojection error | {fitted.rms:.4f} |",
        f"| the same on views held out | {found.held_rms:.4f} |",
        *_straight(found),
        "",
        "The rms is over corners, of the distance in the picture. A view held out is seen by a camera that was fitted",
        "to other views; only its pose is its own.",
        "",
        "## Camera",
        "",
        *_table(("", "value", "standard deviation"), [(n, f"{v:.6g}", f"{d:.2g}") for n, v, d in numbers]),
        "",
        *[f"- {doubt}" for doubt in doubts(views, fitted, camera)],
        "",
        "![Where the corners lie](coverage.png)",
        "",
        "## Views",
        "",
        "Each was left out in turn; those without which the others fit best come first. A view is an outlier from its",
        "limit on.",
        "",
        *_table(("view", "corners", "rms", "held out", "limit", "the others without it"), _ranked(found)),
        "",
        "![What is left over](residuals.png)",
    ]
    others = [(name, f"dropped: {reason}") for name, reason in found.kept.dropped.items()]
    others += [(look.view.name, look.reason) for look in found.looks if look.reason]
    return [*lines, "", "## Not used", "", *_table(("picture", "reason"), others)] if others else lines


def _straight(found: Calibration) -> list[str]:
    before, after = found.kept.views, rectified(found.kept.views, found.camera)
    places = (("in the pictures", before), ("rectified", after))
    return [f"| corners off straight lines, {name} | {straightness(v, found.board):.4f} |" for name, v in places]


def _ranked(found: Calibration) -> list[tuple[str, ...]]:
    own = {view.name: (len(view.ids), rms(e)) for view, e in zip(found.kept.views, found.fitted.errors, strict=True)}
    return [
        (
            left.name,
            str(own[left.name][0]),
            *(f"{v:.3f}" for v in (own[left.name][1], left.error, left.limit, left.others)),
        )
        for left in found.kept.ranking
    ]


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    return [f"| {' | '.join(cells)} |" for cells in (head, ["---"] * len(head), *rows)]


def _coverage(found: Calibration) -> Figure:
    camera, views = found.camera, found.kept.views
    figure = Figure(figsize=(9.6, 9.6 * camera.height / camera.width + 0.9), dpi=_DPI, layout="constrained")
    axes = figure.add_subplot()
    counts, (rows, columns) = coverage(views, (camera.width, camera.height)), CELLS
    extent = (-0.5, camera.width - 0.5, camera.height - 0.5, -0.5)
    shown = axes.imshow(np.where(counts > 0, counts, np.nan), extent=extent, cmap="Blues", alpha=0.6, vmin=0)
    for j, i in zip(*np.nonzero(counts == 0), strict=True):
        place = ((i + 0.5) * camera.width / columns, (j + 0.5) * camera.height / rows)
        axes.text(*place, "none", ha="center", va="center", color="#b03000")
    corners = np.concatenate([view.corners for view in views])
    axes.plot(*corners.T, ".", markersize=3, color="#08306b")
    axes.set_title(f"{len(corners)} corners of {len(views)} views")
    figure.colorbar(shown, ax=axes, label="corners in a part of the frame", shrink=0.8)
    return figure


def _residuals(found: Calibration, files: dict[str, Path]) -> Figure:
    """The views that cost the others most, each with its corners and what the camera leaves over."""
    names = [left.name for left in found.kept.ranking[:_SHOWN]]
    by_name = {view.name: i for i, view in enumerate(found.kept.views)}
    rows, shape = -(-len(names) // _ACROSS), found.camera.height / found.camera.width
    figure = Figure(figsize=(16, rows * (4 * shape + 0.4) + 0.6), dpi=_DPI, layout="constrained")
    scale = _ARROW * found.camera.width / max(found.fitted.rms, 1e-6)
    figure.suptitle(
        f"corners found less corners expected, {scale:.0f} times as long; rms of all {found.fitted.rms:.3f} px"
    )
    for k, name in enumerate(names):
        _draw_view(figure.add_subplot(rows, _ACROSS, k + 1), found, by_name[name], read_gray(files[name]), scale)
    return figure


def _draw_view(axes: Axes, found: Calibration, i: int, gray: np.ndarray, scale: float) -> None:
    view, errors = found.kept.views[i], found.fitted.errors[i]
    axes.imshow(gray, cmap="gray", vmin=-255, vmax=255)  # pale, so that arrows are seen
    axes.quiver(
        *view.corners.T, *errors.T, angles="xy", scale_units="xy", scale=1 / scale, color="#d00000", width=0.004
    )
    axes.set_xlim(-0.5, gray.shape[1] - 0.5)
    axes.set_ylim(gray.shape[0] - 0.5, -0.5)
    axes.set_axis_off()
    axes.set_title(f"{view.name}: {rms(errors):.3f} px", fontsize=10, parse_math=False)
