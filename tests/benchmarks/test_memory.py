import memory
import pytest
import torch


def test_the_peak_is_what_is_held_at_once():
    x = torch.zeros(64, 1024)
    for call, tensors in (
        (x.clone, 1),
        (lambda: (x + 1) * 2, 2),
        (lambda: ((x + 1) * 2).add(1), 2),
        (lambda: (x + 1) + (x + 2), 3),
        (lambda: [x + i for i in range(5)], 5),
    ):
        assert memory.peak_bytes(call) == pytest.approx(tensors * x.nbytes, rel=1e-3)


def test_weather_takes_at_most_three_images():
    frame = torch.rand(1, 3, 1080, 1920)
    found = memory.candidates(frame)
    names = memory.weather(list(found))
    assert len(names) == 7
    for name in names:
        share = memory.peak_bytes(found[name]) / frame.nbytes
        assert 1 <= share <= memory.LIMIT, name
