"""The commands that train and score a model."""

from pathlib import Path
from typing import Any, NamedTuple, cast

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf
from pytorch_lightning import LightningModule, Trainer, seed_everything
from pytorch_lightning.utilities.exceptions import MisconfigurationException

from torchrefract._io import replace_file
from torchrefract._validation import UsageError
from torchrefract.cli.command import check_seed, make, naming
from torchrefract.data.module import PairData, fingerprint
from torchrefract.restoration.checkpoints import Origin, check_fits, read_checkpoint
from torchrefract.restoration.models.pretrained import weights_license


class Job(NamedTuple):
    """The parts that a configuration instantiates, and the checkpoint that it names."""

    data: PairData
    model: LightningModule
    trainer: Trainer
    checkpoint: dict[str, Any] | None


def train(cfg: DictConfig) -> None:
    """Train the model of a configuration on its data; with `ckpt_path`, resume a stopped run."""
    job = _make_job(cfg)
    if job.checkpoint is not None:
        _check_unfinished(job.checkpoint["epoch"] + 1, job.trainer.max_epochs)
    _add_origin(cfg, job)
    _save_config(cfg, job)
    job.trainer.fit(job.model, job.data, ckpt_path=cfg.ckpt_path, weights_only=True)


def evaluate(cfg: DictConfig) -> None:
    """Score a checkpoint on the validation data of a configuration."""
    if cfg.ckpt_path is None:
        raise UsageError("ckpt_path must be the path of a checkpoint: add ckpt_path=<run>/best.ckpt, got none")
    job = _make_job(cfg)
    _save_config(cfg, job)
    job.trainer.validate(job.model, job.data, ckpt_path=cfg.ckpt_path, verbose=False, weights_only=True)


def _make_job(cfg: DictConfig) -> Job:
    """Instantiate data, model and trainer, and check that they and the checkpoint fit together."""
    OmegaConf.resolve(cfg)
    seed_everything(check_seed(cfg.seed), workers=True, verbose=False)
    path = None if cfg.ckpt_path is None else Path(cfg.ckpt_path)
    checkpoint = None
    if path is not None:
        checkpoint = read_checkpoint(path, task=str(HydraConfig.get().runtime.choices["task"]))
    job = Job(make(cfg, "data"), make(cfg, "model"), _make_trainer(cfg), checkpoint)
    with naming("data"):
        job.data.check_ranks(job.trainer.world_size)
        job.data.check_pair()
    if path is not None and checkpoint is not None:
        check_fits(checkpoint, job.model, path, config=cfg.model)
    return job


def _make_trainer(cfg: DictConfig) -> Trainer:
    try:
        return make(cfg, "trainer")
    except MisconfigurationException as error:
        raise UsageError(f"trainer: {error}") from error


def _check_unfinished(done: int, epochs: int | None) -> None:
    if epochs is not None and -1 < epochs <= done:
        raise UsageError(f"trainer.max_epochs must be above the {done} epochs of ckpt_path, got {epochs}")


def _add_origin(cfg: DictConfig, job: Job) -> None:
    """Let the checkpoints of the run hold their configuration, training data and licenses."""
    data = fingerprint(job.data.train)
    config = cast(dict[str, Any], OmegaConf.to_container(cfg, enum_to_str=True))
    network = cfg.model.network
    weights = weights_license(network.encoder) if "encoder" in network and network.get("pretrained") else None
    origin = Origin(config, data=data, licenses={"data": data["license"], "pretrained weights": weights})
    job.trainer.callbacks.insert(0, origin)  # pyright: ignore[reportAttributeAccessIssue]  # a connector sets it


def _save_config(cfg: DictConfig, job: Job) -> None:
    """Write the resolved configuration into the run folder."""
    if job.trainer.is_global_zero:
        with naming("run_dir"):
            Path(cfg.run_dir).mkdir(parents=True, exist_ok=True)
            with replace_file(Path(cfg.run_dir, "config.yaml")) as path:
                OmegaConf.save(cfg, path)
