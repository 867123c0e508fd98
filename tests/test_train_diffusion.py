import re

import pytest

from torchrefract.restoration.checkpoints import read_checkpoint

TINY = ("model=ddpm", "model.network.widths=[8,16]", "model.network.attention=[false,true]", "model.network.layers=1")
TINY += ("model.network.groups=4", "model.val_steps=3", "model.lr=0.002", "data.train_count=16", "data.val_count=8")
TINY += ("data.batch_size=8", "data.size=[16,32]", "data.workers=0", "hydra.run.dir=run")


@pytest.mark.parametrize("task", ["undistort", "deweather"])
def test_a_trial_of_one_batch_trains_and_validates(call, task):
    outcome = call("train", f"+task={task}", *TINY, "+trainer.fast_dev_run=true")
    assert outcome.code == 0, outcome.err
    nothing, model = (
        re.search(rf"^{name} +([\d.]+) \(", outcome.out, re.MULTILINE) for name in ("do nothing", "model")
    )
    assert nothing is not None
    assert model is not None


def scores(text: str) -> list[str]:
    """The line of the model in the last table."""
    return next(line for line in reversed(text.splitlines()) if line.startswith("model ")).split()


def test_an_evaluation_by_the_moving_average_repeats_the_last_validation(call):
    trained = call("train", "+task=undistort", *TINY, "trainer.max_epochs=1")
    path = trained.folder / "last.ckpt"
    checkpoint, name = read_checkpoint(path, task="undistort"), "network.network.conv_out.weight"
    assert not checkpoint["state_dict"][name].equal(checkpoint["current_model_state"][name])
    words = ("+task=undistort", *TINY[:-1], f"ckpt_path={path}", "hydra.run.dir=again", "model.steps=3")
    again = call("eval", *words)
    assert again.code == 0, again.err
    assert scores(again.out) == scores(trained.out)


@pytest.mark.parametrize("model", ["resunet", "ddpm"])
def test_a_loss_that_is_no_number_stops_a_training_with_the_keys_of_the_batch(call, small, model):
    words = (*TINY, "data.train_count=32") if model == "ddpm" else (*small, "hydra.run.dir=run")
    message = call("train", "+task=undistort", *words, "model.lr=1e30").message
    found = re.fullmatch(
        r"loss must be finite, got (nan|inf) in step \d+ of epoch \d for the keys ((\d+, ){7}\d+)", message
    )
    assert found, message
    assert {int(key) for key in found[2].split(", ")} <= {*range(32)}


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("model.steps=0", "model: steps must be at least 1, got 0"),
        ("model.steps=1001", "model: steps must be at most the 1000 levels of noise of the training, got 1001"),
        ("model.sampler=euler", "model: sampler must be one of ddpm, ddim, dpm_solver, got 'euler'"),
        (
            "model.network.pretrained=./none",
            "model: pretrained must be null, a folder .* add model.network.pretrained=",
        ),
    ],
)
def test_a_wrong_word_is_one_line_of_error(call, word, message):
    assert re.match(message, call("train", "+task=undistort", *TINY, word).message)
