import numpy as np
import pytest

from torchrefract.cameras.calibration.boards import Chessboard
from torchrefract.cameras.calibration.fit import fit
from torchrefract.cameras.calibration.outliers import drop_outliers, leave_each_out

BOARD = Chessboard(squares="9x7", square_mm=25)
SIZE = (800, 600)
MATRIX = np.array([[700.0, 0, 405.0], [0, 702.0, 297.0], [0, 0, 1]])
VECTOR = np.array([-0.2, 0.06, 0.002, -0.001, 0.01])


def bent(view):
    """The corners of a board that hangs through by 8 px."""
    x = view.corners[:, 0]
    across = 2 * (x - x.min()) / (x.max() - x.min()) - 1
    return view._replace(corners=view.corners + np.stack([0 * x, 8 * (1 - across**2)], axis=1))


def test_no_view_of_a_good_set_is_dropped(projected):
    views = projected(BOARD, MATRIX, VECTOR, noise=0.2)
    kept = drop_outliers(views, BOARD, model="opencv5", size=SIZE)
    assert kept.dropped == {}
    assert [view.name for view in kept.views] == [view.name for view in views]
    assert [left.others for left in kept.ranking] == sorted(left.others for left in kept.ranking)


@pytest.mark.parametrize("bad", [(2,), (0, 7)])
def test_a_planted_bad_view_is_dropped_and_named(projected, bad):
    views = projected(BOARD, MATRIX, VECTOR, noise=0.2)
    mixed = [bent(view) if i in bad else view for i, view in enumerate(views)]
    kept = drop_outliers(mixed, BOARD, model="opencv5", size=SIZE)
    assert set(kept.dropped) == {views[i].name for i in bad}
    good = fit([view for i, view in enumerate(views) if i not in bad], BOARD, model="opencv5", size=SIZE)
    np.testing.assert_allclose(kept.fitted.intrinsics.values, good.intrinsics.values, rtol=1e-6)
    assert all(reason.startswith("held out it is off by ") for reason in kept.dropped.values())


def test_no_more_views_than_allowed_are_dropped(projected):
    views = projected(BOARD, MATRIX, VECTOR, noise=0.2)
    mixed = [bent(view) if i in (0, 7) else view for i, view in enumerate(views)]
    assert len(drop_outliers(mixed, BOARD, model="opencv5", size=SIZE, max_share=0.15).dropped) == 1
    assert drop_outliers(mixed, BOARD, model="opencv5", size=SIZE, max_share=0.0).dropped == {}


def test_leaving_a_view_out_is_a_fit_to_the_others(projected):
    views = projected(BOARD, MATRIX, VECTOR, noise=0.2)
    fitted = fit(views, BOARD, model="opencv5", size=SIZE)
    left = leave_each_out(views, BOARD, fitted, size=SIZE)[3]
    alone = fit(views[:3] + views[4:], BOARD, model="opencv5", size=SIZE)
    assert left.name == views[3].name
    assert left.others == pytest.approx(alone.rms, rel=1e-5)
    each = [float(np.sqrt((errors**2).sum(axis=1).mean())) for errors in alone.errors]
    assert left.median == pytest.approx(float(np.median(each)), rel=1e-4)
    assert left.limit >= 3 * left.median
