from collections.abc import Callable
from functools import partial

import pytest
from pytorch_lightning import Trainer

from torchrefract.restoration.checkpoints import AtomicCheckpointIO


@pytest.fixture
def trainer(tmp_path) -> Callable[..., Trainer]:
    return partial(
        Trainer,
        accelerator="cpu",
        default_root_dir=tmp_path,
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        num_sanity_val_steps=0,
        plugins=[AtomicCheckpointIO()],
    )
