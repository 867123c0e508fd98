"""Find the coefficients of an unknown lens by gradient descent, from a frame and its distorted version.

A point at distance rho from the center moves by rho (k1 (rho / f)^2 + k2 (rho / f)^4): an image determines k1 / f^2
and k2 / f^4, but not f. So f is set to one width of the frame, and two numbers are fitted.
python examples/02_recover_a_lens.py [PICTURE] [FRAME]
"""

import sys
import warnings

import torch
from matplotlib.figure import Figure

import torchrefract as tr
from torchrefract.data.images import fit, read_image
from torchrefract.data.road_scenes import render_road_scenes

warnings.simplefilter("ignore", UserWarning)  # The optimizer tries lenses that fold the frame, of which effects warn.
out, size = sys.argv[1] if len(sys.argv) > 1 else "recover_a_lens.png", (180, 320)
clean = render_road_scenes(torch.tensor([2]), *size)[0].double()
if len(sys.argv) > 2:
    clean = fit(read_image(sys.argv[2]), size)[None].double()
effect = tr.LensDistortion(p1_range=(0, 0), p2_range=(0, 0), center_x_range=(0, 0), center_y_range=(0, 0))
params = effect.sample(clean, seed=0)


def distort(k: torch.Tensor, focal: float = 1.0) -> tr.Degraded:
    """Distort the frame by a lens with coefficients k1, k2 and a focal length in widths."""
    coefficients = torch.cat([k, k.new_zeros(10)])[None]
    return effect.apply(clean, params._replace(coefficients=coefficients, focal=k.new_full((1, 2), focal)))


k1, k2, focal = -0.31, 0.11, 0.83
target = distort(torch.tensor([k1, k2], dtype=torch.float64), focal)
truth = torch.tensor([k1 / focal**2, k2 / focal**4], dtype=torch.float64)

estimate = torch.zeros(2, dtype=torch.float64, requires_grad=True)
history = [estimate.detach().clone()]
optimizer = torch.optim.LBFGS([estimate], max_iter=10, line_search_fn="strong_wolfe")


def loss() -> float:
    """Compute the mean squared difference of the distorted frames where both are valid, and its gradient."""
    optimizer.zero_grad()
    distorted = distort(estimate)
    value = ((distorted.image - target.image).square() * (distorted.valid & target.valid)).mean()
    value.backward()
    return value.item()


for _ in range(6):
    optimizer.step(loss)
    history.append(estimate.detach().clone())
for name, value, true in zip(("k1 / f^2", "k2 / f^4"), estimate.tolist(), truth.tolist(), strict=True):
    print(f"{name}: estimated {value:.4f}, true {true:.4f}, error {abs(value / true - 1):.2%}")
axes = (figure := Figure(figsize=(6, 3), layout="constrained")).subplots()
axes.plot(torch.stack(history) / truth, marker="o", label=["k1 / f²", "k2 / f⁴"])
axes.set(xlabel="optimizer step (of ten iterations)", ylabel="estimated / true")
axes.legend()
figure.savefig(out, dpi=80)
