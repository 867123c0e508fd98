from collections.abc import Callable
from functools import partial

import pytest
import torch
from pytorch_lightning import Trainer
from torch import nn

from torchrefract import Pair, presets
from torchrefract.data.module import make_pair, road_scenes
from torchrefract.data.road_scenes import RoadScenes
from torchrefract.effects.base import Effect
from torchrefract.restoration.metrics import endpoint_error, psnr
from torchrefract.restoration.models.resunet import ResUNet
from torchrefract.restoration.models.segformer import SegFormer
from torchrefract.restoration.module import Restoration
from torchrefract.restoration.tasks import Deweather, Restored, Task, Undistort
from torchrefract.types import Frame

SIZE = (32, 64)
SMALL: dict[str, Callable[..., nn.Module]] = {
    "resunet": partial(ResUNet, encoder="tu-mobilenetv3_small_050"),
    "segformer": partial(SegFormer, encoder="mit_b0"),
}


def batch(effect: Effect, count: int) -> Pair:
    scenes = RoadScenes(count, size=SIZE)
    frame = Frame(*(torch.stack(part) for part in zip(*(scenes[i] for i in range(count)), strict=True)))
    return make_pair(frame, effect, seed=0)


def overfitted(network: str, task: Task, pair: Pair, *, steps: int, lr: float) -> Restored:
    """The restoration of a batch by a network that has seen it, and nothing else, for some steps."""
    torch.manual_seed(0)
    model = SMALL[network](task.channels, smooth=task.smooth)
    optimizer = torch.optim.AdamW(model.parameters())
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, lr, steps)
    for _ in range(steps):
        optimizer.zero_grad()
        task.loss(task.restore(model(pair.degraded), pair.degraded), pair).backward()
        optimizer.step()
        schedule.step()
    with torch.no_grad():
        return task.restore(model(pair.degraded), pair.degraded)


@pytest.mark.parametrize("network", sorted(SMALL))
def test_one_batch_is_undistorted_to_half_a_pixel(network, on_threads):
    on_threads(1)  # a training differs with their number
    pair = batch(presets.cheap_dashcam(severity=5), 2)
    restored = overfitted(network, Undistort(), pair, steps=50, lr=3e-3)
    assert restored.flow is not None
    nothing, found = (
        endpoint_error(flow, pair.flow, pair.valid, size=SIZE).mean() for flow in (0 * pair.flow, restored.flow)
    )
    assert nothing > 1
    assert found < 0.5


def test_one_batch_is_deweathered_to_35_decibels():
    pair = batch(presets.cape_town_fog(), 1)
    restored = overfitted("resunet", Deweather(), pair, steps=240, lr=5e-3)
    nothing, found = (psnr(image, pair.clean, pair.valid).mean() for image in (pair.degraded, restored.image))
    assert nothing < 20
    assert found > 35


@pytest.mark.filterwarnings("ignore:.*does not have many workers", "ignore:.*LeafSpec")
@pytest.mark.parametrize("task", [Undistort(), Deweather(transmission_head=True)], ids=["undistort", "deweather"])
@pytest.mark.parametrize("network", sorted(SMALL))
def test_half_precision_trains_without_a_number_that_is_none(network, task):
    fog = isinstance(task, Deweather)
    effect = presets.cape_town_fog() if fog else presets.cheap_dashcam()
    counts = {"train_count": 6, "val_count": 2, "batch_size": 2, "workers": 0}
    data = road_scenes(effect=effect, size=SIZE, transmission=fog, flow=not fog, **counts)
    model = Restoration(SMALL[network], task)
    trainer = Trainer(
        accelerator="cpu",
        precision="bf16-mixed",
        max_epochs=2,
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        num_sanity_val_steps=0,
        use_distributed_sampler=False,
    )
    seen = []
    # What is said of a whole frame is in float32 all the same.
    model.get_submodule("network.network.segmentation_head").register_forward_hook(
        lambda module, inputs, outputs: seen.append(outputs.dtype)
    )
    trainer.fit(model, data)
    assert {*seen} == {torch.bfloat16}
    assert all(value.isfinite() for value in trainer.callback_metrics.values())
    assert all(value.isfinite().all() and value.dtype == torch.float32 for value in model.parameters())
