import math

import numpy as np
import pytest
import torch
from matplotlib.figure import Figure
from torch.testing import assert_close

import torchrefract as tr
from torchrefract.visualization.details import cut_detail, detail_rows, draw_arrows, flow_arrows

pytestmark = pytest.mark.quick


def test_a_detail_of_a_large_frame_shows_its_pixels_one_to_one():
    image = torch.rand(1, 3, 1080, 1920)
    detail = cut_detail(image, 0.5, height=270, width=480)
    assert torch.equal(detail, image[0, :, 405:675, 720:1200])


def test_a_detail_of_a_small_frame_is_enlarged_by_a_whole_number_and_stays_inside():
    image = torch.rand(1, 3, 90, 160)
    detail = cut_detail(image, 1.0, height=180, width=320)
    assert_close(detail[:, ::6, ::6], image[0, :, 60:, 53 : 53 + 53])
    assert torch.equal(detail[:, 5::6, 5::6], detail[:, ::6, ::6])


def test_the_horizon_is_that_of_the_effect_with_one():
    fog = tr.HeterogeneousFog(horizon=0.4)
    assert detail_rows(fog)[0] == detail_rows(tr.Compose([tr.Vignetting(), fog]))[0] == 0.4
    assert detail_rows(tr.Vignetting())[0] == 0.5


def test_arrows_point_where_the_content_moves():
    # Pixel x shows the content of x + flow: the content moves by -flow.
    flow = torch.tensor([-6.0, 2.0])[None, :, None, None].expand(1, 2, 540, 960).contiguous()
    flow[..., 480:] /= 4
    arrows = flow_arrows(flow, torch.ones(1, 1, 540, 960, dtype=torch.bool), height=270, width=480)
    assert arrows is not None
    assert arrows.longest == pytest.approx(math.hypot(6, 2))
    left = arrows.x < 240
    factor = 0.5 * arrows.enlargement * torch.where(left, 1.0, 0.25)
    assert_close(torch.stack([arrows.u, arrows.v]), torch.stack([6 * factor, -2 * factor]))
    assert 18 <= arrows.u.max() <= 36
    axes = Figure().add_subplot()
    draw_arrows(axes, arrows)
    (drawn,) = axes.collections
    np.testing.assert_allclose(np.asarray(drawn.get_offsets()), torch.stack([arrows.x, arrows.y], 1).numpy())


def test_there_are_no_arrows_without_motion_or_valid_pixels():
    flow, valid = torch.zeros(1, 2, 54, 96), torch.ones(1, 1, 54, 96, dtype=torch.bool)
    assert flow_arrows(flow, valid, height=54, width=96) is None
    assert flow_arrows(flow + 1, ~valid, height=54, width=96) is None
    assert flow_arrows(flow + 1, valid, height=54, width=96) is not None
