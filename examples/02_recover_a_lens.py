"""An unknown lens found by gradient descent, from one frame as it is and as the lens shows it.

A pixel at a distance rho from the center moves by k1 (rho / f)^2 + k2 (rho / f)^4 of it: no image can tell more than
k1 / f^2 and k2 / f^4. So f is taken as one width of the frame, and these two are found.

python examples/02_recover_a_lens.py [PICTURE.png] [FRAME]
"""

import sys

import torch
from matplotlib.figure import Figure

import torchrefract as tr
from torchrefract.data.images import fit, read_image
from torchrefract.data.road_scenes import render_road_scenes

out, size = sys.argv[1] if len(sys.argv) > 1 else "recover_a_lens.png", (180, 320)
frame = (
    fit(read_image(sys.argv[2]), size)[None] if len(sys.argv) > 2 else render_road_scenes(torch.tensor([29]), *size)[0]
)
clean = frame.double()
effect = tr.LensDistortion(p1_range=(0, 0), p2_range=(0, 0), center_x_range=(0, 0), center_y_range=(0, 0))
params = effect.sample(clean, seed=0)


def seen_through(k: torch.Tensor, focal: float = 1.0) -> tr.Degraded:
    """The frame as a lens with k1, k2 and a focal length in widths shows it."""
    coefficients = torch.cat([k, k.new_zeros(10)])[None]
    return effect.apply(clean, params._replace(coefficients=coefficients, focal=k.new_full((1, 2), focal)))


k1, k2, focal = -0.31, 0.11, 0.83
target = seen_through(torch.tensor([k1, k2], dtype=torch.float64), focal)
truth = torch.tensor([k1 / focal**2, k2 / focal**4], dtype=torch.float64)

found = torch.zeros(2, dtype=torch.float64, requires_grad=True)
history = [found.detach().clone()]
optimizer = torch.optim.LBFGS([found], max_iter=10, line_search_fn="strong_wolfe")


def loss() -> float:
    """How much the frames differ where both lenses show some of it."""
    optimizer.zero_grad()
    made = seen_through(found)
    value = ((made.image - target.image).square() * (made.valid & target.valid)).mean()
    value.backward()
    return value.item()


for _ in range(6):
    optimizer.step(loss)
    history.append(found.detach().clone())
for name, value, true in zip(("k1 / f^2", "k2 / f^4"), found.tolist(), truth.tolist(), strict=True):
    print(f"{name}: found {value:.4f}, true {true:.4f}, {abs(value / true - 1):.2%} off")
axes = (figure := Figure(figsize=(6, 3), layout="constrained")).subplots()
axes.plot(torch.stack(history) / truth, label=["k1 / f²", "k2 / f⁴"])
axes.set(xlabel="round of ten steps", ylabel="found / true")
axes.legend()
figure.savefig(out, dpi=80)
