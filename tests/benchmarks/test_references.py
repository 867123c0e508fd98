from pathlib import Path

import pytest
import references
import torch
from references import REFERENCES, contrast, distances


@pytest.mark.quick
def test_the_distance_ignores_exposure_and_is_that_of_the_earth_mover():
    image = torch.full((3, 48, 64), 0.4)
    assert distances(image, image / 2) == pytest.approx([0, 0], abs=1e-3)
    split = image.clone()
    split[..., :32] = 0.2  # luma of 2/3 and 4/3 of the mean, which is 1/3 away from it
    assert distances(split, image)[0] == pytest.approx(1 / 3, abs=0.01)
    assert distances(split, image)[1] > 0.02


@pytest.mark.quick
def test_without_the_pictures_the_command_says_why_it_skips(tmp_path, run_program):
    printed = run_program(references, "--data", tmp_path / "none")
    assert printed == f"skipped: needs real pictures, and {tmp_path / 'none'} does not exist\n"


def test_a_pattern_that_names_no_clear_frames_is_an_error(run_program, shared_data, capsys):
    with pytest.raises(SystemExit):
        run_program(references, "--data", shared_data, "--clear", "frames/none*")
    assert f"--clear must name pictures in {shared_data}, got none for frames/none*" in capsys.readouterr().err


def test_a_checkpoint_is_scored_by_the_contrast_of_real_pictures_before_and_after(
    run_program, shared_data, known_model
):
    checkpoint = known_model("deweather", (0.2, 0.2, 0.2))  # more light with the same differences
    printed = run_program(references, "--data", shared_data, "--restore", checkpoint)
    rows = [line.strip("| ").split(" | ") for line in printed.splitlines()[2:]]
    assert [name for name, *_ in rows] == ["haze", "fog", "clear"]
    for _, before, after in rows:
        assert 0 < float(after) < float(before) < 1


@pytest.mark.quick
def test_the_contrast_of_a_picture_is_the_mean_deviation_of_luma_relative_to_its_mean():
    stripes = torch.tensor([0.2, 0.6]).repeat(32).expand(3, 48, 64)
    assert contrast(stripes) == pytest.approx(0.5, rel=0.02)  # +- 0.2 around 0.4, in windows of 4 or 5 stripes
    assert contrast(torch.full((3, 48, 64), 0.4)) == pytest.approx(0, abs=1e-3)


def test_every_reference_has_its_pictures(shared_data: Path):
    for reference in REFERENCES.values():
        for pattern in filter(None, (reference.real, reference.clear, reference.depth)):
            assert any(shared_data.glob(pattern)), pattern
