"""Rotation averaging and global positioning on view graphs with known cameras, of many families and sizes.

    python -m bench.averaging                                     # 1,000 cameras of each family, all methods
    python -m bench.averaging --views 1000 10000 100000 --families corridor crowd --methods torchsfm
    python -m bench.averaging --outliers 0 0.2 0.4 --families orbit
    python -m bench.averaging --nearest 32 --methods torchsfm     # more edges: of each camera with so many of the nearest
    python -m bench.averaging --symmetric 0.3                     # wrong edges that agree with each other
    python -m bench.averaging --positions --views 100 1000        # centres and points from true rotations

prints markdown tables. Errors are angles in degrees after the one turn of the world that fits most cameras; seconds are those
of one processor core (`time.process_time`), and MB what a process of its own takes beyond what it had when the graph was
made. The methods: `torchsfm` (with what each edge is said to be off), a spanning tree of the edges with most matches, least
squares of matrices ("chordal": Martinec & Pajdla, CVPR 2007), the same reweighted by Cauchy's loss (Holland & Welsch 1977), and
COLMAP's rotation averaging.
"""

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from bench.scale import memory
from bench.view_graphs import FAMILIES, NEAREST, ViewGraphTruth, look_around, make_view_graph
from torchsfm.geometry import similarity_from_points
from torchsfm.linalg import nearest_rotation
from torchsfm.motion import average_rotations, position_globally
from torchsfm.motion.many_views.spanning_rotations import spanning_rotations
from torchsfm.motion.many_views.triplets import turn_angle

Row = dict[str, float]
REWEIGHTED, CAUCHY = 20, 2.0
"""Rounds of reweighting, and the scale of the loss in standard deviations."""


def torchsfm(graph: ViewGraphTruth) -> Tensor:
    """This library."""
    spread = graph.deviation.square()[:, None, None] * torch.eye(3, dtype=torch.float64)
    return average_rotations(graph.R, graph.edges, views=len(graph.poses.R), deviation=spread).model


def tree(graph: ViewGraphTruth) -> Tensor:
    """Along a spanning tree of the edges that are said to be most precise."""
    return spanning_rotations(graph.R, graph.edges, -graph.deviation, len(graph.poses.R))[0]


def chordal(graph: ViewGraphTruth, weights: Tensor | None = None, start: Tensor | None = None) -> Tensor:
    """The rotations nearest to the matrices M, the first the identity, with the least squares of `M_j - R M_i`."""
    import scipy.sparse as sparse
    from scipy.sparse.linalg import splu

    n, m = len(graph.poses.R), len(graph.edges)
    w = (1 / graph.deviation if weights is None else weights / graph.deviation).numpy()
    i, j = graph.edges.numpy().T
    row = np.arange(3 * m).reshape(m, 3)
    blocks = -(w[:, None, None] * graph.R.numpy())
    rows = np.concatenate([np.repeat(row[:, :, None], 3, 2).ravel(), row.ravel()])
    columns = np.concatenate(
        [np.repeat((3 * i[:, None] + np.arange(3))[:, None], 3, 1).ravel(), (3 * j[:, None] + np.arange(3)).ravel()]
    )
    values = np.concatenate([blocks.ravel(), np.repeat(w, 3)])
    A = sparse.csc_matrix((values, (rows, columns)), (3 * m, 3 * n))
    normal = (A.T @ A).tocsc()
    found = splu(normal[3:, 3:]).solve(-normal[3:, :3].toarray())
    M = torch.from_numpy(np.concatenate([np.eye(3), found])).view(n, 3, 3)
    return nearest_rotation(M)


def reweighted(graph: ViewGraphTruth) -> Tensor:
    """The same, reweighted by what each edge is off."""
    model = chordal(graph)
    i, j = graph.edges.unbind(-1)
    for _ in range(REWEIGHTED):
        off = turn_angle(model[j] @ model[i].mT @ graph.R.mT) / (CAUCHY * graph.deviation)
        model = chordal(graph, (1 / (1 + off.square())).sqrt())
    return model


def colmap(graph: ViewGraphTruth) -> Tensor:
    """COLMAP's rotation averaging."""
    import pycolmap

    views = len(graph.poses.R)
    pycolmap.logging.minloglevel = pycolmap.logging.Level.ERROR.value
    model, pairs = pycolmap.Reconstruction(), pycolmap.PoseGraph()
    camera = pycolmap.Camera.create_from_model_name(1, "PINHOLE", 1000.0, 1000, 750)
    model.add_camera_with_trivial_rig(camera)
    for k in range(views):
        model.add_image_with_trivial_frame(pycolmap.Image(name=f"{k}", camera_id=1, image_id=k + 1))
    matches = (1 / graph.deviation.square()).long().tolist()
    for (i, j), R, count in zip(graph.edges.tolist(), graph.R.numpy(), matches, strict=True):
        edge = pycolmap.PoseGraphEdge(pycolmap.Rigid3d(pycolmap.Rotation3d(R), np.zeros(3)))
        edge.num_matches = count
        pairs.add_edge(i + 1, j + 1, edge)
    if not pycolmap.run_rotation_averaging(pycolmap.RotationEstimatorOptions(random_seed=0), pairs, model, []):
        return torch.eye(3, dtype=torch.float64).repeat(views, 1, 1)
    found = [torch.from_numpy(model.images[k + 1].cam_from_world().rotation.matrix()) for k in range(views)]
    return torch.stack(found)


METHODS: dict[str, Callable[[ViewGraphTruth], Tensor]] = {
    "torchsfm": torchsfm, "spanning tree": tree, "chordal": chordal, "chordal, reweighted": reweighted, "COLMAP": colmap,
}  # fmt: skip


def errors(model: Tensor, truth: Tensor) -> Tensor:
    """Angles to the truth in degrees, after the one turn of the world that fits most cameras."""
    difference = model.mT @ truth
    weight = torch.ones(len(model), 1, 1, dtype=torch.float64)
    for _ in range(20):
        world = nearest_rotation((weight * difference).sum(0))
        weight = 1 / turn_angle(difference @ world.mT).clamp(min=1e-4)[:, None, None]
    return torch.rad2deg(turn_angle(difference @ world.mT))


def rotations(method: str, family: str, views: int, outliers: float, symmetric: float, nearest: int) -> Row:
    """One row."""
    graph = make_view_graph(family, views, outliers=outliers, symmetric=symmetric, nearest=nearest)
    before, start = memory(), time.process_time()
    model = METHODS[method](graph)
    spent = time.process_time() - start
    found = errors(model, graph.poses.R)
    return {
        "edges": len(graph.edges), "wrong": float(graph.wrong.double().mean()), "median": float(found.median()),
        "mean": float(found.mean()), "90 %": float(found.quantile(0.9)), "largest": float(found.max()), "core-seconds": spent,
        "MB": memory() - before,
    }  # fmt: skip


def positions(method: str, family: str, views: int, outliers: float, symmetric: float, nearest: int) -> Row:
    """Centres from true rotations and rays a thousandth of a radian off, in parts of the cameras' extent.

    Cameras of several components, which no point holds together, are compared with the truth by themselves.
    """
    g = torch.Generator().manual_seed(0)
    seen = look_around(family, views, 1100.0, (1000, 750), generator=g)
    d = torch.cat(((seen.x - torch.tensor([499.5, 374.5])) / 1100.0, torch.ones(len(seen.x), 1).double()), -1)
    d[:, :2] += 1e-3 * torch.randn(len(d), 2, generator=g, dtype=torch.float64)
    wrong = torch.rand(len(d), generator=g) < outliers
    d[wrong, :2] = torch.rand(int(wrong.sum()), 2, generator=g, dtype=torch.float64) - 0.5
    before, start = memory(), time.process_time()
    found = position_globally(d, seen.view, seen.point, seen.poses.R, points=len(seen.X))
    spent = time.process_time() - start
    centre, ok = seen.poses.centre, found.status == 0
    extent = (centre - centre.mean(0)).norm(dim=-1).square().mean().sqrt()
    off = torch.zeros(views, dtype=centre.dtype)
    several = [ok & (found.component == k) for k in found.component[ok].unique()]
    for some in several:
        fit = similarity_from_points(found.centres[some], centre[some])
        off[some] = (fit.transform(found.centres[some]) - centre[some]).norm(dim=-1) / extent
    off = off[ok]
    return {
        "rays": len(d), "components": len(several), "OK": int(ok.sum()),
        "median": float(off.median()), "mean": float(off.mean()), "largest": float(off.max()),
        "core-seconds": spent, "MB": memory() - before,
    }  # fmt: skip


def main(arguments: list[str] | None = None) -> None:
    """Print the table, a line as soon as it is known."""
    parser = argparse.ArgumentParser(prog="python -m bench.averaging", description="Rotation averaging on view graphs.")
    parser.add_argument("--views", type=int, nargs="+", default=[1000])
    parser.add_argument("--families", nargs="+", choices=list(FAMILIES), default=list(FAMILIES))
    parser.add_argument("--methods", nargs="+", choices=list(METHODS), default=list(METHODS))
    parser.add_argument("--outliers", type=float, nargs="+", default=[0.2])
    parser.add_argument("--symmetric", type=float, default=0.0)
    parser.add_argument("--nearest", type=int, default=NEAREST, help="partners of each camera that are nearest to it")
    parser.add_argument("--positions", action="store_true", help="global positioning in place of rotation averaging")
    parser.add_argument("--worker", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    job, methods = (positions, ["torchsfm"]) if options.positions else (rotations, options.methods)
    if options.worker:
        (family,), (views,), (outliers,) = options.families, options.views, options.outliers
        print(json.dumps(job(methods[0], family, views, outliers, options.symmetric, options.nearest)))
        return
    titled = False
    for family in options.families:
        for views in options.views:
            for outliers in options.outliers:
                for method in methods:
                    words = [sys.executable, "-m", "bench.averaging", "--worker", "--families", family, "--views", str(views)]
                    words += ["--outliers", str(outliers), "--symmetric", str(options.symmetric), "--methods", method]
                    words += ["--nearest", str(options.nearest)] + ["--positions"] * options.positions
                    done = subprocess.run(words, capture_output=True, text=True, env=os.environ)
                    cells = [family, str(views), f"{outliers:g}", method]
                    if done.returncode:
                        print(f"| {' | '.join(cells)} | failed: {(done.stderr.strip().splitlines() or [''])[-1]} |", flush=True)
                        continue
                    row = json.loads(done.stdout.splitlines()[-1])
                    if not titled:
                        names = ["family", "cameras", "outliers", "method", *row]
                        print("| " + " | ".join(names) + " |", "|---" * len(names) + "|", sep="\n")
                        titled = True
                    cells += [f"{value:.3g}" if isinstance(value, float) else f"{value}" for value in row.values()]
                    print("| " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
