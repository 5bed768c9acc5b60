"""How do variants of RANSAC compare? Each experiment is a few lines: 32 image pairs at a time, one call, one figure.

Matches of two views, some right with half a pixel of noise, the others wrong; the error is how far exact points lie from the
estimated epipolar geometry. Run it as a script, or cell by cell in an editor that knows `# %%`.

    python examples/ransac_variants.py [FOLDER]

prints the numbers and saves the figures in FOLDER (ransac_variants by default).
"""

# %% The scenes, and the figures
import sys
import time
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import torch
from torch import Tensor

from torchsfm.geometry import Camera, intrinsics, sampson_distance
from torchsfm.motion import FundamentalEstimator, estimate_fundamental
from torchsfm.robust import InlierCount, LeastMedian, Magsac, Msac, soft_ransac
from torchsfm.simulation import random_points, random_poses, simulate_images

FOLDER = Path(sys.argv[1] if len(sys.argv) > 1 else "ransac_variants")
PAIRS, MATCHES, SIZE = 32, 250, (1000, 750)
Points = tuple[Tensor, Tensor]


def pairs(outliers: float, seed: int = 0, noise: float = 0.5) -> tuple[Points, Points, Tensor]:
    """Matches, their exact places, and which of them are wrong; about this share."""
    g = torch.Generator().manual_seed(seed)
    camera = Camera(intrinsics(torch.tensor(900.0).double(), torch.tensor(SIZE).double() / 2))
    images = simulate_images(
        random_points(PAIRS, MATCHES, generator=g), random_poses(PAIRS, 2, generator=g), camera, image_size=SIZE, noise=noise,
        outliers=1 - (1 - outliers) ** 0.5, generator=g,
    )  # fmt: skip
    x, exact = images.x.unbind(1), images.x_true.unbind(1)
    return (x[0], x[1]), (exact[0], exact[1]), images.outlier.any(1)


def error(F: Tensor, exact: Points) -> Tensor:
    """Median distance in pixels of the exact points of each pair."""
    return sampson_distance(F, *exact).median(-1).values


def seeded(seed: int = 1) -> torch.Generator:
    """The same samples for every variant."""
    return torch.Generator().manual_seed(seed)


def figure(name: str, x: list[float], curves: dict[str, list[float]], across: str, up: str = "median error, px") -> None:
    """A figure of some curves."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    fig, axes = plt.subplots(figsize=(5, 3.5), layout="constrained")
    for label, y in curves.items():
        axes.plot(x, y, marker="o", label=label)
    axes.set(xlabel=across, ylabel=up, yscale="log")
    if x[-1] > 10:
        axes.set_xscale("log", base=2)
    axes.legend(framealpha=0.5)
    axes.grid(alpha=0.3)
    fig.savefig(FOLDER / f"{name}.png", dpi=120)
    plt.close(fig)
    print(name)
    for label, y in curves.items():
        print(f"  {label:24s}" + "".join(f"{value:9.3f}" for value in y))


# %% Uniform samples or guided ones (PROSAC): how many samples are needed when scores say a little
shares = [0.2, 0.4, 0.55]
curves: dict[str, list[float]] = {"uniform": [], "guided by scores": []}
for share in shares:
    x, _, wrong = pairs(share)
    hints = torch.randn(wrong.shape, generator=seeded(), dtype=torch.float64) + 1.5 * ~wrong
    for label, scores in (("uniform", None), ("guided by scores", hints)):
        result = estimate_fundamental(*x, threshold=1.5, scores=scores, generator=seeded())
        curves[label].append(result.iterations.double().mean().item())
figure("sampling", shares, curves, "share of wrong matches", "samples drawn")

# %% Scores: what is best when the threshold fits, and when it does not
x, exact, _ = pairs(0.5)
thresholds = [0.5, 1.0, 2.0, 4.0, 8.0, 16.0]
curves = {}
for score in (InlierCount(), Msac(), Magsac()):
    models = [estimate_fundamental(*x, threshold=t, score=score, generator=seeded()).model for t in thresholds]
    curves[type(score).__name__] = [error(F, exact).median().item() for F in models]
blind = estimate_fundamental(*x, threshold=None, score=LeastMedian(), generator=seeded()).model
curves["LeastMedian (none)"] = [error(blind, exact).median().item()] * len(thresholds)
figure("scores", thresholds, curves, "threshold, px; true noise 0.5")

# %% Local optimisation: the best of so many samples as it is, or optimised on what agrees with it
budgets = [16, 64, 256]
curves = {"best sample": [], "locally optimised": []}
scale = 500.0
y = tuple((points - torch.tensor(SIZE).double() / 2) / scale for points in x)
exact_y = tuple((points - torch.tensor(SIZE).double() / 2) / scale for points in exact)
for budget in budgets:
    plain = soft_ransac(FundamentalEstimator(), *y, threshold=1.5 / scale, hypotheses=budget, generator=seeded()).best()
    curves["best sample"].append(scale * error(plain[..., :3], exact_y).median().item())
    local = estimate_fundamental(*y, threshold=1.5 / scale, max_iterations=budget, generator=seeded()).model
    curves["locally optimised"].append(scale * error(local, exact_y).median().item())
figure("local_optimisation", [float(b) for b in budgets], curves, "samples")

# %% Time: what a pair costs, alone and in a batch
curves = {"one by one": [], "all in one call": []}
for share in shares:
    x, _, _ = pairs(share)
    clock = time.perf_counter()
    for i in range(4):
        estimate_fundamental(x[0][i], x[1][i], threshold=1.5, generator=seeded())
    curves["one by one"].append((time.perf_counter() - clock) / 4 * 1000)
    clock = time.perf_counter()
    estimate_fundamental(*x, threshold=1.5, generator=seeded())
    curves["all in one call"].append((time.perf_counter() - clock) / PAIRS * 1000)
figure("time", shares, curves, "share of wrong matches", "milliseconds a pair")
print(f"figures saved in {FOLDER}/")
