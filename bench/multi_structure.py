"""Several motions or planes in one image pair: misclassification on the AdelaideRMF pairs, in per cent.

`TORCHSFM_DATA=... python -m bench.multi_structure`. The error is that of the field: the share of matches with the wrong label,
outliers being a label of their own, under the best matching of the structures found to the true ones. Preference clustering
(`estimate_fundamentals`, `estimate_homographies`) is compared with the same engine's RANSAC called again and again on what is
left. Thresholds are common to all pairs, as the field does it: each method is shown over a range of them.
"""

import argparse
import os
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from scipy.optimize import linear_sum_assignment
from torch import Tensor

from torchsfm import Status, estimate_fundamental, estimate_fundamentals, estimate_homographies, estimate_homography

F64 = torch.float64
Labels = Callable[[Tensor, Tensor, Tensor, float, torch.Generator], Tensor]
THRESHOLDS = {"F": (1.0, 2.0, 3.0, 4.0, 5.0), "H": (1.5, 2.0, 3.0, 4.0)}


def load(kind: str) -> tuple[list[str], Tensor, Tensor, Tensor, Tensor]:
    """Names, points of both images, which exist, and true labels, -1 for outliers."""
    archive = np.load(Path(os.environ["TORCHSFM_DATA"]) / "two_view" / "adelaide_rmf" / f"{kind}.npz")
    names = sorted(name[: -len("_data")] for name in archive.files if name.endswith("_data"))
    width = max(archive[name + "_data"].shape[1] for name in names)
    x = torch.zeros(len(names), width, 6, dtype=F64)
    mask = torch.zeros(len(names), width, dtype=torch.bool)
    label = torch.full((len(names), width), -1)
    for i, name in enumerate(names):
        points = torch.from_numpy(archive[name + "_data"]).mT
        x[i, : len(points)], mask[i, : len(points)] = points, True
        label[i, : len(points)] = torch.from_numpy(archive[name + "_label"].ravel().astype(int)) - 1
    return names, x[..., :2], x[..., 3:5], mask, label


def misclassification(found: Tensor, truth: Tensor) -> float:
    """Per cent of the data with a wrong label."""
    table = np.zeros((int(found.max()) + 2, int(truth.max()) + 2))
    np.add.at(table, ((found + 1).numpy(), (truth + 1).numpy()), 1)
    rows, columns = linear_sum_assignment(-table[1:, 1:])
    return float(100 * (1 - (table[0, 0] + table[1:, 1:][rows, columns].sum()) / len(found)))


def one_after_the_other(estimate: Callable[..., object], rounds: int = 6) -> Labels:
    """RANSAC on what no earlier model took, until there is no consensus."""

    def labels(x1: Tensor, x2: Tensor, mask: Tensor, threshold: float, generator: torch.Generator) -> Tensor:
        label = torch.full(mask.shape, -1)
        left, alive = mask.clone(), mask.any(-1)
        for k in range(rounds):
            result = estimate(x1, x2, threshold=threshold, mask=left & alive[:, None], generator=generator)
            alive = alive & (result.status == Status.OK)  # type: ignore[attr-defined]
            taken = result.inliers & alive[:, None]  # type: ignore[attr-defined]
            label[taken] = k
            left = left & ~taken
        return label

    return labels


def clustered(estimate: Callable[..., object]) -> Labels:
    """Preference clustering."""

    def labels(x1: Tensor, x2: Tensor, mask: Tensor, threshold: float, generator: torch.Generator) -> Tensor:
        found: Tensor = estimate(x1, x2, threshold=threshold, mask=mask, generator=generator).label  # type: ignore[attr-defined]
        return found

    return labels


METHODS: dict[str, dict[str, Labels]] = {
    "F": {"clustering": clustered(estimate_fundamentals), "sequential": one_after_the_other(estimate_fundamental)},
    "H": {"clustering": clustered(estimate_homographies), "sequential": one_after_the_other(estimate_homography)},
}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="python -m bench.multi_structure", description=__doc__)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--pairs", action="store_true", help="print every pair's error too")
    options = parser.parse_args()
    torch.set_num_threads(1)
    print(f"{'model':5s} {'method':11s} {'px':>4s} {'mean':>6s} {'median':>6s} {'worst':>6s} {'ms a pair':>9s}")
    for kind, methods in METHODS.items():
        names, x1, x2, mask, truth = load(kind)
        for method, labels in methods.items():
            for threshold in THRESHOLDS[kind]:
                errors, clock = [], time.process_time()
                for seed in range(options.seeds):
                    found = labels(x1, x2, mask, threshold, torch.Generator().manual_seed(seed))
                    errors.append([misclassification(f[m], t[m]) for f, t, m in zip(found, truth, mask, strict=True)])
                seconds = (time.process_time() - clock) / options.seeds / len(names)
                error = np.mean(errors, 0)
                figures = f"{error.mean():6.2f} {np.median(error):6.2f} {error.max():6.2f} {1000 * seconds:9.0f}"
                print(f"{kind:5s} {method:11s} {threshold:4.1f} {figures}")
                if options.pairs:
                    print("    " + ", ".join(f"{name} {e:.1f}" for name, e in zip(names, error, strict=True)))


if __name__ == "__main__":
    main()
