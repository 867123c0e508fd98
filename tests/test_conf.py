import inspect
from pathlib import Path
from typing import Any

import pytest
import torch
from hydra import compose, initialize_config_dir
from hydra.utils import get_class, instantiate
from omegaconf import DictConfig, OmegaConf
from pytorch_lightning import Trainer

import torchrefract
from torchrefract import presets
from torchrefract._io import CONFIG_DIR
from torchrefract.cameras.calibration.boards import Charuco, Chessboard
from torchrefract.data.module import PairData
from torchrefract.effects.base import Effect
from torchrefract.restoration.diffusion import Diffusion
from torchrefract.restoration.models.denoiser import Denoiser
from torchrefract.restoration.module import Restoration
from torchrefract.restoration.tasks import Task

CONF = Path(CONFIG_DIR)


def options(group: str) -> list[str]:
    return sorted(path.stem for path in (CONF / group).glob("*.yaml"))


def presets_of(task: str) -> Effect:
    """The scene that the paper has for a task."""
    return presets.paper_refractive() if task == "undistort" else presets.paper_weather()


def composed(tmp_path: Path, *words: str, command: str = "train") -> Any:
    """What a command would be given."""
    with initialize_config_dir(CONFIG_DIR, version_base="1.3"):
        cfg = compose(command, overrides=[*words, f"run_dir={tmp_path}"])
    OmegaConf.resolve(cfg)
    return cfg


def test_conf_holds_nothing_but_yaml():
    files = [path for path in CONF.rglob("*") if path.is_file()]
    assert {path.suffix for path in files} == {".yaml"}
    for path in files:
        assert isinstance(OmegaConf.load(path), DictConfig), path


@pytest.mark.parametrize("trainer", ["cpu", "gpu", "ddp"])
@pytest.mark.parametrize("task", options("task"))
def test_every_task_composes_with_every_trainer(tmp_path, task, trainer):
    cfg = composed(tmp_path, f"+task={task}", f"trainer={trainer}")
    assert cfg.task._target_ == f"torchrefract.restoration.tasks.{task.capitalize()}"
    assert cfg.model.task == cfg.task
    assert cfg.data.effect == cfg.scene
    assert cfg.trainer.logger.save_dir == str(tmp_path)
    assert not OmegaConf.missing_keys(cfg)


@pytest.mark.parametrize("task", options("task"))
def test_every_task_makes_its_data_and_its_model(tmp_path, task):
    cfg = composed(tmp_path, f"+task={task}", "seed=5")
    data, model = instantiate(cfg.data), instantiate(cfg.model)
    assert isinstance(data, PairData)
    assert isinstance(model, Restoration)
    assert model.task.name == task
    assert (data.seed, len(data.train), len(data.val)) == (5, 512, 128)  # pyright: ignore[reportArgumentType]  # of known length
    assert data.effect is not None
    assert data.effect.extra_repr() == getattr(presets, cfg.scene._target_.rsplit(".", 1)[1])().extra_repr()


@pytest.mark.parametrize(("name", "millions"), [("ddpm", 35.75), ("ddpm_cat256", 113.68)])
@pytest.mark.parametrize("task", options("task"))
def test_a_diffusion_model_has_the_size_of_its_name_and_the_defaults_of_its_class(tmp_path, task, name, millions):
    cfg = composed(tmp_path, f"+task={task}", f"model={name}", "seed=5")
    with torch.device("meta"):
        model = instantiate(cfg.model)
        plain = Diffusion(Denoiser, instantiate(cfg.task))
    assert sum(parameter.numel() for parameter in model.parameters()) / 1e6 == pytest.approx(millions, abs=0.01)
    assert model.task.name == task
    assert model.seed == 5
    named = ["lr", "weight_decay", "warmup_steps", "schedule", "metric_size", "sampler", "steps", "val_steps", "crop"]
    named.append("ema_decay")
    assert {option: getattr(model, option) for option in named} == {option: getattr(plain, option) for option in named}
    assert model.prediction == {"ddpm": "v_prediction", "ddpm_cat256": "epsilon"}[name]


# Networks of the same kind that take a second, not a minute.
TINY = {
    "resunet": ["model.network.encoder=tu-resnet10t"],
    "segformer": ["model.network.encoder=mit_b0"],
    "ddpm": ["model.network.widths=[8,8]", "model.network.attention=[false,true]", "model.network.groups=4"],
    "ddpm_cat256": ["model.network.widths=[8,8]", "model.network.attention=[true,false]", "model.network.groups=4"],
}
SCENES = ["data.size=[32,64]", "data.train_count=4", "data.val_count=2", "data.batch_size=2", "data.workers=0"]


@pytest.mark.filterwarnings("ignore:.*does not have many workers", "ignore:.*LeafSpec")
@pytest.mark.parametrize("task", options("task"))
@pytest.mark.parametrize("model", sorted(TINY))
def test_every_model_of_every_task_trains_and_validates(tmp_path, model, task):
    cfg = composed(tmp_path, f"+task={task}", f"model={model}", *TINY[model], *SCENES, "+trainer.fast_dev_run=true")
    cfg.trainer.callbacks, cfg.trainer.logger = [], False
    data, made, trainer = (instantiate(cfg[part]) for part in ("data", "model", "trainer"))
    before = [parameter.clone() for parameter in made.parameters()]
    trainer.fit(made, data)
    assert trainer.callback_metrics["val/loss"].isfinite()
    assert any(not torch.equal(a, b) for a, b in zip(made.parameters(), before, strict=True))


@pytest.mark.parametrize("model", ["resunet", "segformer"])
def test_a_model_is_made_with_the_defaults_of_its_class(tmp_path, model):
    cfg = composed(tmp_path, "+task=undistort", f"model={model}").model
    network = instantiate(cfg.network)
    for made, given in ((get_class(cfg._target_), cfg), (network.func, network.keywords)):
        for name, parameter in inspect.signature(made).parameters.items():
            if parameter.default is not parameter.empty and name != "smooth":  # which the task says
                assert given[name] == parameter.default, name


def test_a_transmission_is_made_where_a_head_predicts_it(tmp_path):
    plain, asked = (composed(tmp_path, "+task=deweather", f"task.transmission_head={head}") for head in (False, True))
    assert (plain.data.transmission, asked.data.transmission) == (False, True)
    assert (instantiate(plain.model).task.channels, instantiate(asked.model).task.channels) == (3, 4)
    assert not composed(tmp_path, "+task=undistort").data.transmission


@pytest.mark.parametrize("trainer", ["cpu", "ddp"])
def test_every_trainer_writes_into_the_run_folder(tmp_path, trainer):
    made = instantiate(composed(tmp_path, "+task=undistort", f"trainer={trainer}").trainer)
    assert isinstance(made, Trainer)
    assert made.checkpoint_callback is not None
    assert made.checkpoint_callback.dirpath == str(tmp_path)  # pyright: ignore[reportAttributeAccessIssue]  # a ModelCheckpoint
    assert made.logger is not None
    assert Path(made.logger.log_dir or "") == tmp_path
    assert made.max_epochs == 6
    assert type(made.strategy).__name__ == {"cpu": "SingleDeviceStrategy", "ddp": "DDPStrategy"}[trainer]


def test_the_gpu_trains_in_bfloat16(tmp_path):
    cfg = composed(tmp_path, "+task=undistort", "trainer=gpu")
    assert (cfg.trainer.accelerator, cfg.trainer.devices, cfg.trainer.precision) == ("gpu", 1, "bf16-mixed")


# Section 4 of the paper.
EPOCHS = {"undistort": 35, "deweather": 15}
PROTOCOL = {"resunet": (16, 5e-5), "segformer": (16, 5e-5), "ddpm": (8, 1e-5)}


@pytest.mark.parametrize("task", sorted(EPOCHS))
@pytest.mark.parametrize("model", sorted(PROTOCOL))
def test_the_experiments_of_table_1_follow_the_paper(tmp_path, model, task):
    cfg = composed(tmp_path, f"+experiment=table1_{model}_{task}", "data.root=frames")
    batch_size, lr = PROTOCOL[model]
    assert instantiate(cfg.task).name == task
    assert instantiate(cfg.scene).extra_repr() == presets_of(task).extra_repr()
    assert (cfg.data.size, cfg.data.val_share, cfg.data.batch_size) == ([1080, 1920], 0.2, batch_size)
    assert (cfg.trainer.max_epochs, cfg.trainer.precision, cfg.model.lr) == (EPOCHS[task], "bf16-mixed", lr)
    assert cfg.model.network.pretrained is not None
    if model == "ddpm":
        assert (cfg.model.crop, cfg.model.warmup_steps) == (256, 500)
    else:
        assert cfg.model.schedule == "plateau"


@pytest.mark.parametrize(("form", "size", "device"), [("small", [96, 160], "cpu"), ("gpu", [192, 320], "gpu")])
@pytest.mark.parametrize("row", [f"table1_{model}_{task}" for model in PROTOCOL for task in EPOCHS])
def test_a_small_experiment_is_its_large_one_on_small_frames_without_weights(tmp_path, row, form, size, device):
    small, large = (composed(tmp_path, f"+experiment={name}", "data.root=frames") for name in (f"{row}_{form}", row))
    assert (small.scene._target_, small.task) == (large.scene._target_, large.task)
    assert small.model._target_ == large.model._target_
    assert small.scene.get("width", size[1]) == size[1]  # a scene that moves pixels does so by shares of the frame
    assert (small.data.size, small.trainer.accelerator) == (size, device)
    assert small.model.network.pretrained is None
    assert isinstance(instantiate(small.model).task, Task)


def test_every_model_has_a_tiny_form_to_try():
    assert sorted(TINY) == options("model")


def test_every_experiment_is_of_table_1():
    names = {f"table1_{model}_{task}{form}" for model in PROTOCOL for task in EPOCHS for form in ("", "_small", "_gpu")}
    assert {*options("experiment")} == names


def test_an_evaluation_composes_what_the_training_did(tmp_path):
    words = ("+task=deweather", "seed=3")
    assert composed(tmp_path, *words, command="eval") == composed(tmp_path, *words)


def test_a_preview_shows_every_effect_unless_a_scene_is_chosen():
    with initialize_config_dir(CONFIG_DIR, version_base="1.3"):
        plain, chosen = compose("preview"), compose("preview", overrides=["scene=cape_town_fog"])
    assert plain.scene is None
    assert chosen.scene._target_ == "torchrefract.presets.cape_town_fog"
    assert chosen.effects == plain.effects
    made = [instantiate(plain.effects[name]) for name in plain.effects]
    public = [value for value in vars(torchrefract).values() if isinstance(value, type) and issubclass(value, Effect)]
    # One chooses, the other mends.
    assert {type(effect) for effect in made} == {*public} - {torchrefract.OneOf, torchrefract.Rectification}
    assert [type(effect).__name__ for effect in made] == list(plain.effects)


@pytest.mark.parametrize("command", ["calibrate", "make_board"])
def test_a_board_is_that_of_its_class(command):
    assert options("board") == ["charuco", "chessboard"]
    for name, kind in (("charuco", Charuco), ("chessboard", Chessboard)):
        with initialize_config_dir(CONFIG_DIR, version_base="1.3"):
            made = instantiate(compose(command, overrides=[f"board={name}"]).board)
        assert type(made) is kind
        assert made == kind()


@pytest.mark.parametrize("scene", options("scene"))
def test_a_scene_is_the_preset_of_its_name(scene):
    made = instantiate(OmegaConf.load(CONF / "scene" / f"{scene}.yaml"))
    expected = getattr(presets, scene)()
    assert isinstance(made, Effect)
    assert (type(made), repr(made)) == (type(expected), repr(expected))
    assert "range=(" in repr(made)


@pytest.mark.parametrize("scene", options("scene"))
def test_pairs_are_written_of_every_scene(scene):
    with initialize_config_dir(CONFIG_DIR, version_base="1.3"):
        cfg = compose("generate", overrides=[f"scene={scene}", "source=a", "out=b", "license=c"])
    assert not OmegaConf.missing_keys(cfg)
    assert isinstance(instantiate(cfg.scene), Effect)


def test_every_preset_has_a_scene():
    public = [name for name, _ in inspect.getmembers(presets, inspect.isfunction) if not name.startswith("_")]
    assert [name for name in public if getattr(presets, name).__module__ == presets.__name__] == options("scene")


def test_another_scene_can_be_chosen_for_a_task(tmp_path):
    cfg = composed(tmp_path, "+task=undistort", "scene=cape_town_fog")
    assert cfg.data.effect._target_ == "torchrefract.presets.cape_town_fog"


def test_a_task_of_the_user_comes_with_a_folder_of_his_own(tmp_path):
    (tmp_path / "task").mkdir()
    (tmp_path / "task" / "mine.yaml").write_text(
        "# @package _global_\ndefaults:\n  - override /scene: cheap_dashcam\ntask:\n"
        "  _target_: torchrefract.restoration.tasks.Undistort\n  limit: 0.5\n"
    )
    cfg = composed(tmp_path, "+task=mine", f"hydra.searchpath=[file://{tmp_path}]")
    assert instantiate(cfg.task).limit == 0.5
