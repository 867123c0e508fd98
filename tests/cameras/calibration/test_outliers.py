import numpy as np
import pytest

from torchrefract.cameras.calibration.boards import Chessboard
from torchrefract.cameras.calibration.fit import drop_outliers, fit_camera, leave_each_out, rms

BOARD = Chessboard(squares="9x7", square_mm=25)
OPTIONS = {"model": "opencv5", "size": (800, 600)}
MATRIX = np.array([[700.0, 0, 405.0], [0, 702.0, 297.0], [0, 0, 1]])


@pytest.fixture(scope="module")
def views(projected):
    """Return nine views with noise of 0.2 px."""
    return projected(BOARD, MATRIX, np.array([-0.2, 0.06, 0.002, -0.001, 0.01]), noise=0.2)


def bend(view):
    """Shift the corners as on a board that sags by 8 px."""
    x = view.corners[:, 0]
    t = 2 * (x - x.min()) / (x.max() - x.min()) - 1
    return view._replace(corners=view.corners + np.stack([0 * x, 8 * (1 - t**2)], axis=1))


def test_no_view_of_a_good_set_is_dropped(views):
    selection = drop_outliers(views, BOARD, **OPTIONS)
    assert selection.dropped == {}
    assert [view.name for view in selection.views] == [view.name for view in views]
    assert [result.others for result in selection.ranking] == sorted(result.others for result in selection.ranking)


def test_bent_views_are_dropped_with_a_reason(views):
    mixed = [bend(view) if i in (0, 7) else view for i, view in enumerate(views)]
    selection = drop_outliers(mixed, BOARD, **OPTIONS)
    assert set(selection.dropped) == {views[0].name, views[7].name}
    good = fit_camera([view for i, view in enumerate(views) if i not in (0, 7)], BOARD, **OPTIONS)
    np.testing.assert_allclose(selection.fit.intrinsics.values, good.intrinsics.values, rtol=1e-6)
    assert all(reason.startswith("its error is ") for reason in selection.dropped.values())
    assert len(drop_outliers(mixed, BOARD, **OPTIONS, max_share=0.15).dropped) == 1
    assert drop_outliers(mixed, BOARD, **OPTIONS, max_share=0.0).dropped == {}


def test_leaving_a_view_out_is_a_fit_to_the_others(views):
    result = leave_each_out(views, BOARD, fit_camera(views, BOARD, **OPTIONS), size=OPTIONS["size"])[3]
    others = fit_camera(views[:3] + views[4:], BOARD, **OPTIONS)
    assert result.name == views[3].name
    assert result.others == pytest.approx(others.rms, rel=1e-5)
    assert result.median == pytest.approx(float(np.median([rms(errors) for errors in others.errors])), rel=1e-4)
    assert result.limit >= 3 * result.median
