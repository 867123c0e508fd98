"""Score a checkpoint: `python -m torchrefract.eval ckpt_path=<run>/best.ckpt`.

By default, the model, the validation frames and their degradation are those of the checkpoint, so the scores are those
of its training. Options change single values; the first line says what is scored.

Options:
    ckpt_path=FILE          a checkpoint of `train`, or lens_small, required
    data=frames             other frames: road_scenes (rendered), frames (a folder) or pairs (of `generate`)
    data.root=DIR           folder of the frames or pairs; data.size=[64,112] crops and reduces them
    scene=NAME              another degradation: cheap_dashcam, cape_town_fog, paper_refractive, paper_weather, ...
    scene.severity=3        1 to 5
    data.border=black       a black or mirrored border, where frames padded by the lens would have one; names the rows
    model.steps=50          of a diffusion model
    data.batch_size=16      frames in a step; data.workers=2 processes load them
    trainer=gpu             hardware: cpu, gpu or ddp
    hydra.run.dir=DIR       folder of metrics.csv and panel.png

Examples:
    python -m torchrefract.eval ckpt_path=runs/undistort/2026-01-01_10-00-00/best.ckpt
    python -m torchrefract.eval ckpt_path=best.ckpt data.root=other_frames trainer=gpu
"""

from torchrefract.cli.entry import command

main = command("eval", __doc__, "restoration:evaluate")

if __name__ == "__main__":
    main()
