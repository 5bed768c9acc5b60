"""How do variants of RANSAC compare? Each experiment is a few lines: 32 image pairs at a time, one call, one figure.

Matches of two views, some right with half a pixel of noise, the others wrong; the error is how far exact points lie from the
estimated epipolar geometry. Lines are medians over the pairs, bands hold half of them. Run it as a script, or cell by cell in
an editor that knows `# %%`.

    python examples/ransac_variants.py

prints the medians and saves the figures in the folder ransac_variants.
"""

# %% The scenes, and the figures
import sys
import time
from collections.abc import Callable
from pathlib import Path

import matplotlib.pyplot as plt
import torch
from matplotlib.ticker import LogLocator
from torch import Tensor

from torchsfm.geometry import Camera, intrinsics, sampson_distance
from torchsfm.motion import FundamentalEstimator, estimate_fundamental
from torchsfm.robust import InlierCount, LeastMedian, Magsac, Msac, soft_ransac
from torchsfm.simulation import random_points, random_poses, simulate_images

FOLDER = Path("ransac_variants")
PAIRS, MATCHES, SIZE, NOISE = 32, 250, (1000, 750), 0.5
Points = tuple[Tensor, Tensor]


def pairs(outliers: float) -> tuple[Points, Points, Tensor]:
    """Matches, their exact places, and which of them are wrong; about this share."""
    g = torch.Generator().manual_seed(0)
    camera = Camera(intrinsics(torch.tensor(900.0).double(), torch.tensor(SIZE).double() / 2))
    images = simulate_images(
        random_points(PAIRS, MATCHES, generator=g), random_poses(PAIRS, 2, generator=g), camera, image_size=SIZE, noise=NOISE,
        outliers=1 - (1 - outliers) ** 0.5, generator=g,
    )  # fmt: skip
    x, exact = images.x.unbind(1), images.x_true.unbind(1)
    return (x[0], x[1]), (exact[0], exact[1]), images.outlier.any(1)


def error(F: Tensor, exact: Points) -> Tensor:
    """Median distance in pixels of the exact points of each pair."""
    return sampson_distance(F, *exact).median(-1).values


def seeded() -> torch.Generator:
    """The same samples for every variant."""
    return torch.Generator().manual_seed(1)


def compare(
    name: str, title: str, across: str, values: list[float], up: str, variants: dict[str, Callable[[float], Tensor]]
) -> None:
    """Call each variant, which returns a number for each pair, with each value; print and draw what comes out."""
    print(f"{name}: {up}\n  {across:32s}" + "".join(f"{value:8g}" for value in values))
    fig, axes = plt.subplots(figsize=(5.5, 3.8), layout="constrained")
    least, most = float("inf"), 0.0
    for label, variant in variants.items():
        levels = torch.tensor([0.25, 0.5, 0.75], dtype=torch.float64)
        low, median, high = torch.stack([variant(value).double().quantile(levels) for value in values]).T
        print(f"  {label:32s}" + "".join(f"{number:8.4g}" for number in median))
        (line,) = axes.plot(values, median, marker="o", label=label)
        axes.fill_between(values, low, high, color=line.get_color(), alpha=0.1, linewidth=0)
        least, most = min(least, float(low.min())), max(most, float(high.max()))
    axes.set(title=title, xlabel=across, ylabel=up)
    if values[-1] > 8 * values[0]:
        axes.set_xscale("log")
    if most > 8 * least:
        axes.set_yscale("log")
        axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axes.yaxis.set_major_formatter("{x:g}")
    axes.set_xticks(values, [f"{value:g}" for value in values])
    axes.minorticks_off()
    axes.legend(framealpha=0.5)
    axes.grid(alpha=0.3)
    FOLDER.mkdir(exist_ok=True)
    fig.savefig(FOLDER / f"{name}.png", dpi=120)
    if "ipykernel" in sys.modules:
        plt.show()


# %% Uniform samples or guided ones (PROSAC): how many samples are needed when scores say a little
shares = [0.2, 0.4, 0.55]
scenes = {share: pairs(share) for share in shares}


def hints(share: float) -> Tensor:
    """Scores that are higher for right matches, but not by much."""
    wrong = scenes[share][2]
    return torch.randn(wrong.shape, generator=seeded(), dtype=torch.float64) + 1.5 * ~wrong


compare(
    "sampling", "Scores of matches save samples", "share of wrong matches", shares, "samples drawn", {
        "uniform": lambda s: estimate_fundamental(*scenes[s][0], threshold=1.5, generator=seeded()).iterations,
        "guided by scores": lambda s: estimate_fundamental(
            *scenes[s][0], threshold=1.5, quality=hints(s), generator=seeded()
        ).iterations,
    },
)  # fmt: skip

# %% Scores of models: what is best when the threshold fits, and when it does not
x, exact, _ = pairs(0.5)
scorings = {type(score).__name__: score for score in (InlierCount(), Msac(), Magsac())}
blind = error(estimate_fundamental(*x, threshold=None, scoring=LeastMedian(), generator=seeded()).model, exact)
compare(
    "scores", "Magsac forgives a wrong threshold most", f"threshold in pixels (noise {NOISE})", [0.5, 1, 2, 4, 8, 16],
    "error in pixels", {
        name: lambda t, s=scoring: error(estimate_fundamental(*x, threshold=t, scoring=s, generator=seeded()).model, exact)
        for name, scoring in scorings.items()
    } | {"LeastMedian (none)": lambda _: blind},
)  # fmt: skip

# %% Local optimisation: the best of so many samples as it is, or optimised on what agrees with it
middle, unit = torch.tensor(SIZE).double() / 2, 500.0
y, exact_y = ([(points - middle) / unit for points in both] for both in (x, exact))


def best_sample(number: float) -> Tensor:
    """Estimators themselves want points of moderate size around 0; the doors see to that."""
    found = soft_ransac(FundamentalEstimator(), *y, threshold=1.5 / unit, hypotheses=int(number), generator=seeded()).best()
    return unit * error(found[..., :3], (exact_y[0], exact_y[1]))


compare(
    "local_optimisation", "Local optimisation saves samples", "samples", [16, 64, 256], "error in pixels", {
        "best sample": best_sample,
        "locally optimised": lambda number: error(
            estimate_fundamental(*x, threshold=1.5, max_iterations=int(number), generator=seeded()).model, exact
        ),
    },
)  # fmt: skip


# %% Time: what a pair costs, alone and in a batch
def milliseconds(share: float, number: int) -> Tensor:
    """For each of a few calls with so many pairs, the time for one pair."""
    x1, x2 = scenes[share][0]
    times = []
    for i in range(0, PAIRS, max(number, PAIRS // 4)):
        clock = time.perf_counter()
        estimate_fundamental(x1[i : i + number], x2[i : i + number], threshold=1.5, generator=seeded())
        times.append((time.perf_counter() - clock) / number * 1000)
    return torch.tensor(times)


compare(
    "time", "A batch is cheaper than its pairs", "share of wrong matches", shares, "milliseconds a pair", {
        "one by one": lambda share: milliseconds(share, 1), "all in one call": lambda share: milliseconds(share, PAIRS)
    },
)  # fmt: skip
print(f"figures saved in {FOLDER}/")
