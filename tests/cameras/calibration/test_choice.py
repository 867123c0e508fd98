from dataclasses import replace

import numpy as np
import pytest

from torchrefract.cameras.calibration.boards import Chessboard
from torchrefract.cameras.calibration.choice import FOLDS, choose_model, is_one_to_one
from torchrefract.cameras.calibration.detection import View
from torchrefract.cameras.calibration.fit import camera_values, fit_camera, prior_deviations
from torchrefract.cameras.camera import Camera
from torchrefract.cameras.lens_database import read_lenses

BOARD = Chessboard(squares="9x7", square_mm=25)
SIZE = (800, 600)
PINHOLE = Camera(width=800, height=600, fx=700.0, fy=702.0, cx=405.0, cy=297.0, coefficients=(0.0,) * 4)
BARREL = replace(PINHOLE, coefficients=(-0.2, 0.06, 0.0, 0.0))


def largest_error(views: list[View], camera: Camera) -> float:
    """Choose and fit a model; return its largest error from the exact camera, of rays up to the border, px."""
    size, rays = (camera.width, camera.height), camera.grid(9)
    chosen, _ = choose_model(views, BOARD, size=size)
    fit = fit_camera(views, BOARD, model=chosen.model, size=size, prior=chosen.prior)
    pixels = fit.camera.project(camera.unproject(rays).points)
    assert pixels.valid.all()
    return float((pixels.points - rays).norm(dim=1).max())


@pytest.mark.parametrize(
    ("camera", "max_coefficients"),
    [(PINHOLE, 0), (BARREL, 2), (replace(PINHOLE, coefficients=(-0.03, 0.0, 0.0, 0.0), model="fisheye"), 2)],
    ids=["pinhole", "barrel", "fisheye"],
)
def test_the_lens_model_has_no_more_coefficients_than_needed(camera, max_coefficients, projected):
    chosen, tried = choose_model(projected(BOARD, camera, noise=0.3), BOARD, size=SIZE)
    assert chosen.num_coefficients <= max_coefficients
    assert not chosen.problem
    assert chosen.held_out <= 1.2 * min(one.held_out for one in tried)


@pytest.mark.parametrize(("center", "prior"), [((405.0, 297.0), "published"), ((399.5, 299.5), "centered")])
def test_the_principal_point_is_fitted_where_the_distortion_shows_it(center, prior, projected):
    lens = replace(BARREL if prior == "published" else PINHOLE, cx=center[0], cy=center[1])
    chosen, _ = choose_model(projected(BOARD, lens, noise=0.3), BOARD, size=SIZE)
    assert (chosen.num_coefficients > 0, chosen.prior) == (prior == "published", prior)


def test_edge_rays_stay_near_the_exact_camera_where_no_corner_reaches_the_border(projected):
    # The same lens in a frame of 1.5 times the sides: all corners lie in its middle.
    camera = replace(BARREL, width=1200, height=900, cx=605.0, cy=447.0)
    assert largest_error(projected(BOARD, camera, noise=0.3), camera) < 100


@pytest.mark.parametrize("name", ["ov_euroc_mav_cam0", "gf_16", "cv_aruco_params"])
def test_edge_rays_of_published_lenses_stay_near(name, projected):
    camera = next(lens.camera for lens in read_lenses() if lens.name == name)
    views = [
        view.only(((view.corners > 0) & (view.corners < (camera.width - 1, camera.height - 1))).all(axis=1))
        for view in projected(BOARD, camera, noise=0.3)
    ]
    assert largest_error([view for view in views if len(view.ids) >= 20], camera) < 30


def test_a_model_that_folds_inside_the_frame_is_refused(projected):
    # 1 + 3 k1 r^2 = 0 at r = 0.91, which the lens shows at 0.61, inside of the corners at 0.71.
    folding = replace(PINHOLE, coefficients=(-0.4, 0.0, 0.0, 0.0))
    views = projected(BOARD, folding, noise=0.3)
    chosen, tried = choose_model(views, BOARD, size=SIZE)
    assert not is_one_to_one(folding)
    assert {one.problem for one in tried if one.model == "opencv1"} == {FOLDS}
    assert is_one_to_one(fit_camera(views, BOARD, model=chosen.model, size=SIZE, prior=chosen.prior).camera)


def test_a_fit_under_a_prior_is_a_minimum(projected):
    views = projected(BOARD, BARREL, noise=0.3)[:4]
    fit = fit_camera(views, BOARD, model="opencv5", size=SIZE, prior="published")
    free = fit_camera(views, BOARD, model="opencv5", size=SIZE)
    weight = prior_deviations(fit.camera, "published") ** -2.0
    mean = np.array([0, 0, 399.5, 299.5, 0, 0, 0, 0, 0])
    degrees_of_freedom = sum(2 * len(view.ids) - 6 for view in views) - 9

    def cost(one):
        squares = sum((e**2).sum() for e in one.errors)
        return squares, (weight * (camera_values(one.camera) - mean) ** 2).sum()

    variance = cost(free)[0] / degrees_of_freedom
    assert sum(np.array(cost(fit)) * (1, variance)) < sum(np.array(cost(free)) * (1, variance))
    # Starting from the minimum does not move it.
    again = fit_camera(views, BOARD, model="opencv5", size=SIZE, prior="published", start=fit)
    np.testing.assert_allclose(again.values, fit.values, atol=0.05 * fit.deviations.max(), rtol=1e-3)
    assert (fit.deviations <= free.deviations * 1.05).all()


def test_a_centered_principal_point_stays_in_the_middle(projected):
    fit = fit_camera(projected(BOARD, BARREL, noise=0.3), BOARD, model="opencv2", size=SIZE, prior="centered")
    assert (fit.camera.cx, fit.camera.cy) == pytest.approx((399.5, 299.5), abs=1e-3)
