"""The programs that `bench.bundle` compares, each as one function from a problem to a run."""

import os
import re
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchsfm.bundle import bundle_adjust_model
from torchsfm.bundle.projection import Projection
from torchsfm.geometry import BundleProblem, Pose
from torchsfm.geometry.intrinsic_parameters import camera_from_row, row_from_camera
from torchsfm.optim import Cauchy, Huber, RigidMotion

FREE = ("focal", "k1", "k2")
TOLERANCE, ITERATIONS = 1e-6, 100
LOSSES = {"squares": None, "huber": Huber(1.0), "cauchy": Cauchy(1.0)}


@dataclass
class Run:
    """One solution: seconds and cost after each iteration (0 is the start), and how much memory it took at most."""

    trace: list[tuple[float, float]] = field(default_factory=list)
    iterations: int = 0
    cost: float = 0.0
    seconds: float = 0.0
    cpu: float = 0.0
    memory: float = 0.0
    note: str = ""


@contextmanager
def measured(run: Run) -> Iterator[None]:
    """Wall and processor seconds, and the peak of resident memory above where it began, MB."""
    before = _reset_peak()
    wall, cpu = time.perf_counter(), time.process_time()
    yield
    run.seconds, run.cpu = time.perf_counter() - wall, time.process_time() - cpu
    run.memory = _memory("VmHWM") - before


def _memory(key: str) -> float:
    try:
        text = Path("/proc/self/status").read_text()
    except OSError:
        return float("nan")
    return int(re.search(rf"{key}:\s+(\d+) kB", text)[1]) / 1024  # type: ignore[index]


def _reset_peak() -> float:
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        return float("nan")
    return _memory("VmRSS")


def run_torchsfm(problem: BundleProblem, threads: int, loss: str) -> Run:
    """This library; without compiling or warming up."""
    torch.set_num_threads(threads)
    run = Run()
    start = time.perf_counter()

    def note(iteration: int, cost: float) -> None:
        run.trace.append((time.perf_counter() - start, cost))

    with measured(run):
        result = bundle_adjust_model(
            problem, free=FREE, loss=LOSSES[loss], tolerance=TOLERANCE, max_iterations=ITERATIONS, progress=note
        ).result
    run.trace.insert(0, (0.0, result.initial_cost))
    run.cost, run.iterations, run.note = result.cost, result.iterations, result.status.name
    return run


def run_ceres(problem: BundleProblem, threads: int, loss: str, solver: str) -> Run:
    """Ceres with COLMAP's cost functions, through pycolmap."""
    import pycolmap

    reconstruction = to_pycolmap(problem)
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.refine_principal_point = False
    options.ceres.auto_select_solver_type = False
    kinds = pycolmap.LossFunctionType
    options.ceres.loss_function_type = {"squares": kinds.TRIVIAL, "huber": kinds.HUBER, "cauchy": kinds.CAUCHY}[loss]
    options.ceres.min_num_residuals_for_cpu_multi_threading = 0
    chosen = options.ceres.solver_options
    chosen.linear_solver_type = solver
    if solver == "ITERATIVE_SCHUR":
        chosen.preconditioner_type = "SCHUR_JACOBI"
    chosen.function_tolerance, chosen.max_num_iterations, chosen.num_threads = TOLERANCE, ITERATIONS, threads
    chosen.logging_type, chosen.minimizer_progress_to_stdout = "PER_MINIMIZER_ITERATION", True
    config = pycolmap.BundleAdjustmentConfig()
    for image in reconstruction.images:
        config.add_image(image)
    adjuster = pycolmap.create_default_bundle_adjuster(options, config, reconstruction)
    run = Run()
    with printed() as text, measured(run):
        summary = adjuster.solve()
    summary = getattr(summary, "ceres_summary", summary)
    rows = [line.split() for line in text() if re.match(r"\s*\d+\s", line)]
    run.trace = [(float(row[9]), float(row[1])) for row in rows if len(row) > 9]
    run.cost, run.iterations = summary.final_cost, summary.num_successful_steps + summary.num_unsuccessful_steps
    run.note = str(summary.linear_solver_type_used).rpartition(".")[2]
    return run


@contextmanager
def printed() -> Iterator[Callable[[], list[str]]]:
    """What is printed meanwhile, also by code in other languages."""
    sys.stdout.flush()
    kept = os.dup(1)
    lines: list[str] = []
    with tempfile.TemporaryFile() as file:
        os.dup2(file.fileno(), 1)
        try:
            yield lambda: lines
        finally:
            # Whatever C still holds of it.
            __import__("ctypes").CDLL(None).fflush(None)
            os.dup2(kept, 1)
            os.close(kept)
            file.seek(0)
            lines += file.read().decode(errors="replace").splitlines()


def to_pycolmap(problem: BundleProblem) -> Any:
    """The same problem as a COLMAP reconstruction, with f, k1 and k2 for each camera and a frame for every image."""
    import pycolmap

    reconstruction = pycolmap.Reconstruction()
    K, lens = problem.cameras.K, problem.cameras.distortion
    for g in range(len(K)):
        values = [K[g, 0, 0], K[g, 0, 2], K[g, 1, 2], lens.k1[g], lens.k2[g]]  # type: ignore[union-attr]
        camera = pycolmap.Camera(camera_id=g + 1, model="RADIAL", width=2000, height=2000, params=[float(v) for v in values])
        reconstruction.add_camera_with_trivial_rig(camera)
    order = torch.argsort(problem.view, stable=True)
    views = problem.poses.shape[0]
    counts = torch.bincount(problem.view, minlength=views)
    place = torch.empty_like(order)
    place[order] = torch.arange(len(order)) - (counts.cumsum(0) - counts).repeat_interleave(counts)
    for i, rows in enumerate(torch.split(order, counts.tolist())):
        points = pycolmap.Point2DList([pycolmap.Point2D(p) for p in problem.x[rows].numpy()])
        image = pycolmap.Image(name=str(i), points2D=points)
        image.image_id, image.camera_id = i + 1, int(problem.camera_index[i]) + 1
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(problem.poses.R[i].numpy()), problem.poses.t[i].numpy())
        reconstruction.add_image_with_trivial_frame(image, pose)
    tracks: list[Any] = [pycolmap.Track() for _ in range(len(problem.X))]
    for v, p, k in zip(problem.view.tolist(), problem.point.tolist(), place.tolist(), strict=True):
        tracks[p].add_element(v + 1, k)
    for X, track in zip(problem.X.numpy(), tracks, strict=True):
        reconstruction.add_point3D(X, track)
    return reconstruction


def run_scipy(problem: BundleProblem, threads: int, loss: str) -> Run:
    """SciPy's trust region with the exact sparse Jacobian and LSMR."""
    from scipy.optimize import least_squares
    from scipy.sparse import csr_matrix

    torch.set_num_threads(threads)
    rows = row_from_camera(problem.cameras)
    columns = (0, 5, 6)
    projection = Projection(type(problem.cameras.distortion), columns, skew=False)
    twelve = torch.cat((problem.poses.R.flatten(1), problem.poses.t), 1)
    v, g, n, m = len(twelve), len(rows), len(problem.X), len(problem.x)
    camera = problem.camera_index[problem.view]
    motion = RigidMotion()

    def unpack(z: Any) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        z = torch.from_numpy(z)
        new = rows.clone()
        new[:, columns] = z[6 * v : 6 * v + 3 * g].view(g, 3)
        return motion.retract(twelve, z[: 6 * v].view(v, 6)), new, z[6 * v + 3 * g :].view(n, 3)

    def arguments(z: Any) -> tuple[torch.Tensor, ...]:
        pose, new, X = unpack(z)
        return pose[problem.view], new[camera], X[problem.point], problem.x

    def residual(z: Any) -> Any:
        return projection.residual(*arguments(z)).flatten().numpy()

    offsets = (problem.view * 6, 6 * v + camera * 3, 6 * v + 3 * g + problem.point * 3)
    places = torch.cat([o[:, None] + torch.arange(w) for o, w in zip(offsets, (6, 3, 3), strict=True)], 1)[:, None].expand(
        m, 2, 12
    )
    indptr = np.arange(0, 24 * m + 1, 12)

    def jacobian(z: Any) -> Any:
        out: list[torch.Tensor | None] = [torch.empty(2, w, m, dtype=torch.float64).permute(2, 0, 1) for w in (6, 3, 3)]
        pose, new, X, x = arguments(z)
        projection.linearize(pose, new, X, x, out)
        # Steps are taken from the start: turns by the derivative of the exponential there, one for all but large ones.
        values = torch.cat([o for o in out if o is not None], 2)
        return csr_matrix((values.flatten().numpy(), places.flatten().numpy(), indptr), (2 * m, 6 * v + 3 * g + 3 * n))

    start = torch.cat((torch.zeros(6 * v, dtype=torch.float64), rows[:, columns].flatten(), problem.X.flatten())).numpy()
    run = Run()
    with measured(run):
        found = least_squares(
            residual, start, jacobian, x_scale="jac", ftol=TOLERANCE, xtol=1e-15, gtol=1e-15, max_nfev=ITERATIONS, loss="linear"
        )
    run.trace = [(0.0, float((residual(start) ** 2).sum() / 2)), (run.seconds, float(found.cost))]
    run.cost, run.iterations, run.note = float(found.cost), int(found.nfev), "trf, lsmr"
    return run


def in_front(problem: BundleProblem) -> BundleProblem:
    """Without the observations of points behind their cameras, which COLMAP leaves out."""
    keep = problem.depths() > 0
    return BundleProblem(
        Pose(problem.poses.R, problem.poses.t),
        camera_from_row(row_from_camera(problem.cameras), type(problem.cameras.distortion)),
        problem.camera_index,
        problem.X,
        problem.x[keep],
        problem.view[keep],
        problem.point[keep],
    )
