"""What the commands that train or score a model share."""

from pathlib import Path
from typing import Any, NamedTuple, cast

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf
from pytorch_lightning import LightningModule, Trainer, seed_everything
from pytorch_lightning.utilities.exceptions import MisconfigurationException

from torchrefract._io import replace_file
from torchrefract._validation import UsageError
from torchrefract.cli.command import check_seed, make, naming
from torchrefract.data.fingerprint import fingerprint
from torchrefract.data.module import PairData
from torchrefract.restoration.checkpoints import Origin, check_fits, read_checkpoint
from torchrefract.restoration.models.pretrained import weights_license


class Job(NamedTuple):
    """What a command works with."""

    data: PairData
    model: LightningModule
    trainer: Trainer


def make_job(cfg: DictConfig, *, needs_checkpoint: bool = False) -> Job:
    """Data, model and trainer of a configuration, the checkpoint checked, the resolved configuration written."""
    OmegaConf.resolve(cfg)
    seed_everything(check_seed(cfg.seed), workers=True, verbose=False)
    if needs_checkpoint and cfg.ckpt_path is None:
        raise UsageError("ckpt_path must be the path of a checkpoint: add ckpt_path=<run>/best.ckpt, got none")
    path = Path(cfg.ckpt_path or "")
    checkpoint = None
    if cfg.ckpt_path is not None:
        checkpoint = read_checkpoint(path, task=str(HydraConfig.get().runtime.choices["task"]))
    made = Job(make(cfg, "data"), make(cfg, "model"), _trainer(cfg))
    with naming("data"):
        made.data.check_ranks(made.trainer.world_size)
        made.data.check_pair()
    if checkpoint is not None:
        check_fits(checkpoint, made.model, path, config=cfg.model)
        if not needs_checkpoint:
            _check_unfinished(checkpoint["epoch"] + 1, made.trainer.max_epochs)
    if not needs_checkpoint:
        _add_origin(cfg, made)
    if made.trainer.is_global_zero:
        with naming("run_dir"):
            Path(cfg.run_dir).mkdir(parents=True, exist_ok=True)
            with replace_file(Path(cfg.run_dir, "config.yaml")) as path:
                OmegaConf.save(cfg, path)
    return made


def _add_origin(cfg: DictConfig, made: Job) -> None:
    """Checkpoints of the run will say where they come from."""
    data = fingerprint(made.data.train)
    config = cast(dict[str, Any], OmegaConf.to_container(cfg, enum_to_str=True))
    network = cfg.model.network
    weights = weights_license(network.encoder) if "encoder" in network and network.get("pretrained") else None
    origin = Origin(config, data=data, licenses={"data": data["license"], "pretrained weights": weights})
    made.trainer.callbacks.insert(0, origin)  # pyright: ignore[reportAttributeAccessIssue]  # a connector sets it


def _trainer(cfg: DictConfig) -> Trainer:
    try:
        return make(cfg, "trainer")
    except MisconfigurationException as error:
        raise UsageError(f"trainer: {error}") from error


def _check_unfinished(done: int, epochs: int | None) -> None:
    if epochs is not None and -1 < epochs <= done:
        raise UsageError(
            f"trainer.max_epochs must be above the {done} epochs that ckpt_path has behind it, got {epochs}"
        )
