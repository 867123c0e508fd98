"""Accuracy of lenses that are estimated from the frames of a drive, without a board.

    python benchmarks/lens_estimation.py  # rendered roads through a known lens, and without a lens
    python benchmarks/lens_estimation.py --data DATA [--sets ca280_1280 ...]  # real cameras with a calibration
    python benchmarks/lens_estimation.py --checkpoint lens_small  # also by a network, and by both together
    python benchmarks/lens_estimation.py --drives FRAMES --without us_  # single frames of held-out drives
    python benchmarks/lens_estimation.py --checkpoint lens_small --clip 100  # speed, and how still the lens is

DATA holds frames/train/ca280_*.jpg and fullres/ca280_*.jpg, of the camera of chessboard/udacity_p4, and folders of
chessboard and charuco, with a reference.json each. The calibrated camera is that of OpenCV with five coefficients, or
for charuco, whose corners leave the border open, the published one. The constants of the estimate were chosen on ca280
and pjlab_wide; the sets of charuco were not looked at for that.

"error" is the mean distance, px of a frame 1920 px wide, between where the estimated and the calibrated camera show
the pixels of the rectified frame. Both rectified frames have their principal point at its place and a magnification of
1 there, as the flow of `rectify`. "nothing" is the same for the frames as they are. Pools are drawn at random; medians
over the draws. "rectified" rows are the same frames after `rectify` by the calibrated camera: their lens is none.
"lines" is the distance of corners of one row or column from a straight line, px rms, before and after.

--drives degrades each frame of FRAMES/val by four lenses of `cheap_dashcam` in turn, the first that of a validation of
the task undistort, and estimates the flow of each picture alone, by straight edges: the mean of the flows of 256 lenses
that the effect draws, weighted by their likelihood. "constant" is their mean without weights. For "both" they are
weighted also by a normal distribution around the flow of the network, of 20 px. --pool sees all frames of a drive
through one lens, as a camera does, each drive through four lenses in turn, and estimates it from all of them: the
likelihoods of 2,048 lenses, and the mean flow of the network. --wide takes the wide lens of Table 1 instead. --without
leaves out frames whose own lens shows, by the beginnings of their names.

--clip writes a video of that many frames, which pan over a rendered road behind a lens that stays, and restores it
frame by frame and with `pool=lens`. "jitter" is the mean change of the flow from a frame to the next, px of a frame
1920 px wide: 0 for the true lens.
"""

import argparse
import json
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import pairwise
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
import torch
from calibration import board_from_entry, camera_from_entry
from severity import gray_levels
from table1 import wide_lens
from timing import RESULTS, count, seconds, write_json
from torch import Tensor

from torchrefract._tensor import to_float, to_uint8
from torchrefract.cameras.calibration import estimate_lens
from torchrefract.cameras.calibration.detection import detect, has_enough_corners
from torchrefract.cameras.calibration.lens_estimate import pool_lenses, radial_lens_of_flow
from torchrefract.cameras.calibration.plumb_line import (
    LineFit,
    find_chains,
    fit_lens,
    is_distinct,
    line_costs,
    pool_chains,
    published_prior,
)
from torchrefract.cameras.calibration.report import straightness, undistort_views
from torchrefract.cameras.camera import Camera
from torchrefract.cli.calibration import find_pictures, read_gray
from torchrefract.cli.estimation import Predictor, flow_predictor
from torchrefract.data.frames import FrameFolder
from torchrefract.data.images import pixels_of, read_image
from torchrefract.data.road_scenes import render_road_scenes
from torchrefract.data.video import convert_video, read_video, write_video
from torchrefract.effects.base import Effect
from torchrefract.fields.rectification import camera_flow
from torchrefract.presets import cheap_dashcam
from torchrefract.restoration.checkpoints import load_model
from torchrefract.restoration.inference import LensRestorer, Restorer
from torchrefract.restoration.tasks import Restored
from torchrefract.warping.flow import resize_flow
from torchrefract.warping.warp import warp

SETS = {  # name: pictures, and the folder with reference.json, its entry and the calibration there
    "ca280_1280": ("fullres/ca280_*.jpg", "chessboard", "udacity_p4", "opencv_5param"),
    "ca280_640": ("frames/train/ca280_*.jpg", "chessboard", "udacity_p4", "opencv_5param"),
    "pjlab_wide": ("chessboard/pjlab_wide/*.jpg", "chessboard", "pjlab_wide", "opencv_5param"),
    "caliscope_cam0": ("charuco/caliscope_cam0/*.jpg", "charuco", "caliscope_cam0", "published"),
    "caliscope_cam1": ("charuco/caliscope_cam1/*.jpg", "charuco", "caliscope_cam1", "published"),
    "opencv_tutorial": ("charuco/opencv_tutorial/*.jpg", "charuco", "opencv_tutorial", "published"),
}
RENDERED_LENS = (-0.16, 0.06)  # relative to the half diagonal
_NUM_RENDERED, _RENDERED_SIZE, _SHRINK = 30, (720, 1280), 0.7
_POOLS = {1: 7, 5: 5, 20: 3}  # number of draws by the number of frames
_WIDTH = 1920  # px, of errors
_GRID = 41
_NUM_LENSES, _FLOW_STRIDE = 256, 8  # of the prior of single frames; px
_NUM_POOLED_LENSES, _NUM_DRAWS = 2048, 4  # of the prior of drives; lenses that each frame or drive is seen through
_NETWORK_PX = 20  # px at 1920, standard deviation of the flow of a network: 1.25 times its mean error of 16 px
_PRIOR_SEED = 123  # another one than that of the frames


class Network(NamedTuple):
    """A network and the mean of the flows that it was trained on."""

    predict: Predictor
    constant: Tensor  # (1, 2, h, w)


class EffectPrior(NamedTuple):
    """Lenses that an effect draws, and the flows that undo them."""

    lenses: Tensor  # (L, 2), relative to the half diagonal
    flows: Tensor  # (L, 2, h, w), px of the frames, at every eighth pixel


class Row(NamedTuple):
    """The errors of a set of frames."""

    name: str
    method: str  # "lines", "network", "both" or "constant", the lens of the mean flow of the network's training
    frames: int
    error: float
    nothing: float
    distinct: float  # share of the draws that can be distinguished from no distortion
    straight: float  # chains


def to_camera(coefficients: Tensor, size: tuple[int, int]) -> Camera:
    """Return a camera whose focal length is the half diagonal."""
    (height, width), half_diagonal = size, float(np.hypot(*size)) / 2
    k1, k2 = coefficients.tolist()
    center: dict[str, Any] = {"cx": (width - 1) / 2, "cy": (height - 1) / 2}
    return Camera(
        width=width, height=height, fx=half_diagonal, fy=half_diagonal, **center, coefficients=(k1, k2, 0.0, 0.0)
    )


def shown_at(camera: Camera, pixels: Tensor) -> tuple[Tensor, Tensor]:
    """Return where the camera shows the pixels of its rectified frame, and which of them it does."""
    shown, valid, _ = camera.project(camera.without_lens().unproject(pixels).points)
    last = torch.tensor([camera.width - 1, camera.height - 1])
    return shown, valid & (shown >= 0).all(dim=1) & (shown <= last).all(dim=1)


def errors(estimate: Camera, truth: Camera) -> tuple[float, float]:
    """Return the mean error of an estimate and of doing nothing, px of a frame 1920 px wide."""
    pixels, scale = truth.grid(_GRID), _WIDTH / truth.width
    expected, is_shown = shown_at(truth, pixels)
    estimated, _ = shown_at(estimate, pixels)
    error, nothing = (scale * (at - expected)[is_shown].norm(dim=1).mean().item() for at in (estimated, pixels))
    return error, nothing


def measure(
    name: str, frames: Sequence[Tensor], truth: Camera, *, network: Network | None = None
) -> tuple[list[Row], Camera]:
    """Estimate the lens from pools of frames (1, 3, H, W); return the rows and the camera of all frames by lines."""
    size, random = (truth.height, truth.width), np.random.default_rng(0)
    chains = [find_chains(gray_levels(frame[0])) for frame in frames]
    aspect = truth.width / truth.height
    lenses = torch.stack([radial_lens_of_flow(network.predict(f), aspect=aspect) for f in frames]) if network else None
    rows, camera = [], truth
    for number, draws in {**{n: d for n, d in _POOLS.items() if n < len(frames)}, len(frames): 1}.items():
        results: dict[str, list[tuple[float, float, bool, int]]] = {}
        for _ in range(draws):
            chosen = random.choice(len(frames), number, replace=False)
            pool = pool_chains([chains[i] for i in chosen], size)
            fits = {"lines": fit_lens(pool, published_prior())}
            camera = to_camera(fits["lines"].coefficients, size)
            if network and lenses is not None:
                prior, none = pool_lenses(lenses[chosen]), fits["lines"].is_straight & False
                constant = radial_lens_of_flow(network.constant, aspect=aspect)
                fits["network"] = LineFit(prior.mean, prior.covariance, is_distinct(prior.mean, prior.covariance), none)
                fits["both"] = fit_lens(pool, prior)
                fits["constant"] = fits["network"]._replace(coefficients=constant, is_distorted=False)
            for method, fit in fits.items():
                error = errors(to_camera(fit.coefficients, size), truth)
                results.setdefault(method, []).append((*error, fit.is_distorted, int(fit.is_straight.sum())))
        for method, of_draws in results.items():
            error, nothing, distinct, straight = zip(*of_draws, strict=True)
            row = Row(name, method, number, median(error), nothing[0], sum(distinct) / draws, median(straight))
            rows.append(row)
            print(
                f"{name:26}{number:4} frames  {method:9}error {row.error:6.1f}  nothing {row.nothing:6.1f}  "
                f"distinct in {row.distinct:4.0%}  straight edges {row.straight:4.0f}",
                flush=True,
            )
    return rows, camera


def lens_flow(lens: tuple[float, float]) -> tuple[Camera, Tensor]:
    """Return the camera of a lens, relative to the half diagonal, and the flow that shows a part of rendered frames."""
    camera, (height, width) = to_camera(torch.tensor(lens), _RENDERED_SIZE), _RENDERED_SIZE
    y, x = torch.meshgrid(torch.arange(height).double(), torch.arange(width).double(), indexing="ij")
    pixels = torch.stack([x, y], dim=-1).reshape(-1, 2)
    rectified = camera.without_lens(zoom=_SHRINK).project(camera.unproject(pixels).points).points
    return camera, (rectified - pixels).T.reshape(1, 2, height, width).float()


def rendered(lens: tuple[float, float]) -> tuple[list[Tensor], Camera]:
    """Render roads through a lens."""
    (camera, flow), frames = lens_flow(lens), []
    for key in range(_NUM_RENDERED):
        image, _ = render_road_scenes(torch.tensor([key]), *_RENDERED_SIZE)
        frames.append(warp(image, flow, interpolation="bicubic")[0])
    return frames, camera


def render_clip(num_frames: int, path: Path) -> None:
    """Write a video of frames that pan over a rendered road behind the lens of `rendered`, ten a second."""
    height, width = _RENDERED_SIZE
    image, _ = render_road_scenes(torch.tensor([0]), height, 2 * width)
    flow = lens_flow(RENDERED_LENS)[1]
    starts = (width * (1 + np.sin(2 * np.pi * np.arange(num_frames) / num_frames)) / 2).round().astype(int)
    views = (image[..., start : start + width] for start in starts)
    pictures = (pixels_of(warp(view, flow, interpolation="bicubic")[0][0]) for view in views)
    write_video(pictures, path, fps=10, size=(width, height))


def jitter(flows: Sequence[Tensor]) -> float:
    """Return the mean change of flows (1, 2, H, W) from each to the next, px of a frame 1920 px wide."""
    changes = [(after - before).norm(dim=1).mean().item() for before, after in pairwise(flows)]
    return _WIDTH / flows[0].shape[3] * sum(changes) / len(changes)


def measure_clip(num_frames: int, restorer: Restorer, predict: Predictor) -> dict[str, dict[str, float]]:
    """Restore a clip and estimate its lens; return frames per second of the processor, and jitter and error, px."""
    with TemporaryDirectory() as folder:
        clip, results = Path(folder, "clip.mp4"), dict[str, dict[str, float]]()
        render_clip(num_frames, clip)

        def frames() -> Iterator[Tensor]:
            return (frame for _, frame in read_video(clip, range(num_frames)))

        def convert(restore: Callable[[Sequence[Tensor]], list[Restored]]) -> None:
            out = Path(folder, "restored.mp4")
            convert_video(clip, out, change=lambda views: (pixels_of(restore([v[0]])[0].image[0]) for v in views))

        cameras: dict[str, Camera] = {}
        for name, network in {"estimate_lens, lines": None, "estimate_lens, both": predict}.items():
            start = time.process_time()
            cameras[name] = estimate_lens(frames(), predict=network).camera
            results[name] = {"frames_per_second": num_frames / (time.process_time() - start)}
            results[name]["error_px"], results[name]["nothing_px"] = errors(cameras[name], lens_flow(RENDERED_LENS)[0])
        pooled = LensRestorer(cameras["estimate_lens, both"])
        for name, restore in {"restore, each frame": restorer.restore, "restore, pool=lens": pooled.restore}.items():
            spent = seconds(partial(convert, restore), clock=time.process_time)
            results[name] = {"frames_per_second": num_frames / spent}
        results["restore, each frame"]["jitter_px"] = jitter([predict(frame) for frame in frames()])
        still = [camera_flow(pooled.camera)[0]] * 2  # one flow for all frames
        results["restore, pool=lens"]["jitter_px"] = jitter(still)
    return results


def sparse(flow: Tensor) -> Tensor:
    """Return every eighth pixel of flows (B, 2, H, W)."""
    return flow[..., _FLOW_STRIDE // 2 :: _FLOW_STRIDE, _FLOW_STRIDE // 2 :: _FLOW_STRIDE].double()


def draw_prior(effect: Effect, size: tuple[int, int], *, count: int) -> EffectPrior:
    """Draw lenses of an effect for frames of a size."""
    blank = torch.zeros(1, 3, *size)
    flows = [effect.degrade(blank, seed=_PRIOR_SEED, keys=[key]).restore_flow for key in range(count)]
    return EffectPrior(
        torch.stack([radial_lens_of_flow(flow) for flow in flows]), torch.cat([sparse(f) for f in flows])
    )


def costs_of_lenses(grays: Sequence[np.ndarray], prior: EffectPrior) -> Tensor:
    """Return the negative log-likelihood (L,) of the lenses of a prior in pictures (H, W) of one camera."""
    chains = pool_chains([find_chains(gray) for gray in grays], (grays[0].shape[0], grays[0].shape[1]))
    return torch.cat([line_costs(chains, lenses) for lenses in prior.lenses.split(16)]).sum(dim=1)


def posterior_flow(costs: Tensor, prior: EffectPrior) -> Tensor:
    """Return the mean flow (2, h, w) of the lenses of a prior, weighted by their costs (L,)."""
    return torch.einsum("l,lchw->chw", torch.softmax(-costs, dim=0), prior.flows)


def held_out(
    root: Path,
    size: tuple[int, int],
    without: Sequence[str] = (),
    *,
    effect: Effect | None = None,
    network: Network | None = None,
    pool: bool = False,
) -> list[dict[str, Any]]:
    """Estimate the flow of each frame of held-out drives alone, or of all frames of a drive together.

    Returns and prints errors, px of a frame 1920 px wide.
    """
    frames, effect, rows = FrameFolder(root, size=size, split="val"), effect or cheap_dashcam(), list[dict[str, Any]]()
    prior = draw_prior(effect, size, count=_NUM_POOLED_LENSES if pool else _NUM_LENSES)
    mean, scale = prior.flows.mean(dim=0), _WIDTH / size[1]
    groups: dict[str, list[int]] = {}
    for i, path in enumerate(frames.paths):
        if not path.name.startswith(tuple(without)):
            name = frames.drive_names[i] if pool else path.relative_to(root).as_posix()
            groups.setdefault(name, []).append(i)
    for name, members in groups.items():
        for seed in range(_NUM_DRAWS):  # with seed 0, a frame alone has the draw of a validation
            draw: dict[str, Any] = {"seed": seed, "keys": [frames.keys[members[0]]]}
            pairs = [effect.degrade(frames[i].image[None], **draw) for i in members]
            true = sparse(pairs[0].restore_flow)[0]
            costs = costs_of_lenses([gray_levels(pair.image[0]) for pair in pairs], prior)
            flows = {"nothing": 0 * true, "constant": mean, "lines": posterior_flow(costs, prior)}
            if network:
                predicted = [sparse(resize_flow(network.predict(pair.image), size)) for pair in pairs]
                flows["network"] = torch.cat(predicted).mean(dim=0)
                distance = scale * (prior.flows - flows["network"]).norm(dim=1).mean(dim=(1, 2))
                flows["both"] = posterior_flow(costs + (distance / _NETWORK_PX).square() / 2, prior)
            error = {kind: scale * (flow - true).norm(dim=0).mean().item() for kind, flow in flows.items()}
            rows.append({"frame": name, **error})
    means = {kind: sum(row[kind] for row in rows) / len(rows) for kind in rows[0] if kind != "frame"}
    unit = "drives" if pool else "frames"
    print(
        f"{len(rows)} lenses of {len(groups)} {unit}",
        *(f"{kind} {value:.2f}" for kind, value in means.items()),
        sep="  ",
    )
    return rows


def rectify(frame: Tensor, flow: Tensor) -> Tensor:
    """Warp a frame along a flow, and round it to bytes."""
    return to_float(to_uint8(warp(frame, flow, interpolation="bicubic")[0]))


def board_lines(folder: Path, name: str, estimate: Camera) -> tuple[float, float]:
    """Return the straightness of the corners of a chessboard in pictures, and after rectification, px rms."""
    board = board_from_entry(json.loads((folder / "reference.json").read_text())[name])
    grays = {path.name: read_gray(path) for path in find_pictures(folder / name)}
    grays = {key: gray for key, gray in grays.items() if gray.shape == (estimate.height, estimate.width)}
    views = [view for key, gray in grays.items() if has_enough_corners(view := detect(gray, board, name=key), board)]
    return straightness(views, board), straightness(undistort_views(views, estimate), board)


def real(data: Path, sets: Sequence[str], network: Network | None) -> list[Row]:
    """Measure sets of real frames, and the same after rectification by the calibrated camera."""
    rows = []
    for name in sets:
        pattern, folder, entry, calibration = SETS[name]
        frames = [read_image(path)[None] for path in sorted(data.glob(pattern))]
        reference = json.loads((data / folder / "reference.json").read_text())[entry]
        truth = camera_from_entry(reference[calibration], reference["image_size"])
        camera = truth.resized(width=frames[0].shape[3], height=frames[0].shape[2])
        measured, estimate = measure(name, frames, camera, network=network)
        flow = camera_flow(camera)[0]
        none = to_camera(torch.zeros(2), (camera.height, camera.width))
        rectified = [rectify(frame, flow) for frame in frames]
        rows += measured + measure(f"{name}, rectified", rectified, none, network=network)[0]
        resized = estimate.resized(width=truth.width, height=truth.height)
        before, after = board_lines(data / folder, entry, resized)
        print(f"{name:26} lines of the board {before:.2f} px, {after:.2f} px after rectification", flush=True)
    return rows


def main() -> None:
    """Print the rows and write them as JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, help="folder of real frames and chessboards")
    parser.add_argument("--checkpoint", help="of a training of the task undistort")
    parser.add_argument("--clip", type=count(2), help="frames of a clip, whose restoration is measured instead")
    parser.add_argument(
        "--drives", type=Path, help="folder with sub-folders train and val, whose frames are scored alone"
    )
    parser.add_argument(
        "--size", nargs=2, type=count(1), default=[352, 616], help="height and width of those frames, px"
    )
    parser.add_argument("--wide", action="store_true", help="degrade them by the wide lens of Table 1 instead")
    parser.add_argument("--pool", action="store_true", help="estimate one lens for all frames of a drive")
    parser.add_argument("--without", nargs="+", default=[], help="beginnings of the names of frames to leave out")
    parser.add_argument("--sets", nargs="+", choices=list(SETS), default=list(SETS))
    parser.add_argument("--out", type=Path, default=RESULTS / "lens_estimation.json")
    arguments = parser.parse_args()
    network = None
    if arguments.checkpoint:
        loaded = load_model(arguments.checkpoint)
        model: Any = loaded.model
        constant = model.constant_flow(torch.zeros(1, 2, *loaded.size))
        network = Network(flow_predictor(model, loaded.size, torch.device("cpu")), constant)
        if arguments.clip:
            results = measure_clip(arguments.clip, Restorer(model, size=loaded.size), network.predict)
            for name, values in results.items():
                print(f"{name:22}", *(f"{key} {value:.2f}" for key, value in values.items()), sep="  ")
            return write_json(arguments.out.with_name("clip.json"), results)
    elif arguments.clip:
        parser.error("--clip needs --checkpoint, such as lens_small")
    if arguments.drives:
        effect = wide_lens() if arguments.wide else cheap_dashcam()
        size, options = tuple(arguments.size), {"effect": effect, "network": network, "pool": arguments.pool}
        rows = held_out(arguments.drives, size, arguments.without, **options)
        return write_json(arguments.out.with_name("held_out.json"), rows)
    if arguments.data:
        rows = real(arguments.data, arguments.sets, network)
    else:
        lenses = {"rendered roads, barrel": RENDERED_LENS, "rendered roads, no lens": (0.0, 0.0)}
        rows = [row for name, lens in lenses.items() for row in measure(name, *rendered(lens), network=network)[0]]
    write_json(arguments.out, [row._asdict() for row in rows])


if __name__ == "__main__":
    main()
