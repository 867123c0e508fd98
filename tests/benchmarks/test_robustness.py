"""Costs of the robustness command beside those of a model."""

import pytest
import robustness
import torch

from torchrefract import presets


@pytest.mark.filterwarnings("ignore:depth is that of a road")  # scenes assume a depth; the test counts pictures
def test_a_model_predicts_the_clean_picture_and_one_for_each_level_both_times(monkeypatch):
    monkeypatch.setattr(presets, "SEVERITIES", (1, 5))
    robustness.scenes.cache_clear()
    shapes = []

    def predict(images):
        shapes.append(images.shape)
        return torch.zeros(1, 2)

    bare, evaluation = robustness.model_cost(predict, [torch.rand(3, 54, 96)])
    robustness.scenes.cache_clear()
    assert shapes == [(1, 3, 54, 96)] * 2 * (1 + 6 * 2)
    assert evaluation > bare > 0


def test_the_command_prints_each_scene_and_the_ratio_of_each_model(monkeypatch, run_program):
    monkeypatch.setattr(presets, "SEVERITIES", (3,))
    robustness.scenes.cache_clear()
    lines = run_program(robustness, "--count", "1", "--size", "90x160", "--models", "opencv:hog").splitlines()
    robustness.scenes.cache_clear()
    assert [line.split()[0] for line in lines[1:7]] == robustness.DAY_SCENES
    assert lines[-1].startswith("opencv:hog: ")
    assert "bar <= 1.2 x the model alone" in lines[-1]
