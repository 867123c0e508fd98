import json
import math
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from torchrefract.cameras.calibration import LensEstimate, estimate_lens
from torchrefract.cameras.calibration.lens_estimate import radial_lens_of_flow
from torchrefract.cameras.calibration.uncertainty import rectified_deviation
from torchrefract.cameras.camera import Camera
from torchrefract.data.images import read_image
from torchrefract.fields.rectification import camera_flow
from torchrefract.warping.flow import resize_flow

HEIGHT, WIDTH = 180, 320
HALF_DIAGONAL = math.hypot(HEIGHT, WIDTH) / 2


def camera_of(k1: float, k2: float, *, scale: float = 1.0) -> Camera:
    """Return a camera whose coefficients are relative to the half diagonal of the frame."""
    pinhole: dict[str, Any] = {
        "fx": HALF_DIAGONAL * scale,
        "fy": HALF_DIAGONAL * scale,
        "cx": (WIDTH - 1) / 2,
        "cy": (HEIGHT - 1) / 2,
    }
    return Camera(width=WIDTH, height=HEIGHT, **pinhole, coefficients=(k1 * scale**2, k2 * scale**4, 0.0, 0.0))


def flow_of(k1: float, k2: float) -> Tensor:
    return camera_flow(camera_of(k1, k2))[0]


def blank(count: int) -> list[Tensor]:
    return [torch.full((3, HEIGHT, WIDTH), 0.5) for _ in range(count)]


@pytest.mark.quick
@pytest.mark.parametrize("numbers", [(-0.16, 0.06), (0.1, -0.02), (0.0, 0.0)])
def test_the_camera_of_a_flow_is_found_whatever_its_zoom_and_size(numbers):
    expected = torch.tensor(numbers, dtype=torch.float64)
    torch.testing.assert_close(radial_lens_of_flow(flow_of(*numbers)), expected, atol=1e-6, rtol=0)
    zoomed = camera_flow(camera_of(*numbers), zoom=1.25)[0]
    # The zoom is that of the rectified frame. The lens, which bends lines of the distorted one, stays the same.
    torch.testing.assert_close(radial_lens_of_flow(zoomed), expected, atol=1e-5, rtol=0)
    squeezed = resize_flow(flow_of(*numbers), (90, 130))
    torch.testing.assert_close(radial_lens_of_flow(squeezed, aspect=WIDTH / HEIGHT), expected, atol=2e-4, rtol=0)


def test_the_flows_of_a_network_give_the_lens_if_frames_show_no_edges():
    flows = iter([flow_of(-0.15, 0.05), flow_of(-0.17, 0.05), flow_of(-0.16, 0.05), flow_of(0.3, 0.1)])
    result = estimate_lens(blank(4), predict=lambda frame: next(flows))
    k1, k2 = (
        value / (result.camera.fx / HALF_DIAGONAL) ** n
        for value, n in zip(result.camera.coefficients[:2], (2, 4), strict=True)
    )
    assert (k1, k2) == pytest.approx((-0.16, 0.05), abs=0.01)
    assert (result.num_frames, result.num_chains, result.num_straight) == (4, 0, 0)
    assert any("0 straight edges" in message for message in result.warnings)


def test_frames_without_edges_give_no_distortion_and_say_so():
    result = estimate_lens(blank(2))
    assert result.camera.coefficients == pytest.approx((0.0,) * 4, abs=1e-9)
    assert not result.is_distorted
    assert len(result.warnings) == 2
    assert result.warnings[1].startswith("the lens cannot be distinguished from no distortion")


def test_a_lens_that_is_as_vague_as_it_is_strong_is_warned_of():
    result = estimate_lens(blank(4), predict=lambda frame: flow_of(-0.3, 0.05))
    assert result.is_distorted
    assert result.edge_px > 0.1 * WIDTH
    assert result.warnings[-1].startswith(
        f"the lens is vague: the rectified position has a standard deviation of {result.edge_px:.0f} px, more than 2% "
    )


def test_the_field_of_view_scales_the_coefficients_and_leaves_the_mapping(drive):
    frames = drive((-0.16, 0.06), 6)[:2]
    narrow, wide = (estimate_lens(frames, fov_deg=angle) for angle in (40.0, 110.0))
    assert wide.camera.fx == pytest.approx(240 / math.tan(math.radians(55)))
    a, b = (camera_flow(result.camera)[0] for result in (narrow, wide))
    assert (a - b).abs().max() < 1e-3
    assert narrow.corner_px == pytest.approx(wide.corner_px, rel=1e-3)


def test_a_known_lens_is_found_in_frames_of_straight_edges_and_none_in_frames_without(drive):
    bent, straight = (estimate_lens(drive(numbers, 6)) for numbers in ((-0.16, 0.06), (0.0, 0.0)))
    assert (bent.num_frames, bent.is_distorted, bent.warnings) == (6, True, ())
    errors = [shift_px(result, numbers) for result, numbers in ((bent, (-0.16, 0.06)), (straight, (0.0, 0.0)))]
    nothing = shift_px(straight, (-0.16, 0.06))
    assert errors[0] < 0.15 * nothing
    assert errors[1] < 0.1 * nothing
    assert not straight.is_distorted


def test_the_covariance_gives_the_printed_deviations(drive):
    result = estimate_lens(drive((-0.16, 0.06), 6)[:1])
    points = np.array([[479.0, 134.5], [479.0, 269.0]])
    edge, corner = rectified_deviation(result.camera, result.covariance, points)
    assert (edge, corner) == pytest.approx((result.edge_px, result.corner_px), rel=1e-6)
    assert np.linalg.eigvalsh(result.covariance).min() > -1e-12


def test_the_lens_of_a_real_wide_camera_is_found_in_three_pictures(shared_data):
    """Hold the accuracy on a camera with a calibration: half of the error of doing nothing at most."""
    folder = shared_data / "chessboard"
    fit = json.loads((folder / "reference.json").read_text())["pjlab_wide"]["opencv_5param"]
    names = ("fx", "fy", "cx", "cy")
    truth = Camera(width=1920, height=1200, **{n: fit[n] for n in names}, coefficients=tuple(fit["dist_k1k2p1p2k3"]))
    result = estimate_lens(read_image(folder / "pjlab_wide" / f"{i:02}.jpg") for i in (2, 12, 20))
    assert result.is_distorted
    pixels = truth.grid(21)

    def shown_by(camera: Camera) -> Tensor:
        _, focal, center = camera.tensors(pixels)
        return camera.distort((pixels - center) / focal).points * focal + center

    expected = shown_by(truth)
    inside = ((expected >= 0) & (expected <= torch.tensor([1919, 1199]))).all(dim=1)
    error, nothing = ((at - expected)[inside].norm(dim=1).mean() for at in (shown_by(result.camera), pixels))
    assert error < 0.5 * nothing


def test_frames_of_uint8_have_the_lens_of_floating_ones(drive):
    frames = [(frame * 255).round() for frame in drive((-0.16, 0.06), 6)[:2]]
    estimate, expected = (estimate_lens(f) for f in ([f.byte() for f in frames], [f / 255 for f in frames]))
    assert estimate.num_straight == expected.num_straight
    assert estimate.camera == expected.camera


@pytest.mark.parametrize(
    ("frames", "message"),
    [
        ([], "frames must hold at least one frame, got none"),
        (
            [torch.zeros(3, 40, 60), torch.zeros(3, 60, 40)],
            "frames must be of one size.* got 60 x 40 px and, in frame 1, 40 x 60",
        ),
        ([torch.full((3, 40, 60), 128.0)], r"frames must lie in \[0, 1\] or be uint8, got a mean of 128; divide"),
        ([torch.zeros(1, 40, 60)], r"frames must have shape \(3, H, W\) or \(1, 3, H, W\), got \(1, 40, 60\)"),
    ],
)
def test_invalid_frames_raise(frames, message):
    with pytest.raises(ValueError, match=message):
        estimate_lens(frames)


def test_an_invalid_field_of_view_raises():
    with pytest.raises(ValueError, match=r"fov_deg must be a number in \[1, 170\], got 180"):
        estimate_lens(blank(1), fov_deg=180.0)


def shift_px(result: LensEstimate, numbers: tuple[float, float]) -> float:
    """Return the mean distance, px, between the flows of an estimate and of a lens relative to the half diagonal."""
    height, width = result.camera.height, result.camera.width
    f = math.hypot(height, width) / 2
    pinhole: dict[str, Any] = {"fx": f, "fy": f, "cx": (width - 1) / 2, "cy": (height - 1) / 2}
    truth = Camera(width=width, height=height, **pinhole, coefficients=(*numbers, 0.0, 0.0))
    return (camera_flow(result.camera)[0] - camera_flow(truth)[0]).norm(dim=1).mean().item()
