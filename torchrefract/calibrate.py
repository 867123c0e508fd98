"""Calibrate a camera with pictures of a board: `python -m torchrefract.calibrate images=pictures squares=11x8`."""

import sys
from collections.abc import Sequence
from pathlib import Path

import cv2
import hydra
from omegaconf import DictConfig

from torchrefract._io import CONFIG_DIR, replace_file
from torchrefract._validation import UsageError, check_choice, check_number
from torchrefract.board_views import Look, look_at, main_size, pictures_of, shown_instead
from torchrefract.calibration_report import CAMERA_FILE, Calibration, camera_of, set_aside, write_looks, write_report
from torchrefract.cameras.calibration.boards import Board
from torchrefract.cameras.calibration.coverage import faults
from torchrefract.cameras.calibration.fit import FEWEST_VIEWS, MODELS, held_out
from torchrefract.cameras.calibration.outliers import drop_outliers
from torchrefract.cameras.calibration.synthetic import CAMERA, VIEWS, render_views
from torchrefract.cameras.io.opencv import write_opencv
from torchrefract.cli.command import command, job, make, naming, progress

_RENDERED = "synthetic"
_NEEDED = FEWEST_VIEWS + 1  # views, so that each can be left out
_LONGEST = 300  # letters of what is said of single pictures in one line


@command("calibrate")
@hydra.main(config_path=CONFIG_DIR, config_name="calibrate", version_base="1.3")
@job
def main(cfg: DictConfig) -> None:
    """Find the corners, fit the camera, drop views that do not fit, write what came out."""
    board = make(cfg, "board")
    with naming("lens_model"):
        model = check_choice("lens_model", str(cfg.lens_model), MODELS)
    with naming("drop_share"):
        most = check_number("drop_share", cfg.drop_share, low=0.0, high=0.9)
    out = Path(str(cfg.out))
    with naming("out"):
        out.mkdir(parents=True, exist_ok=True)
    files = _rendered(board, out / "rendered") if str(cfg.images) == _RENDERED else pictures_of(Path(str(cfg.images)))
    looks = _look(files, board, out)
    try:
        found = _calibrate(files, looks, board, model, most)
    except (UsageError, ValueError) as error:
        aside = set_aside(out)
        write_looks(board, looks, str(error), aside, out)
        raise UsageError(f"{error} ({out / 'report.md'} tells of each picture)") from error
    write_opencv(out / CAMERA_FILE, found.camera)
    write_report(found, {file.name: file for file in files}, out)
    _tell(found, out)


def _rendered(board: Board, folder: Path) -> list[Path]:
    """Pictures of the board by a camera that is known, rendered unless they are there."""
    mark, made_by = folder / "rendered.txt", f"{board.describe()}\n{CAMERA}\n"
    if not mark.is_file() or mark.read_text(encoding="utf-8") != made_by:
        folder.mkdir(exist_ok=True)
        for name, picture, _ in progress(render_views(board), "rendering", count=VIEWS):
            with replace_file(folder / name) as path:
                cv2.imwrite(str(path), picture)
        with replace_file(mark) as path:
            path.write_text(made_by, encoding="utf-8")
    return pictures_of(folder)


def _look(files: Sequence[Path], board: Board, out: Path) -> list[Look]:
    return list(progress(look_at(files, board, out / "detections.jsonl"), "looking for the board", count=len(files)))


def _calibrate(files: Sequence[Path], looks: Sequence[Look], board: Board, model: str, most: float) -> Calibration:
    size = main_size(looks)
    looks = [_of_size(look, size) for look in looks]
    views = [look.view for look in looks if not look.reason]
    if len(views) < _NEEDED:
        reasons = "; ".join(f"{look.view.name}: {look.reason}" for look in looks if look.reason)
        shown = shown_instead(files, looks, board)
        raise UsageError(
            f"images must show the board ({board.describe()}) in {_NEEDED} pictures at least, got {len(views)}"
            f"{f'. {shown}' if shown else ''}{f'. {_cut(reasons)}' if reasons else ''}"
        )
    kept = drop_outliers(views, board, model=model, size=size, most=most)
    held = held_out(kept.views, board, kept.fitted, size=size)
    return Calibration(board, looks, kept, held, camera_of(kept.fitted, size))


def _of_size(look: Look, size: tuple[int, int]) -> Look:
    if look.reason or look.size == size:
        return look
    return look._replace(reason=f"{look.size[0]} x {look.size[1]} px, others are of {size[0]} x {size[1]}")


def _cut(text: str) -> str:
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST]} …"


def _tell(found: Calibration, out: Path) -> None:
    for name, reason in found.kept.dropped.items():
        print(f"{name} dropped: {reason}")
    for fault in faults(found.camera):
        print(f"warning: {fault}", file=sys.stderr)
    print(
        f"{out / CAMERA_FILE}: {found.fitted.lens.model} of {len(found.kept.views)} views in {len(found.looks)} "
        f"pictures, rms {found.fitted.rms:.3f} px, on views held out {found.held_rms:.3f} px; see {out / 'report.md'}"
    )


if __name__ == "__main__":
    main()
