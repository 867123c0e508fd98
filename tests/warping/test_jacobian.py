import pytest
import torch
from torch.testing import assert_close

from torchrefract import folding, jacobian_determinant


def test_an_affine_map_has_its_determinant_everywhere(pixels):
    x, y = pixels(6, 7)
    matrices = torch.tensor([[[0.2, -0.3], [0.1, 0.4]], [[-2.0, 0.0], [0.0, 0.0]], [[-1.0, 1.0], [-1.0, -1.0]]])
    flow = torch.einsum("bij,jhw->bihw", matrices.double(), torch.stack([x, y])) + 3
    expected = torch.linalg.det(torch.eye(2) + matrices).double()  # pyright: ignore[reportCallIssue]  # missing in torch's annotations
    assert_close(jacobian_determinant(flow), expected.view(3, 1, 1, 1).expand(-1, -1, 6, 7), rtol=0, atol=1e-6)
    folds, least = folding(flow)
    assert_close(least, expected, rtol=0, atol=1e-6)
    assert folds.tolist() == [0, 1, 0]


def test_a_fold_between_two_pixels_is_found():
    # From pixel 4 to pixel 5 the look-up runs back by half a pixel; central differences would see 1 - 1.5 / 2 > 0.
    flow = torch.zeros(1, 2, 5, 9)
    flow[:, 0, :, 5:] = -1.5
    determinant = jacobian_determinant(flow)
    expected = torch.ones(1, 1, 5, 9)
    expected[..., 4:6] = -0.5
    assert torch.equal(determinant, expected)
    assert folding(flow).fraction.item() == pytest.approx(2 / 9)
    assert torch.equal(jacobian_determinant(flow.mT.flip(1)), expected.mT)


def test_a_pixel_is_on_a_fold_where_a_quadrilateral_around_it_turns_over():
    generator = torch.Generator().manual_seed(0)
    flow = 0.6 * torch.randn(2, 2, 12, 15, generator=generator, dtype=torch.float64)
    rows, columns = torch.meshgrid(torch.arange(12.0), torch.arange(15.0), indexing="ij")
    points = flow + torch.stack([columns, rows])
    # A cell of the map is the quadrilateral of its four corners; twice the signed area at each of them.
    a, b = points[..., :-1, :-1], points[..., :-1, 1:]
    d, c = points[..., 1:, :-1], points[..., 1:, 1:]
    least = torch.full((2, 12, 15), torch.inf, dtype=torch.float64)
    for (i, j), (before, corner, after) in {
        (0, 0): (d, a, b),
        (0, 1): (a, b, c),
        (1, 1): (b, c, d),
        (1, 0): (c, d, a),
    }.items():
        e, f = corner - before, after - corner
        area = e[:, 0] * f[:, 1] - e[:, 1] * f[:, 0]
        view = least[:, i : i + 11, j : j + 14]
        view.copy_(torch.minimum(view, area))
    assert_close(jacobian_determinant(flow)[:, 0], least, rtol=0, atol=1e-12)
    assert torch.equal(folding(flow).fraction, (least <= 0).double().mean(dim=(1, 2)))
    assert 0 < folding(flow).fraction[0] < 1


@pytest.mark.parametrize("size", [(1, 6), (6, 1), (1, 1)])
def test_a_frame_of_one_row_or_column_stretches_along_the_other(pixels, size):
    x, y = pixels(*size)
    flow = torch.stack([0.5 * x, 0.25 * y])[None]
    expected = 1 + (0.5 if size[1] > 1 else 0) + (0.25 if size[0] > 1 else 0)
    assert torch.equal(jacobian_determinant(flow), torch.full((1, 1, *size), expected).double())


def test_gradients_are_those_of_finite_differences():
    generator = torch.Generator().manual_seed(1)
    flow = torch.randn(1, 2, 4, 5, generator=generator, dtype=torch.float64).requires_grad_()
    assert torch.autograd.gradcheck(jacobian_determinant, [flow])


def test_what_is_no_flow_raises():
    with pytest.raises(ValueError, match=r"flow must have shape \(B, 2, H, W\)"):
        folding(torch.zeros(2, 4, 5))
