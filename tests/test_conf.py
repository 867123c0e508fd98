import inspect
from copy import copy
from pathlib import Path
from typing import Any

import pytest
import torch
from hydra import compose, initialize_config_dir
from hydra.utils import get_class, instantiate
from omegaconf import DictConfig, OmegaConf
from pytorch_lightning import LightningModule, Trainer
from pytorch_lightning.callbacks import ModelCheckpoint
from pytorch_lightning.loggers import Logger
from torch.utils.data import DataLoader, TensorDataset

import torchrefract
from torchrefract import presets
from torchrefract._io import CONFIG_DIR
from torchrefract.cameras.calibration.boards import Charuco, Chessboard
from torchrefract.data.module import PairData
from torchrefract.effects.base import Effect
from torchrefract.restoration.diffusion import Diffusion
from torchrefract.restoration.models.denoiser import Denoiser
from torchrefract.restoration.module import Restoration
from torchrefract.restoration.report import MetricsLogger

CONF = Path(CONFIG_DIR)


def options(group: str) -> list[str]:
    return sorted(path.stem for path in (CONF / group).glob("*.yaml"))


def compose_command(command: str, *words: str) -> Any:
    with initialize_config_dir(CONFIG_DIR, version_base="1.3"):
        return compose(command, overrides=[*words])


def compose_training(tmp_path: Path, *words: str, command: str = "train") -> Any:
    """Return the resolved configuration of a training."""
    cfg = compose_command(command, *words, f"run_dir={tmp_path}")
    OmegaConf.resolve(cfg)
    return cfg


@pytest.mark.quick
def test_conf_holds_only_yaml():
    files = [path for path in CONF.rglob("*") if path.is_file()]
    assert {path.suffix for path in files} == {".yaml"}
    for path in files:
        assert isinstance(OmegaConf.load(path), DictConfig), path


@pytest.mark.parametrize("task", options("task"))
def test_every_task_builds_its_data_and_its_model(tmp_path, task):
    cfg = compose_training(tmp_path, f"+task={task}", "seed=5")
    assert not OmegaConf.missing_keys(cfg)
    data, model = instantiate(cfg.data), instantiate(cfg.model)
    assert isinstance(data, PairData)
    assert isinstance(model, Restoration)
    assert model.task.name == task
    scenes = {"undistort": 256, "deweather": 512}[task]
    assert (data.seed, len(data.train), len(data.val)) == (5, scenes, 64)  # pyright: ignore[reportArgumentType]  # both have a length
    assert data.effect is not None
    assert repr(data.effect) == repr(getattr(presets, cfg.scene._target_.rsplit(".", 1)[1])())


# google/ddpm-cat-256 has 113 673 219 weights, for 3 channels in and out. Here 7 go in and 2 come out (3 x 3 kernels).
CAT256 = 113_673_219 + 4 * 128 * 9 - (128 * 9 + 1)


@pytest.mark.parametrize(("name", "millions"), [("ddpm_image", 35.75), ("ddpm_cat256", CAT256 / 1e6)])
def test_a_diffusion_model_has_its_size_and_the_defaults_of_its_class(tmp_path, name, millions):
    cfg = compose_training(tmp_path, "+task=undistort", f"model={name}", "seed=5")
    with torch.device("meta"):
        model = instantiate(cfg.model)
        default = Diffusion(Denoiser, instantiate(cfg.task))
    assert sum(parameter.numel() for parameter in model.parameters()) / 1e6 == pytest.approx(millions, abs=0.01)
    assert (model.task.name, model.seed) == ("undistort", 5)
    names = ["lr", "weight_decay", "warmup_steps", "schedule", "metric_size", "sampler", "steps", "val_steps", "crop"]
    for option in (*names, "ema_decay"):
        assert getattr(model, option) == getattr(default, option)
    assert model.prediction == {"ddpm_image": "v_prediction", "ddpm_cat256": "epsilon"}[name]


DENOISER = ("model.network.widths=[8,8]", "model.network.groups=4")
# Each model once, with a network that trains in a second.
TINY = {
    ("resunet", "deweather"): ["model.network.encoder=tu-resnet10t"],
    ("segformer", "undistort"): ["model.network.encoder=mit_b0"],
    ("fog_net", "deweather"): ["model.network.width=4"],
    ("lens_net", "undistort"): ["model.network.weightings=2", "model.network.lenses=3"],
    ("ddpm", "undistort"): [
        *("model.network.weightings=2", "model.network.lenses=3"),
        *("model.samples=2", "model.components=1"),
    ],
    ("ddpm_image", "undistort"): [*DENOISER, "model.network.attention=[false,true]"],
    ("ddpm_cat256", "deweather"): [*DENOISER, "model.network.attention=[true,false]"],
    ("bridge", "deweather"): [*DENOISER, "model.network.attention=[false,true]"],
}
DATA = ["data.size=[32,64]", "data.train_count=4", "data.val_count=2", "data.batch_size=2", "data.workers=0"]


@pytest.mark.filterwarnings(  # of Lightning: a small training, its own code
    "ignore:.*does not have many workers", "ignore:.*LeafSpec"
)
@pytest.mark.parametrize(("model", "task"), TINY)
def test_every_model_trains_and_validates(tmp_path, model, task):
    words = (f"+task={task}", f"model={model}", *TINY[model, task], *DATA, "+trainer.fast_dev_run=2")
    cfg = compose_training(tmp_path, *words, "trainer.callbacks=[]", "trainer.logger=false")
    data, module, trainer = (instantiate(cfg[part]) for part in ("data", "model", "trainer"))
    before = [parameter.clone() for parameter in module.parameters()]
    trainer.fit(module, data)
    assert trainer.callback_metrics["val/loss"].isfinite()
    assert any(not torch.equal(a, b) for a, b in zip(module.parameters(), before, strict=True))


@pytest.mark.quick
def test_the_test_above_covers_every_model():
    assert sorted(model for model, _ in TINY) == options("model")


@pytest.mark.parametrize(
    ("model", "own"),
    [("lens_net", {"lr"}), ("fog_net", {"lr"}), ("resunet", set()), ("segformer", set()), ("ddpm", set())],
)
def test_a_model_has_the_defaults_of_its_class(tmp_path, model, own):
    cfg = compose_training(tmp_path, "+task=undistort", f"model={model}").model
    network = instantiate(cfg.network)
    for builder, given in ((get_class(cfg._target_), cfg), (network.func, network.keywords)):
        for name, parameter in inspect.signature(builder).parameters.items():
            if parameter.default is not parameter.empty and name not in own | {"smooth"}:  # by the task
                assert given[name] == parameter.default, name


def test_a_transmission_head_needs_pairs_with_a_transmission(tmp_path):
    plain, head = (
        compose_training(tmp_path, "+task=deweather", f"task.transmission_head={head}") for head in (False, True)
    )
    assert (plain.data.transmission, head.data.transmission) == (False, True)
    assert (instantiate(plain.model).task.channels, instantiate(head.model).task.channels) == (3, 4)
    assert not compose_training(tmp_path, "+task=undistort").data.transmission


@pytest.mark.parametrize("trainer", ["cpu", "ddp"])
def test_every_trainer_writes_into_the_run_folder(tmp_path, trainer):
    cfg = compose_training(tmp_path, "+task=undistort", f"trainer={trainer}").trainer
    built = instantiate(cfg)
    assert isinstance(built, Trainer)
    assert built.checkpoint_callback is not None
    assert built.checkpoint_callback.dirpath == str(tmp_path)  # pyright: ignore[reportAttributeAccessIssue]  # a ModelCheckpoint
    assert built.logger is not None
    assert Path(built.logger.log_dir or "") == tmp_path
    assert built.max_epochs == 12
    assert compose_training(tmp_path, "+task=deweather", f"trainer={trainer}").trainer.max_epochs == 8
    assert type(built.strategy).__name__ == {"cpu": "SingleDeviceStrategy", "ddp": "DDPStrategy"}[trainer]


@pytest.mark.quick
def test_every_logger_writes_into_the_run_folder_beside_the_metrics_that_reports_need(tmp_path):
    assert options("logger") == ["csv", "tensorboard", "wandb"]
    for name in options("logger"):
        first, *others = compose_training(tmp_path, "+task=undistort", f"logger={name}").trainer.logger
        assert get_class(first._target_) is MetricsLogger
        assert [other._target_.rpartition(".")[2].lower() for other in others] == [f"{name}logger"] * (name != "csv")
        for logger in (first, *others):
            kind, arguments = get_class(logger._target_), {key: logger[key] for key in logger if key != "_target_"}
            assert issubclass(kind, Logger)
            inspect.signature(kind).bind(**arguments)
            assert arguments["save_dir"] == str(tmp_path)
            assert arguments.get("offline", True)


@pytest.mark.quick
@pytest.mark.parametrize(("model", "task"), TINY)
def test_the_best_checkpoint_is_that_of_the_metric_of_the_task(tmp_path, task, model):
    cfg = compose_training(tmp_path, f"+task={task}", f"model={model}")
    callback = instantiate(cfg.trainer.callbacks[0])
    assert isinstance(callback, ModelCheckpoint)
    expected = {"undistort": ("val/epe", "min"), "deweather": ("val/psnr", "max")}[task]
    assert (callback.monitor, callback.mode) == expected


def test_the_gpu_trainer_uses_bfloat16(tmp_path):
    cfg = compose_training(tmp_path, "+task=undistort", "trainer=gpu")
    assert (cfg.trainer.accelerator, cfg.trainer.devices, cfg.trainer.precision) == ("gpu", 1, "bf16-mixed")


# Section 4 of the paper.
EPOCHS = {"undistort": 35, "deweather": 15}
PROTOCOL = {"resunet": (16, 5e-5), "segformer": (16, 5e-5), "ddpm": (8, 1e-5)}


@pytest.mark.parametrize("task", EPOCHS)
@pytest.mark.parametrize("model", PROTOCOL)
def test_the_experiments_of_table_1_follow_the_paper(tmp_path, model, task):
    cfg = compose_training(tmp_path, f"+experiment=table1_{model}_{task}", "data.root=frames")
    batch_size, lr = PROTOCOL[model]
    scene = presets.paper_refractive(frame="fill") if task == "undistort" else presets.paper_weather()
    assert instantiate(cfg.task).name == task
    assert repr(instantiate(cfg.scene)) == repr(scene)
    assert (cfg.data.size, cfg.data.val_share, cfg.data.batch_size) == ([1080, 1920], 0.2, batch_size)
    assert (cfg.trainer.max_epochs, cfg.trainer.precision, cfg.model.lr) == (EPOCHS[task], "bf16-mixed", lr)
    assert cfg.model.network.pretrained is not None
    if model == "ddpm":
        assert (cfg.model.crop, cfg.model.warmup_steps, cfg.model.prediction) == (256, 500, "epsilon")
        cat256 = compose_training(tmp_path, f"+task={task}", "model=ddpm_cat256").model.network
        assert (cfg.model.network.widths, cfg.model.network.attention) == (cat256.widths, cat256.attention)
    else:
        assert cfg.model.schedule == "plateau"


@pytest.mark.parametrize("name", ["resunet_undistort", "segformer_deweather", "ddpm_undistort"])
def test_a_smaller_scale_has_smaller_frames_and_no_pretrained_weights(tmp_path, name):
    words = (f"+experiment=table1_{name}", "data.root=frames")
    paper = compose_training(tmp_path, *words)
    for scale, size, device in (("small", [96, 160], "cpu"), ("gpu", [192, 320], "gpu")):
        small = compose_training(tmp_path, *words, f"scale={scale}")
        assert (small.scene._target_, small.task) == (paper.scene._target_, paper.task)
        assert small.model._target_ == paper.model._target_
        assert small.scene.get("width", size[1]) == size[1]  # displacements are shares of the width
        assert (small.data.size, small.trainer.accelerator) == (size, device)
        assert small.model.network.pretrained is None
        instantiate(small.model)


@pytest.mark.quick
def test_table_1_has_an_experiment_for_each_model_and_task():
    assert {*options("experiment")} == {f"table1_{model}_{task}" for model in PROTOCOL for task in EPOCHS}
    assert options("scale") == ["gpu", "paper", "small"]


def test_an_evaluation_composes_like_its_training(tmp_path):
    words = ("+task=deweather", "seed=3")
    assert compose_training(tmp_path, *words, command="eval") == compose_training(tmp_path, *words)


def test_a_preview_shows_every_effect_unless_a_scene_is_chosen():
    plain, chosen = compose_command("preview"), compose_command("preview", "scene=cape_town_fog")
    assert plain.scene is None
    assert chosen.scene._target_ == "torchrefract.presets.cape_town_fog"
    assert chosen.effects == plain.effects
    effects = [instantiate(plain.effects[name]) for name in plain.effects]
    public = [value for value in vars(torchrefract).values() if isinstance(value, type) and issubclass(value, Effect)]
    # OneOf only chooses, Rectification restores, and BlurredTurbulence is two of the others.
    others = {torchrefract.OneOf, torchrefract.Rectification, torchrefract.BlurredTurbulence}
    assert {type(effect) for effect in effects} == {*public} - others
    assert [type(effect).__name__ for effect in effects] == list(plain.effects)


@pytest.mark.parametrize("command", ["calibrate", "make_board"])
def test_a_board_has_the_defaults_of_its_class(command):
    assert options("board") == ["charuco", "chessboard"]
    for name, kind in (("charuco", Charuco), ("chessboard", Chessboard)):
        board = instantiate(compose_command(command, f"board={name}").board)
        assert type(board) is kind
        assert board == kind()


@pytest.mark.parametrize("scene", options("scene"))
def test_a_scene_is_the_preset_of_its_name(scene):
    effect = instantiate(OmegaConf.load(CONF / "scene" / f"{scene}.yaml"))
    expected = getattr(presets, scene)()
    assert isinstance(effect, Effect)
    assert (type(effect), repr(effect)) == (type(expected), repr(expected))
    assert "range=(" in repr(effect)
    cfg = compose_command("generate", f"scene={scene}", "source=a", "out=b", "license=c")
    assert not OmegaConf.missing_keys(cfg)
    assert repr(instantiate(cfg.scene)) == repr(expected)


@pytest.mark.quick
def test_every_preset_has_a_scene():
    public = [name for name, _ in inspect.getmembers(presets, inspect.isfunction) if not name.startswith("_")]
    assert [name for name in public if getattr(presets, name).__module__ == presets.__name__] == options("scene")


def test_a_task_accepts_another_scene_and_a_user_may_add_tasks(tmp_path):
    cfg = compose_training(tmp_path, "+task=undistort", "scene=cape_town_fog")
    assert cfg.data.effect._target_ == "torchrefract.presets.cape_town_fog"
    (tmp_path / "task").mkdir()
    (tmp_path / "task" / "mine.yaml").write_text(
        "# @package _global_\ndefaults:\n  - override /scene: cheap_dashcam\ntask:\n"
        "  _target_: torchrefract.restoration.tasks.Undistort\n  limit: 0.5\n"
    )
    cfg = compose_training(tmp_path, "+task=mine", f"hydra.searchpath=[file://{tmp_path}]")
    assert instantiate(cfg.task).limit == 0.5


class Worsening(LightningModule):
    """Has the better of both metrics in its first epoch."""

    def __init__(self):
        super().__init__()
        self.weight = torch.nn.Parameter(torch.zeros(()))

    def training_step(self, batch, _):
        return self.weight * batch[0].sum()

    def validation_step(self, *_):
        self.log_dict({"val/epe": float(self.current_epoch), "val/psnr": -float(self.current_epoch)})

    def configure_optimizers(self):
        return torch.optim.SGD(self.parameters(), lr=1.0)


@pytest.mark.filterwarnings("ignore:.*LeafSpec")  # Lightning's own code
@pytest.mark.filterwarnings("ignore:.*does not have many workers")  # a training of two numbers needs none
@pytest.mark.filterwarnings("ignore:.*exists and is not empty")  # the folder is continued
@pytest.mark.parametrize("task", options("task"))
def test_the_last_checkpoint_is_that_of_the_last_epoch_even_if_the_best_is_earlier(tmp_path, task):
    callbacks = compose_training(tmp_path, f"+task={task}").trainer.callbacks
    kept = [instantiate(callback) for callback in callbacks if "ModelCheckpoint" in callback._target_]
    batches = DataLoader(TensorDataset(torch.ones(2, 1)), batch_size=1)
    options: Any = {"accelerator": "cpu", "logger": False, "enable_progress_bar": False, "num_sanity_val_steps": 0}
    for max_epochs, resumed in ((3, None), (4, str(tmp_path / "last.ckpt"))):
        trainer = Trainer(max_epochs=max_epochs, callbacks=[*map(copy, kept)], enable_model_summary=False, **options)
        trainer.fit(Worsening(), batches, batches, ckpt_path=resumed, weights_only=resumed is not None)
        assert sorted(path.name for path in tmp_path.iterdir()) == ["best.ckpt", "last.ckpt"]
        for name, epoch in (("best", 0), ("last", max_epochs - 1)):
            assert torch.load(tmp_path / f"{name}.ckpt", weights_only=True)["epoch"] == epoch
