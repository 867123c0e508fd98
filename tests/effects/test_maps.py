"""Maps are computed when they are first read, and once."""

import pytest
import torch

from torchrefract import Compose, DivergenceFree, LensDistortion, ThinPlateSpline, Turbulence, UniformFog
from torchrefract.effects import refraction, walk

WARPS = [LensDistortion(), Turbulence(), ThinPlateSpline(), DivergenceFree()]


@pytest.fixture
def work(monkeypatch) -> list[str]:
    """The names of what has been computed for maps."""
    done: list[str] = []

    def count(where, name: str) -> None:
        original = getattr(where, name)
        monkeypatch.setattr(where, name, lambda *args, **options: done.append(name) or original(*args, **options))

    for module in (refraction, walk):
        for name in {"inside", "sees", "folding", "length"} & set(vars(module)):
            count(module, name)
    for kind in (refraction.WarpEffect, LensDistortion):
        count(kind, "undo")
    return done


@pytest.mark.parametrize("effect", [*WARPS, Compose(WARPS), Compose([UniformFog(), *WARPS])])
def test_nobody_pays_for_maps_that_nobody_reads(effect, work):
    image = torch.rand(2, 3, 40, 56)
    effect(image)
    made = effect.degrade(image, seed=0)
    assert made.image.shape == image.shape
    assert work == []
    assert made.valid.any()
    assert set(work) <= {"inside", "sees"}
    assert "inside" in work
    work.clear()
    assert made.restore_flow.any()
    warps = len(WARPS) if isinstance(effect, Compose) else 1
    assert work.count("undo") == warps
    assert "length" not in work
    assert warps > 1 or work == ["undo"]
    work.clear()
    assert made.restore_valid.any()
    # Of several warps the residual tells where the flow back may not be taken.
    assert work == (["sees", "length"] if warps > 1 else ["sees"])
    assert made.restore_valid.any()
    assert made.valid.any()
    assert made.flow.any()
    assert made.folding.min_determinant.isfinite().all()
    assert made.restore_residual.isfinite().all()
    assert sorted(work) == ["folding", "length", "sees"]


@pytest.mark.parametrize("effect", [LensDistortion(), DivergenceFree(), Compose([LensDistortion(), DivergenceFree()])])
def test_all_maps_of_warps_can_be_read_in_one_graph(effect):
    def maps(image: torch.Tensor) -> list[torch.Tensor]:
        made = effect.degrade(image, seed=3)
        ways = [made.flow, made.valid, made.restore_flow, made.restore_valid, made.restore_residual]
        return [*ways, *made.folding]

    torch.compiler.reset()
    image = torch.rand(2, 3, 40, 56)
    for found, expected in zip(torch.compile(maps, fullgraph=True, backend="eager")(image), maps(image), strict=True):
        # Where no value can be read Newton's method takes other steps.
        differ = (found.float() - expected.float()).abs() > 2e-3
        assert differ.float().mean() <= 0.005


def test_a_fog_without_readers_has_no_maps_of_the_size_of_the_image():
    made = UniformFog().degrade(torch.rand(1, 3, 40, 56), seed=0)
    # A row-wise fog knows one number a row, and shows it as a map of the frame without holding one.
    assert made.transmission.shape == (1, 1, 40, 56)
    assert made.transmission.untyped_storage().nbytes() < 40 * 56 * 4
