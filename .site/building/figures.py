"""The pictures of the page on conventions, drawn by the package itself when the site is built."""

import math
from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from typing import Any

import matplotlib as mpl
import matplotlib.pyplot as plt
import torch
from matplotlib.figure import Figure
from torch import Tensor

import torchsfm
from building.files import write_folder
from torchsfm.geometry import camera_from_krt, project_points, to_homogeneous
from torchsfm.simulation import look_at
from torchsfm.tensors import fundamental_from_cameras

F64 = torch.float64
RED, GREEN, BLUE, GREY = "#c8102e", "#2e8540", "#1f5fa8", "#777777"
STYLE = {
    "svg.hashsalt": "torchsfm", "font.size": 11, "axes.spines.top": False, "axes.spines.right": False,
}  # fmt: skip


def write(folder: Path) -> None:
    """Draw all of them."""
    with mpl.rc_context(STYLE):
        write_folder(folder, {f"{name}.svg": _svg(draw()) for name, draw in FIGURES.items()})


def _svg(figure: Figure) -> bytes:
    file = BytesIO()
    figure.savefig(file, format="svg", metadata={"Date": None}, bbox_inches="tight")
    plt.close(figure)
    return file.getvalue()


def frames() -> Figure:
    """World and camera, a point in both, and its image; seen by a second camera, whose image this is."""
    pose = look_at(torch.tensor([4.0, -3.0, 2.2], dtype=F64), torch.tensor([0.0, 0.6, 0.7], dtype=F64))
    viewer = look_at(torch.tensor([6.0, -14.0, 5.0], dtype=F64), torch.tensor([2.1, -0.6, 1.2], dtype=F64))
    camera = torchsfm.Camera(torchsfm.intrinsics(torch.tensor(1.1, dtype=F64), torch.tensor([0.5, 0.375], dtype=F64)))
    seeing = torchsfm.Camera(torchsfm.intrinsics(torch.tensor(20.0, dtype=F64), torch.zeros(2, dtype=F64)))
    X = torch.tensor([[0.5, 0.9, 1.0]], dtype=F64)
    x = project_points(pose, X, camera)
    plane = torch.cat((torch.tensor([[0, 0], [1, 0], [1, 0.75], [0, 0.75]], dtype=F64), x))
    *corners, image = pose.inverse().transform(1.5 * to_homogeneous(plane) @ torch.linalg.inv(camera.K).mT)
    figure, ax = plt.subplots(figsize=(7.5, 4.6))

    def draw(*points: Tensor, **style: Any) -> None:
        ax.plot(*project_points(viewer, torch.stack(points), seeing).T, **style)

    def write(text: str, point: Tensor, shift: tuple[float, float] = (0, 0), **style: Any) -> None:
        place = project_points(viewer, point[None], seeing)[0].tolist()
        ax.annotate(text, place, shift, textcoords="offset points", **{"ha": "center", "va": "center"} | style)

    for origin, axes, names in ((torch.zeros(3, dtype=F64), torch.eye(3, dtype=F64), "XYZ"), (pose.centre, pose.R, "xyz")):
        for axis, name, color in zip(axes, names, (RED, GREEN, BLUE), strict=True):
            ends = project_points(viewer, torch.stack((origin, origin + axis)), seeing).tolist()
            ax.annotate("", ends[1], ends[0], arrowprops={"arrowstyle": "-|>", "color": color, "lw": 2, "shrinkA": 0})
            draw(origin, origin + 1.2 * axis, alpha=0)
            write(name, origin + 1.12 * axis, color=color)
    draw(*corners, corners[0], color=GREY, lw=1)
    for corner in corners:
        draw(pose.centre, corner, color=GREY, lw=0.6)
    draw(pose.centre, X[0], color="black", lw=0.9, ls="--")
    draw(X[0], image, pose.centre, color="black", ls="none", marker="o", ms=5)
    write("world", torch.zeros(3, dtype=F64), (0, -14))
    write("centre of the camera,\nC = −R't", pose.centre, (14, 24), ha="left")
    write("point X", X[0], (0, 12))
    write("image x ~ K (R X + t)", corners[3], (4, -22), ha="left")
    ax.set(aspect="equal")
    ax.yaxis.set_inverted(True)
    ax.margins(0.12)
    ax.set_axis_off()
    return figure


def pixels() -> Figure:
    """Where (0, 0) is, and where other programs have it."""
    figure, ax = plt.subplots(figsize=(6.5, 4))
    image = torch.linspace(0.55, 0.95, 15).reshape(3, 5)[:, torch.tensor([2, 0, 3, 1, 4])]
    torchsfm.show_image(image, ax=ax)
    for edge in range(6):
        ax.axvline(edge - 0.5, color="white", lw=1.5)
        ax.axhline(edge - 0.5, color="white", lw=1.5)
    ax.plot(0, 0, "o", color=RED)
    ax.annotate("(0, 0)", (0, 0), (6, 8), textcoords="offset points", color=RED)
    ax.plot(4, 2, "o", color=RED)
    ax.annotate("(4, 2) = (width − 1, height − 1)", (4, 2), (10, -16), textcoords="offset points", color=RED, ha="right")
    ax.plot(-0.5, -0.5, "s", color=BLUE, clip_on=False)
    ax.annotate("(−0.5, −0.5): COLMAP calls this corner (0, 0)", (-0.5, -0.5), (8, 8), textcoords="offset points", color=BLUE)
    ax.set(xlim=(-0.5, 4.5), ylim=(2.5, -0.5), xticks=range(5), yticks=range(3), xlabel="x, to the right", ylabel="y, down")
    return figure


def intrinsics() -> Figure:
    """What the entries of K are lengths of."""
    figure, ax = plt.subplots(figsize=(7.5, 3.4))
    ax.plot([0, 5.4], [0, 0], color=GREY, lw=1)
    ax.plot([2, 2], [-1.3, 1.5], color="black", lw=2)
    ax.plot([0, 5], [0, 2.5 * 0.9], color="black", lw=0.9, ls="--")
    ax.plot([5, 5], [0, 2.25], color=GREY, lw=1, ls=":")
    ax.plot([0, 2, 5], [0, 0.9, 2.25], "o", color="black", ms=5)
    for text, place, options in (
        ("C", (-0.1, 0.08), {"ha": "right"}),
        ("(X, Y, Z), in the camera's frame", (5, 2.4), {"ha": "center"}),
        ("image point u", (2.1, 0.55), {}),
        ("principal point $c_x$", (2.08, -0.3), {}),
        ("u = 0", (2.08, -1.4), {}),
        ("X", (5.08, 1.1), {}),
        ("$f_x$", (1, -0.7), {"ha": "center"}),
        ("Z", (3.7, -1.0), {"ha": "center"}),
        ("$u = f_x\\,X / Z + c_x$", (0.1, 1.6), {"fontsize": 14, "color": RED}),
    ):
        ax.text(*place, text, **options)
    for left, right, y in ((0, 2, -0.4), (0, 5, -1.08)):
        ax.annotate("", (left, y), (right, y), arrowprops={"arrowstyle": "<->", "color": GREY, "lw": 0.8})
    ax.set(xlim=(-0.4, 6.6), ylim=(-1.5, 2.8), aspect="equal")
    ax.set_axis_off()
    return figure


def two_views() -> Figure:
    """Corners of a house in two images, and the lines on which the other image must have them."""
    corners = [[x, y, 0.0] for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    house = torch.tensor([*corners, *([x, y, 1.3] for x, y, _ in corners), [0, -1, 2.1], [0, 1, 2.1]], dtype=F64)
    edges = [(i, (i + 1) % 4) for i in range(4)] + [(i, i + 4) for i in range(4)] + [(5, 6), (7, 4)]
    edges += [(4, 8), (8, 5), (6, 9), (9, 7), (8, 9)]
    poses = look_at(torch.tensor([[3.2, -5.5, 1.8], [4.2, -3.2, 3.0]], dtype=F64), torch.tensor([0, 0, 0.9], dtype=F64))
    K = torchsfm.intrinsics(torch.tensor(420.0, dtype=F64), torch.tensor([180, 135], dtype=F64))
    P = camera_from_krt(K, poses.R, poses.t)
    F, x = fundamental_from_cameras(P[0], P[1]), project_points(P, house)
    marked, white = torch.tensor([1, 2, 4, 8, 6]), torch.ones(270, 360)
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.6), layout="constrained")
    torchsfm.plot_epipolar_lines(F, x[0, marked], x[1, marked], white, white, axes=tuple(axes))
    for ax, points in zip(axes, x, strict=True):
        for i, j in edges:
            ax.plot(*points[[i, j]].T, color=GREY, lw=1, zorder=0.5)
        ax.spines[:].set_visible(True)
    axes[0].set_title("image 1: points $x_1$, lines $F^T x_2$")
    axes[1].set_title("image 2: points $x_2$, lines $F\\,x_1$")
    return figure


def batches() -> Figure:
    """What the axes of a tensor of image points are, and what a mask says."""
    figure, ax = plt.subplots(figsize=(8, 3.6))
    g = torch.Generator().manual_seed(3)
    sizes, views, points = (7, 5, 6), 3, 8
    for problem, count in enumerate(sizes):
        left = problem * (points + 2.2)
        for view in range(views):
            for point in range(points):
                exists = point < count and bool(torch.rand((), generator=g) > 0.15)
                ax.add_patch(plt.Rectangle((left + point, -view), 0.88, 0.88, fc=GREEN if exists else "#e6e6e6", ec="none"))
            if problem == 0:
                ax.text(left - 0.3, 0.44 - view, f"view {view}", ha="right", va="center")
        ax.text(left + points / 2, 1.3, f"problem {problem}", ha="center")
        ax.text(left + points / 2, -views + 0.55, "points →", ha="center", va="top", color=GREY)
    ax.text(0, -3.6, "x", family="monospace", color=BLUE)
    ax.text(3.2, -3.6, "(3, 3, 8, 2)   (*batch, view, point, coordinate)", family="monospace")
    ax.text(0, -4.5, "visible", family="monospace", color=BLUE)
    ax.text(4.4, -4.5, "(3, 3, 8)   green: observed; grey: what stands there is not looked at", family="monospace")
    ax.set(xlim=(-3, 31), ylim=(-5, 2.2))
    ax.set_axis_off()
    return figure


def solutions() -> Figure:
    """Slots of the five-point solver on some random problems."""
    g = torch.Generator().manual_seed(1)
    d1, d2 = torch.randn(2, 8, 5, 3, dtype=F64, generator=g)
    d1[5] = math.nan
    valid = torchsfm.motion.essential_5pt(d1, d2).valid
    figure, ax = plt.subplots(figsize=(7, 3.8))
    ax.imshow(valid, cmap=mpl.colors.ListedColormap(["#e6e6e6", GREEN]), vmin=0, vmax=1, aspect="auto")
    for edge in range(11):
        ax.axvline(edge - 0.5, color="white", lw=2)
    for edge in range(9):
        ax.axhline(edge - 0.5, color="white", lw=4)
    labels = [f"problem {i}" + (", given NaN" if i == 5 else "") for i in range(8)]
    ax.set(xticks=range(10), yticks=range(8), yticklabels=labels, xlabel="slot")
    ax.set_title("essential_5pt(d1, d2).valid: green slots are solutions")
    ax.tick_params(length=0)
    ax.spines[:].set_visible(False)
    return figure


FIGURES: dict[str, Callable[[], Figure]] = {
    "frames": frames, "pixels": pixels, "intrinsics": intrinsics, "two_views": two_views, "batches": batches,
    "solutions": solutions,
}  # fmt: skip
