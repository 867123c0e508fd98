"""Warps whose flow depends on depth, alone and in compositions."""

from typing import Any, NamedTuple

import pytest
import torch
from helpers import random_image
from torch import Tensor
from torch.testing import assert_close

from torchrefract import Compose, GroundPlaneDepth, LensDistortion, RollingShutter, Turbulence, UniformFog
from torchrefract._tensor import sharing_results
from torchrefract.effects.batch import ParamsAtDepth, params_to
from torchrefract.effects.warp_effect import WarpEffect
from torchrefract.fields.random_field import sum_of_waves
from torchrefract.warping.implicit import sample_at
from torchrefract.warping.lattice import Lattice, pixel_lattice


class ShiftParams(NamedTuple):
    applied: Tensor  # (B,), bool
    shift: Tensor  # (B,)
    to = params_to
    is_identity = property(lambda self: self.shift == 0)


class Shift(WarpEffect):
    """Move each pixel to the left by shift px, or by shift / depth px."""

    params_type, has_closed_form = ShiftParams, True

    def __init__(self, shift: float, *, has_depth: bool, p: float = 1.0):
        super().__init__(p=p, tolerance_px=None)
        self.shift, self.depth = shift, GroundPlaneDepth(horizon=0.25) if has_depth else None

    def sample_params(self, stream, image):
        applied, values = self.draw_in_ranges(stream, [(self.shift, self.shift)], image)
        return ShiftParams(applied, values[:, 0])

    def validate(self, params, image):
        """Accept all parameters."""

    def flow(self, params: Any, points, plan):
        share = 1.0
        if self.depth is not None:
            assert isinstance(params, ParamsAtDepth)
            params, share = params.params, sample_at(1 / params.depth, points)
        u = params.shift.view(-1, 1, 1, 1) * share * torch.ones_like(points.x + points.y)
        return torch.cat([u, torch.zeros_like(u)], dim=1), torch.ones(1, 1, 1, 1, dtype=torch.bool)


NEAR_AND_FAR = torch.tensor([1.0] * 12 + [4.0] * 12).expand(1, 1, 16, -1)  # m, of the columns


def test_a_warp_takes_the_depth_that_is_passed_or_that_of_its_provider():
    image, effect = random_image(2, 3, 16, 24), Shift(4.0, has_depth=True)
    passed = effect.degrade(image, depth=NEAR_AND_FAR.expand(2, -1, -1, -1))
    assert_close(passed.flow[:, :1], 4 / NEAR_AND_FAR.expand(2, -1, -1, -1))
    provider = effect.degrade(image).flow[:, :1]
    depth = GroundPlaneDepth(horizon=0.25)(16, 24, dtype=torch.float32, device=image.device)
    assert_close(provider, (4 / depth).expand(2, 1, 16, 24))
    assert type(passed.params) is ShiftParams  # as drawn, for other depths
    with pytest.raises(ValueError, match="depth must be at least 0, in m"):
        effect.degrade(image, depth=-NEAR_AND_FAR.expand(2, -1, -1, -1))


def test_each_frame_of_a_clip_has_its_depth():
    clip, effect = random_image(2, 3, 3, 16, 24), Shift(4.0, has_depth=True)
    depth = torch.tensor([1.0, 2.0, 4.0]).view(1, 3, 1, 1, 1).expand(2, -1, 1, 16, 24)
    for shifts in (effect, Compose([effect])):
        assert_close(shifts.degrade(clip, depth=depth).flow[:, :, 0], (4 / depth)[:, :, 0])
        static = shifts.degrade(clip, depth=depth[:, 2:]).flow
        assert_close(static[:, :, 0], torch.ones(2, 3, 16, 24))


def test_the_depth_of_a_composition_is_that_of_the_clean_scene_and_moves_along():
    image = random_image(3, 3, 16, 24)
    depth = NEAR_AND_FAR.expand(3, -1, -1, -1)
    effect = Compose([Shift(5.0, has_depth=False, p=0.5), Shift(4.0, has_depth=True)])
    degraded = effect.degrade(image, seed=3, depth=depth)
    applied = degraded.params.children[0].applied
    assert 0 < applied.sum() < 3
    for is_applied, flow in zip(applied.tolist(), degraded.flow, strict=True):
        edge = 12 - 5 * is_applied  # the near part of the scene has moved to the left
        assert_close(flow[0], torch.tensor([4.0] * edge + [1.0] * (24 - edge)).expand(16, -1) + 5 * is_applied)
    # The depth moves on with the warp that used it.
    fog = UniformFog(visibility_range=(5.0, 5.0), deviation_range=(0.0, 0.0))
    t = Compose([Shift(4.0, has_depth=True), fog]).degrade(image, depth=depth).transmission
    assert_close(t[:, 0, :, 10], 0.05 ** (depth[:, 0, :, 14] / 5))


def test_a_composition_differentiates_a_warp_at_depth_and_its_depth():
    image, depth = random_image(1, 3, 6, 8, dtype=torch.float64), torch.rand(1, 1, 6, 8, dtype=torch.float64) + 1
    lens = LensDistortion(frame="pad")
    effect = Compose([lens, Shift(1.3, has_depth=True)])
    drawn = effect.sample(image, seed=1)

    def degrade(shift: Tensor, depth: Tensor) -> Tensor:
        params = drawn._replace(children=(drawn.children[0], drawn.children[1]._replace(shift=shift)))
        return effect.apply(image, params, depth=depth).image

    shift = drawn.children[1].shift.clone().requires_grad_()
    assert torch.autograd.gradcheck(degrade, (shift, depth.requires_grad_()))


def test_maps_are_sampled_bilinearly_at_points_inside_and_outside_of_the_frame():
    x, y = torch.arange(9.0), torch.arange(7.0)[:, None]
    ramp = (2 * x + 3 * y)[None, None]
    for lattice in (pixel_lattice(7, 9), Lattice(7, 9, stride=3)):
        points = lattice.points(dtype=torch.float32, device=torch.device("cpu"))
        moved = points.displaced(torch.full((1, 2, *lattice.num_nodes), 0.25))
        for at in (points, moved):
            expected = (2 * at.x.clamp(0, 8) + 3 * at.y.clamp(0, 6)).expand(1, 1, *lattice.num_nodes)
            assert_close(sample_at(ramp, at), expected)
            rows = (3 * at.y).expand(1, 1, *lattice.num_nodes)
            assert_close(sample_at(3 * y[None, None], at).expand_as(rows), rows)


def test_the_severities_of_a_scene_share_the_field_of_their_turbulence(monkeypatch):
    computed = []

    def counted(*given: Any) -> Tensor:
        computed.append(given)
        return sum_of_waves(*given)

    monkeypatch.setattr("torchrefract.fields.random_field.sum_of_waves", counted)
    image = random_image(1, 3, 90, 160)
    with sharing_results():
        for readout in (-10.0, -15.0, -20.0):  # each leads somewhat farther outside of the frame
            shutter = RollingShutter(speed_range=(60.0, 60.0), readout_range=(readout, readout))
            Compose([Turbulence(depth=GroundPlaneDepth()), shutter], tolerance_px=None).degrade(image, seed=1)
    assert len(computed) == 1
