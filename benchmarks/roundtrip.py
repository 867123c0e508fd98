"""How much of a frame comes back when an effect is undone, and how exact the flow that undoes it is.

python benchmarks/roundtrip.py FOLDER [--frames 8] [--out benchmarks/results/roundtrip.json]

FOLDER holds frames, such as ../shared/data/fullres. Every number is a mean over the frames, but for the residual and
the share of valid pixels, which are the worst of all. PSNR in dB, on valid pixels: of the degraded frame as it is, of
the one restored along -flow, and of the one restored along restore_flow, bilinear and bicubic.
"""

import argparse
import json
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
from torch import Tensor

from torchrefract import DivergenceFree, LensDistortion, ThinPlateSpline, Turbulence, compose_flows, warp
from torchrefract._io import replace_file
from torchrefract.data.images import EXTENSIONS, read_image
from torchrefract.effects.refraction import WarpEffect
from torchrefract.warping.grid import length

EFFECTS: dict[str, Callable[[str], WarpEffect]] = {
    "LensDistortion": lambda mode: LensDistortion(interpolation=mode),
    "Turbulence": lambda mode: Turbulence(interpolation=mode),
    "Turbulence, strong": lambda mode: Turbulence(
        amplitude_range=(3.0, 3.0), length_range=(60.0, 60.0), aperture_range=(3.0, 3.0), interpolation=mode
    ),
    "ThinPlateSpline": lambda mode: ThinPlateSpline(interpolation=mode),
    "ThinPlateSpline, strong": lambda mode: ThinPlateSpline(amplitude_range=(25.0, 25.0), interpolation=mode),
    "DivergenceFree": lambda mode: DivergenceFree(interpolation=mode),
    "DivergenceFree, strong": lambda mode: DivergenceFree(
        amplitude_range=(8.0, 8.0), length_range=(60.0, 60.0), interpolation=mode
    ),
    "LensDistortion, strong": lambda mode: LensDistortion(
        k1_range=(-0.4, -0.35),
        k2_range=(0.12, 0.15),
        p1_range=(0.004, 0.004),
        focal_range=(0.6, 0.6),
        interpolation=mode,
    ),
}


@dataclass
class Row:
    """What one effect does to the frames."""

    effect: str
    residual_px: float
    valid: float
    nothing: float
    negated: float
    bilinear: float
    bicubic: float


def measure(name: str, frames: list[Tensor]) -> Row:
    """The figures of an effect over frames (3, H, W)."""
    found = []
    for key, frame in enumerate(frames):
        clean = frame[None]
        by_mode = {m: EFFECTS[name](m).degrade(clean, seed=7, keys=[key]) for m in ("bilinear", "bicubic")}
        made = by_mode["bilinear"]
        flow, back, valid = made.flow, made.restore_flow, made.restore_valid
        residual = length(compose_flows(flow.double(), back.double()))[valid].max()
        restored = {mode: warp(d.image, back, interpolation=mode)[0] for mode, d in by_mode.items()}
        images = (made.image, warp(made.image, -flow)[0], restored["bilinear"], restored["bicubic"])
        found.append([residual, valid.double().mean(), *(psnr(image, clean, valid) for image in images)])
    values = torch.tensor(found, dtype=torch.float64)
    return Row(name, values[:, 0].max().item(), values[:, 1].min().item(), *values[:, 2:].mean(dim=0).tolist())


def psnr(image: Tensor, clean: Tensor, valid: Tensor) -> Tensor:
    """(), dB, on the valid pixels."""
    error = (image.clamp(0, 1) - clean).double().square()[valid.expand_as(clean)].mean()
    return -10 * error.log10()


def main() -> None:
    """Measure, print and save."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path, help="frames, of any size")
    parser.add_argument("--frames", type=int, default=8, help="so many of them, 8")
    parser.add_argument(
        "--out", type=Path, default=Path(__file__).parent / "results" / "roundtrip.json", help="the JSON"
    )
    args = parser.parse_args()
    paths = sorted(path for path in args.folder.rglob("*") if path.suffix.lower() in EXTENSIONS)[: args.frames]
    if not paths:
        parser.error(f"folder must hold frames, got {args.folder}")
    frames = [read_image(path) for path in paths]
    sizes = sorted({f"{frame.shape[2]}x{frame.shape[1]}" for frame in frames})
    print(f"{len(frames)} frames of {', '.join(sizes)}; PSNR in dB on restore_valid\n")
    print(f"{'effect':26} residual px  valid  nothing  -flow  restore bilinear  bicubic")
    rows = []
    for name in EFFECTS:
        row = measure(name, frames)
        rows.append(row)
        print(
            f"{name:26} {row.residual_px:11.1e}  {row.valid:5.3f}  {row.nothing:7.2f}  {row.negated:5.2f}"
            f"  {row.bilinear:16.2f}  {row.bicubic:7.2f}",
            flush=True,
        )
    args.out.parent.mkdir(parents=True, exist_ok=True)
    with replace_file(args.out) as temporary:
        temporary.write_text(json.dumps([asdict(row) for row in rows], indent=2) + "\n", encoding="utf-8")
    print(f"written to {args.out}")


if __name__ == "__main__":
    main()
