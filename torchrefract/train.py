"""Train a model that restores images: `python -m torchrefract.train +task=undistort`.

Frames are degraded on the fly by a scene. The first lines say what is trained on. The run folder receives best.ckpt, of
the epoch with the fewest px or the most dB, last.ckpt, config.yaml, metrics.csv and pictures. The last lines compare
the model with doing nothing, and end in a verdict.

Options:
    +task=undistort         what to learn, required unless an experiment is given: undistort or deweather
    data=road_scenes        clean frames: road_scenes (rendered), frames (a folder) or pairs (of `generate`)
    data.root=DIR           folder of the frames or pairs; data.size=[64,112] crops and reduces them
    scene=NAME              degradation: cheap_dashcam, cape_town_fog, paper_refractive, paper_weather, ...
    camera=FILE             camera file of the frames, see cameras/README.md; horizon=0.5 of their height, 0 at the top
    model=NAME              network: lens_net (default of undistort), fog_net (of deweather), resunet, ddpm, ...
    trainer=cpu             hardware: cpu, gpu or ddp; trainer.max_epochs=12 sets the length; logger=tensorboard, wandb
    data.batch_size=8       frames in a step; data.workers=2 processes load them
    ckpt_path=FILE          last.ckpt of a stopped run, which is resumed; init_from=lens_small, or a checkpoint of the
                            same model, gives the weights to start with
    hydra.run.dir=DIR       run folder; seed=0 sets weights, order and degradations

Examples:
    python -m torchrefract.train +task=undistort data=frames data.root=frames trainer=gpu
    python -m torchrefract.train +experiment=table1_segformer_deweather scale=small data.root=frames
"""

from torchrefract.cli.entry import command

main = command("train", __doc__, "restoration:train")

if __name__ == "__main__":
    main()
