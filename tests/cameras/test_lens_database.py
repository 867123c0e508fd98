import csv
import math

import pytest

from torchrefract.cameras.conversion import convert
from torchrefract.cameras.lens_database import COLUMNS, read_lenses

ROW = {
    **{"id": "a1", "camera": "Webcam", "lens": "", "model": "opencv", "width": "640", "height": "480"},
    **{"fx": "500", "fy": "505", "cx": "320", "cy": "241", "coefficients": "[-0.2, 0.05, 0.0, 0.001]"},
    **{"polynomial12": "", "residual_px": "", "covered": "", "source": "somewhere", "licence": "CC0-1.0"},
}


def written(path, *rows, columns=COLUMNS):
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, columns, extrasaction="ignore")
        writer.writeheader()
        writer.writerows(rows)
    return path


@pytest.mark.quick
def test_the_packaged_lenses_have_sources_and_no_share_alike_licence():
    lenses = read_lenses()
    assert len(lenses) > 40
    assert len({lens.name for lens in lenses}) == len(lenses)
    for lens in lenses:
        assert "/" in lens.source
        assert lens.licence
        assert "SA" not in lens.licence.replace("-", " ").split()
        assert any(lens.camera.coefficients)
    assert {lens.camera.model for lens in lenses} == {"opencv", "fisheye"}


def test_the_packaged_lenses_match_the_published_calibrations(published):
    lenses = read_lenses()
    assert {lens.name for lens in lenses} == {name for name, camera in published.items() if any(camera.coefficients)}
    for lens in lenses:
        assert lens.camera == published[lens.name]


def test_packaged_polynomials_have_the_stated_residual():
    lenses = read_lenses()
    for lens in lenses:
        if lens.polynomial is None:
            assert lens.residual_px > 1 or convert(lens.camera, to="polynomial12").covered < 1
        elif lens.camera.model == "opencv" and not any(lens.camera.coefficients[5:]):
            assert lens.residual_px == 0
            assert lens.polynomial.coefficients == lens.camera.polynomial()
        else:
            pixels = lens.camera.grid(65)
            result = lens.polynomial.project(lens.camera.unproject(pixels).points)
            assert result.valid.all()
            error = (result.points - pixels).norm(dim=1).max().item()
            assert error == pytest.approx(lens.residual_px, rel=0.2)


def test_a_user_table_is_read(tmp_path):
    (lens,) = read_lenses(written(tmp_path / "mine.csv", ROW))
    assert (lens.name, lens.title, lens.source, lens.licence) == ("a1", "Webcam", "somewhere", "CC0-1.0")
    assert lens.camera.coefficients == (-0.2, 0.05, 0.0, 0.001)
    assert lens.polynomial is not None
    assert lens.polynomial.coefficients == (-0.2, 0.05, 0.0, 0.0, 0.0, 0.0, 0.0, 0.001, 0.0, 0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("change", "rule"),
    [
        ({"coefficients": "[NaN, 0, 0, 0]"}, "with the row a1: coefficients must not be NaN"),
        ({"coefficients": ""}, "with the row a1: Expecting value"),
        ({"model": "ptlens"}, "with the row a1: model must be one of"),
        ({"model": "fisheye"}, "with the row a1: model must be polynomial12, or opencv without"),
        ({"residual_px": str(math.nan)}, "with the row a1: residual_px must be at least 0, got nan"),
    ],
)
def test_an_invalid_row_is_named(change, rule, tmp_path):
    path = written(tmp_path / "mine.csv", ROW | {"id": "a0"}, ROW | change)
    with pytest.raises(ValueError, match=f"path must hold lenses, got .*mine.csv {rule}"):
        read_lenses(path)


def test_a_table_without_a_column_or_a_row_raises(tmp_path):
    path = written(tmp_path / "mine.csv", ROW, columns=COLUMNS[:-1])
    with pytest.raises(ValueError, match=r"path must hold the columns id, .* got .*mine.csv without licence"):
        read_lenses(path)
    with pytest.raises(ValueError, match=r"path must hold lenses, got .*mine.csv without rows"):
        read_lenses(written(path))
