"""Export a model for other programs: `python -m torchrefract.export ckpt_path=<run>/best.ckpt out=model.onnx`."""

import hydra
from omegaconf import DictConfig

from torchrefract._io import CONFIG_DIR
from torchrefract.cli.command import command, job
from torchrefract.cli.restoration import export


@command("export")
@hydra.main(config_path=CONFIG_DIR, config_name="export", version_base="1.3")
@job
def main(cfg: DictConfig) -> None:
    """Export the model of a checkpoint."""
    export(cfg)


if __name__ == "__main__":
    main()
