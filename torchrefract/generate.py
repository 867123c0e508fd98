"""Write pairs to disk: `python -m torchrefract.generate scene=paper_weather source=DIR out=DIR license="CC BY 4.0"`."""

import hydra
from omegaconf import DictConfig

from torchrefract._io import CONFIG_DIR
from torchrefract.cli.command import command, job, leave, quote_option
from torchrefract.cli.generation import generate


@command("generate", prepare=quote_option("license"))
@hydra.main(config_path=CONFIG_DIR, config_name="generate", version_base="1.3")
@job
def main(cfg: DictConfig) -> None:
    """Write the missing pairs of a set."""
    generate(cfg)


if __name__ == "__main__":
    main()
    leave()
