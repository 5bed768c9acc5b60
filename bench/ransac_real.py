"""Robust estimation on real pairs: error on the true points, and recall and precision of the labelled inliers."""

import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from bench.ransac_peers import answer
from torchsfm.geometry import reprojection_distance, rotation_angle, sampson_distance
from torchsfm.motion import HomographyEstimator, estimate_essential, estimate_fundamental, estimate_homography
from torchsfm.resection import estimate_camera

THRESHOLDS = (0.5, 1.0, 2.0, 4.0)
FAILED = 5.0
"""An error on the true points beyond which an answer is a failure, in pixels (for P in degrees)."""


@dataclass(frozen=True)
class Pair:
    """A real problem; `right` labels its data, `true` are points that the right model fits (F, H)."""

    group: str
    name: str
    model: str
    a: Tensor
    b: Tensor
    K: Tensor
    right: Tensor | None
    true: tuple[Tensor, Tensor] | None = None
    pose: Tensor | None = None


def pairs(folder: Path) -> Iterator[Pair]:
    """All pairs of the data sets."""
    import scipy.io

    eye = torch.eye(3, dtype=torch.float64)
    for group, model in (("homography", "H"), ("fundamental_matrix", "F")):
        for path in sorted((folder / "two_view" / group).glob("*_pts.txt")):
            rows = torch.from_numpy(np.loadtxt(path))
            if rows.ndim != 2 or rows.shape[1] < 7:
                continue
            a, b, right = rows[:, :2], rows[:, 3:5], rows[:, 6] > 0
            true, points = (a[right], b[right]), path.with_name(path.name.replace("_pts.txt", "_vpts.mat"))
            if points.exists():
                u = torch.from_numpy(np.array(scipy.io.loadmat(points)["validation"]["pts"][0, 0], dtype=np.float64))
                u = u if u.shape[0] == 6 else u.mT
                true = ((u[:2] / u[2]).mT, (u[3:5] / u[5]).mT)
            yield Pair(group, path.stem[:-4], model, a, b, eye, right, true)
    for model in "FH":
        scenes = np.load(folder / "two_view" / "adelaide_rmf" / f"{model}.npz")
        for key in sorted(k for k in scenes.files if k.endswith("_label")):
            label = torch.from_numpy(scenes[key].astype(np.int64)).flatten()
            if int(label.max()) > 1:
                continue
            data = torch.from_numpy(scenes[key.replace("_label", "_data")].astype(np.float64))
            a, b, right = data[:2].mT.contiguous(), data[3:5].mT.contiguous(), label > 0
            yield Pair("adelaide_rmf", key[:-6], model, a, b, eye, right, (a[right], b[right]))
    place = folder / "two_view" / "essential_matrix"
    rows = torch.from_numpy(np.loadtxt(place / "fountain_pts.txt", skiprows=1))
    K = torch.from_numpy(np.loadtxt(place / "fountain1.K"))
    yield Pair("essential_matrix", "fountain", "E", rows[:, :2], rows[:, 2:4], K, None)
    place = folder / "absolute_pose" / "pose6dscene"
    rows = torch.from_numpy(np.loadtxt(place / "pose6dscene_points.txt", skiprows=1))
    K, pose = (torch.from_numpy(np.loadtxt(place / f"pose6dscene{end}")) for end in (".K", "_gt.txt"))
    everything = torch.ones(len(rows), dtype=torch.bool)
    yield Pair("pose6dscene", "pose6dscene", "P", rows[:, 2:], rows[:, :2], K, everything, pose=pose)


def together(some: list[Pair], threshold: float) -> Tensor:
    """The models of pairs of different size in one call."""
    count = torch.tensor([len(pair.a) for pair in some])
    mask = torch.arange(int(count.max())) < count[:, None]
    a, b = (torch.nn.utils.rnn.pad_sequence([getattr(pair, name) for pair in some], batch_first=True) for name in "ab")
    estimate = estimate_fundamental if some[0].model == "F" else estimate_homography
    return estimate(a, b, threshold=threshold, mask=mask, generator=torch.Generator().manual_seed(0)).model


def report_together(folder: Path, peers: list[str], threshold: float = 1.0, rounds: int = 5) -> None:
    """Print the CPU time a pair of all pairs in one ragged batch, the least of some rounds, and of peers pair by pair."""
    everything = [pair for pair in pairs(folder) if pair.group in ("fundamental_matrix", "homography")]
    print("model pairs      matches candidate    ms/pair   median     mean   (all pairs in one batch; px)")
    for model in "FH":
        some = [pair for pair in everything if pair.model == model]
        arrays = [[t.numpy() for t in (pair.a, pair.b, pair.K)] for pair in some]
        sizes = [len(pair.a) for pair in some]
        for name in ("ours", *peers):
            times = []
            for _ in range(rounds):
                start = time.process_time()
                if name == "ours":
                    found = list(together(some, threshold))
                else:
                    found = [torch.from_numpy(answer(name, model, *three, threshold)) for three in arrays]
                times.append(time.process_time() - start)
            e = torch.stack([error(pair, one) for pair, one in zip(some, found, strict=True)])
            print(
                f"{model:5} {len(some):5} {min(sizes):5} - {max(sizes):4} {name:9} {min(times) / len(some) * 1e3:10.2f} "
                f"{e.median():8.4f} {e[e <= FAILED].mean():8.4f}", flush=True,
            )  # fmt: skip


def rays(x: Tensor, K: Tensor) -> Tensor:
    """Rays of image points."""
    return torch.cat((x, torch.ones_like(x[..., :1])), -1) @ K.inverse().mT


def ours(pair: Pair, threshold: float) -> Tensor:
    """The model by this package."""
    g = torch.Generator().manual_seed(0)
    if pair.model == "F":
        return estimate_fundamental(pair.a, pair.b, threshold=threshold, generator=g).model
    if pair.model == "H":
        return estimate_homography(pair.a, pair.b, threshold=threshold, generator=g).model
    if pair.model == "P":
        return estimate_camera(pair.b, pair.a, pair.K, threshold=threshold, generator=g).model
    d1, d2 = rays(pair.a, pair.K), rays(pair.b, pair.K)
    return estimate_essential(d1, d2, threshold=threshold / float(pair.K[0, 0]), generator=g).model


def distances(pair: Pair, model: Tensor, a: Tensor, b: Tensor) -> Tensor:
    """Sampson or reprojection distance in pixels, the same for everybody."""
    if pair.model == "H":
        return HomographyEstimator().squared_residual(model, a, b).sqrt()
    if pair.model == "P":
        return reprojection_distance(pair.K @ model, a, b)
    if pair.model == "E":
        model = pair.K.inverse().mT @ model @ pair.K.inverse()
    return sampson_distance(model, a, b)


def error(pair: Pair, model: Tensor) -> Tensor:
    """Root of the mean squared distance of the true points; for P the error of the rotation in degrees."""
    if pair.pose is not None:
        return torch.rad2deg(rotation_angle(model[:, :3] @ pair.pose[:, :3].mT))
    if pair.true is None:
        # Nothing is known: the median distance of all matches.
        return distances(pair, model, pair.a, pair.b).median()
    return distances(pair, model, *pair.true).square().mean().sqrt().nan_to_num(nan=torch.inf)


def report(folder: Path, peers: list[str]) -> None:
    """Print, per data set and threshold, what everybody reaches."""
    report_together(folder, peers)
    print("data set           model pairs   px candidate   median     mean failed  recall precision")
    everything = list(pairs(folder))
    for group, model in sorted({(p.group, p.model) for p in everything}):
        some = [p for p in everything if (p.group, p.model) == (group, model)]
        for threshold in THRESHOLDS:
            for name in ("ours", *peers):
                errors, recall, precision = [], [], []
                for pair in some:
                    if name == "ours":
                        found = ours(pair, threshold)
                    else:
                        arrays = [t.numpy() for t in (pair.a, pair.b, pair.K)]
                        found = torch.from_numpy(answer(name, model, *arrays, threshold))
                    empty = not bool(found.abs().sum() > 0)
                    errors.append(torch.inf if empty else float(error(pair, found)))
                    if pair.right is not None:
                        near = distances(pair, found, pair.a, pair.b) < threshold
                        hit = 0.0 if empty else float((near & pair.right).sum())
                        recall.append(hit / float(pair.right.sum()))
                        precision.append(hit / max(float(near.sum()), 1.0))
                e = np.array(errors)
                kept = e[e <= FAILED]
                rates = (np.mean(recall), np.mean(precision)) if recall else (np.nan, np.nan)
                mean = kept.mean() if len(kept) else np.nan
                print(
                    f"{group:18} {model:5} {len(some):5} {threshold:4} {name:9} {np.median(e):8.4f} {mean:8.4f} "
                    f"{(e > FAILED).sum():6} {rates[0]:7.3f} {rates[1]:9.3f}", flush=True,
                )  # fmt: skip
