"""
10. Lines, conics and curves
============================

The world has more to offer than points. A straight edge, a wheel, the rim of a cup are seen as wholes, and no point of one
image need be known to be a point of another. This notebook finds a line, an ellipse and a curve in space. Then it redoes two
examples with which this library's ancestor, a MATLAB toolbox of Lund University, introduced itself in 1999: structure and
motion from point tracks with nothing known of the camera, and the same with curves.

*About 20 minutes. Reading: Hartley & Zisserman, sections 2.2, 3.2, 8.1 and 8.2.*
"""

# %%
import math

import matplotlib.pyplot as plt
import torch

from torchsfm import Status
from torchsfm.autocalibration import Assumption, autocalibrate_points
from torchsfm.bundle import bundle_adjust, bundle_adjust_projective
from torchsfm.geometry import (
    BundleProblem,
    Camera,
    Curve,
    Pose,
    SimpleRadial,
    camera_from_krt,
    conic_from_ellipse,
    curve_from_samples,
    foot_points,
    intrinsics,
    krt_from_camera,
    project_points,
    similarity_from_points,
)
from torchsfm.images import fit_ellipse
from torchsfm.motion import factorize_points
from torchsfm.plot import plot_lines_3d, plot_tracks
from torchsfm.simulation import look_at, random_points, random_poses, simulate_images
from torchsfm.triangulation import LineFault, triangulate_conics, triangulate_curves, triangulate_lines

torch.set_default_dtype(torch.float64)
g = torch.Generator().manual_seed(0)
SIZE = (1000, 750)
K = intrinsics(torch.tensor(900.0), torch.tensor([499.5, 374.5]))
poses = random_poses(4, spread=0.7, distance=(6.0, 7.0), generator=g)
P = camera_from_krt(K, poses.R, poses.t)
NOISE = 0.5

# %% [markdown]
# A line is where planes meet
# ---------------------------
# An image line *l* and the camera's centre span a *plane of sight*, :math:`\pi = P^T l`. Two views give two planes, and
# they meet in the line of space. The ends of the segments play no part: each view may see another piece. A line has four
# degrees of freedom; the library writes it as a Pluecker vector :math:`(d, m)`, the direction and the moment :math:`m = p
# \times d` of any of its points *p*. They are perpendicular, :math:`d^T m = 0`.

# %%
ends = torch.tensor([[-1.0, 0.3, 0.2], [1.2, -0.4, 0.5]])
pieces = ends[0] + torch.rand(4, 2, 1, generator=g).sort(1).values * (ends[1] - ends[0])  # another piece in each view
segments = project_points(P, pieces) + NOISE * torch.randn(4, 2, 2, generator=g)
line = triangulate_lines(segments[:, None], P)
direction = torch.nn.functional.normalize(ends[1] - ends[0], dim=-1)
d, m = line.model[0, :3], line.model[0, 3:]
angle = torch.linalg.cross(d, direction).norm().asin().rad2deg()
print(f"{Status(int(line.status)).name}: direction off by {angle:.2f} degrees, d'm = {d @ m:.0e}")

# %% [markdown]
# If two cameras and the line lie in one plane, the planes of sight coincide, and the line may be any line of that plane. A
# row of books seen from two places at the same height is such a case. Nearby, the line is found, but badly. We turn a line
# about the optical axis, out of that plane.

# %%
pair = look_at(torch.tensor([[-1.0, -6.0, 0.0], [1.0, -6.0, 0.0]]), torch.zeros(2, 3))
P2 = camera_from_krt(K, pair.R, pair.t)
tilt = torch.linspace(0, 90, 31)
bars = torch.stack((tilt.deg2rad().cos(), torch.zeros(31), tilt.deg2rad().sin()), -1)
seen = project_points(P2, torch.cat((-bars, bars)))  # (views, 62, 2)
flat = triangulate_lines(torch.stack((seen[:, :31], seen[:, 31:]), 2), P2)
deviation = NOISE * flat.end_covariance.diagonal(dim1=-2, dim2=-1).sum(-1).mean(-1).sqrt()
good = flat.status == Status.OK
fig, ax = plt.subplots(figsize=(7, 4), layout="constrained")
ax.semilogy(tilt[good], deviation[good], "o-")
ax.set(xlabel="angle between the line and the baseline, degrees", ylabel="standard deviation of its ends, units")
ax.set_yticks([0.02, 0.05, 0.1, 0.2], ["0.02", "0.05", "0.1", "0.2"])
ax.minorticks_off()
ax.set_title("Two views: a line along the baseline cannot be placed")
print(f"along the baseline: {Status(int(flat.status[0])).name}, because of {LineFault(int(flat.fault[0])).name}")
print(f"at {tilt[good][0]:.0f} degrees known to {deviation[good][0]:.3f}, upright to {deviation[-1]:.4f}")

# %% [markdown]
# **Exercise 1.** Add a third camera above the two. *Hint:* ``look_at`` with a third centre. Which lines are bad now?
#
# A circle is seen as an ellipse
# ------------------------------
# A conic is a symmetric matrix, :math:`x^T C x = 0`, and cameras take conics to conics. But the centre of the circle is
# *not* seen in the centre of the ellipse. Calibration with round targets is wrong by just this, if one forgets it. The same
# holds for an ellipse of space, and that is what we take: it has two axes to find, not one.

# %%
turn = torch.arange(60) * (2 * math.pi / 60)
axes_of_disc = torch.tensor([[0.9, 0.18, 0.09], [0.0, 0.6, 0.24]])
ring = torch.stack((turn.cos(), turn.sin()), -1) @ axes_of_disc
edges = project_points(P, ring) + NOISE * torch.randn(4, 60, 2, generator=g)
images = fit_ellipse(edges)
shift = (fit_ellipse(project_points(P, ring)).model.centre - project_points(P, torch.zeros(1, 3))[:, 0]).norm(dim=-1)
sure = (NOISE * images.covariance[:, :2, :2].diagonal(dim1=-2, dim2=-1).sum(-1).sqrt()).mean()
print(f"the centre's image is {shift.min():.1f} to {shift.max():.1f} px off the ellipse's centre, known to {sure:.2f} px")

ellipse = triangulate_conics(conic_from_ellipse(images.model)[:, None], P, x=edges[:, None])
print(f"{Status(int(ellipse.status)).name}: centre in space off by {ellipse.model.centre[0].norm():.4f}")

# %% [markdown]
# From each view comes a cone; the ellipse of space lies on all of them. ``triangulate_conics`` starts from the dual
# quadric, in which :math:`P Q^* P^T \sim C^*` is linear, and ends with least squares on the distances of edge points.
#
# **Exercise 2.** Compare with triangulating the centres of the four image ellipses as if they were points. How much worse
# is it?
#
# A curve without points
# ----------------------
# A bent wire: no point on it can be told from its neighbours. A sample of one image's curve has an *epipolar line* in
# another image, and where that crosses the curve there, a candidate for its depth. A third view votes.
# ``triangulate_curves`` keeps the candidates that hang together, then moves every sample *across* the curve to the least
# squares of the normal distances in all images.


# %%
def wire(t: torch.Tensor) -> torch.Tensor:
    """Points of a closed curve of space."""
    return torch.stack((t.cos(), t.sin(), 0.4 * (2 * t).sin() + 0.15 * (3 * t).cos()), -1)


def as_seen(P: torch.Tensor, samples: int) -> Curve:
    """Its images, each sampled at places of its own, with noise."""
    start = torch.rand(len(P), 1, generator=g)
    t = (torch.arange(samples) + start) * (2 * math.pi / samples)
    x = project_points(P, wire(t))
    return curve_from_samples(x + 0.2 * torch.randn(x.shape, generator=g), closed=True)


truth = curve_from_samples(wire(torch.arange(720) * (2 * math.pi / 720)), closed=True)


def gap(X: torch.Tensor) -> torch.Tensor:
    """Distances of points from the true curve."""
    return (foot_points(truth, X).x - X).norm(dim=-1)


found = triangulate_curves(as_seen(P, 60), P, samples=60)
X = found.curve.x[found.measured]
print(f"{Status(int(found.status)).name}: {len(X)} of 60 samples found, {gap(X).mean():.4f} off on average")

fig = plt.figure(figsize=(8, 6), layout="constrained")
ax = fig.add_subplot(projection="3d")
plot_lines_3d(line.ends, color="tab:green", ax=ax, linewidths=2, label="the line")
disc = ellipse.model
rim = disc.centre + torch.stack((turn.cos(), turn.sin()), -1) @ disc.axes[0, :2]
ax.plot(*torch.cat((rim, rim[:1])).T, color="tab:orange", label="the ellipse")
ax.plot(*truth.x.T, color="grey", linewidth=1, label="the wire in truth")
ax.plot(*X.T, ".", color="tab:blue", label="the wire from its images")
ax.set_aspect("equal")
ax.legend(loc="upper left")
ax.set_title("A line, an ellipse and a curve from four views")

# %% [markdown]
# The first example of 1999: nothing known
# ----------------------------------------
# Twelve images of a sequence, points tracked through them, and the camera unknown. The paper drew the tracks as curves,
# with the number of the image as the third axis. The road is that of notebook 9: factorisation by affine shape, projective
# bundle adjustment, autocalibration, and metric bundle adjustment.

# %%
VIEWS = 12
cloud = random_points(50, generator=g)
i = torch.linspace(0, 1, VIEWS)
path = torch.stack((5 * (2 * i - 1).sin(), -5 * (2 * i - 1).cos(), 1.5 * torch.sin(6 * i) + 0.5), -1)
rolled = torch.stack((torch.sin(3 * i), torch.zeros(VIEWS), torch.cos(3 * i)), -1)
moving = look_at(path, 0.3 * torch.stack((torch.cos(5 * i), torch.sin(4 * i), torch.sin(7 * i)), -1), rolled)
hidden = Camera(intrinsics(torch.tensor(850.0), torch.tensor([510.0, 366.0])))  # what is to be found
seen_points = simulate_images(cloud, moving, hidden, image_size=SIZE, noise=NOISE, dropout=0.1, generator=g)
shape = factorize_points(seen_points.x, visible=seen_points.visible)
view, point = torch.isfinite(shape.error).nonzero().unbind(-1)
bundle = bundle_adjust_projective(shape.P, shape.X, seen_points.x[view, point], view, point)
metric = autocalibrate_points(
    bundle.P, bundle.X, seen_points.x, image_size=SIZE, visible=seen_points.visible, assume=Assumption()
)
f = metric.K[0, 0, 0]
print(f"{Status(int(metric.status)).name}: f = {f:.1f} +- {f * metric.deviation[0, 0]:.1f} px, in truth 850")
_, R, t = krt_from_camera(metric.P)
start = BundleProblem.of(Pose(R, t), Camera(metric.K[:1]), metric.X, seen_points.x[view, point], view, point)
last = bundle_adjust(start, free=("focal", "principal_point"))
print(f"after the last, metric bundle adjustment: f = {last.cameras.K[0, 0, 0]:.1f} px")
world = similarity_from_points(last.X, cloud)
print(f"points off by {(world.transform(last.X) - cloud).norm(dim=-1).median():.4f} (median), the scene being 2 wide")

fig = plt.figure(figsize=(7, 5), layout="constrained")
ax = fig.add_subplot(projection="3d")
v, p = seen_points.visible.nonzero().unbind(-1)
plot_tracks(seen_points.x[v, p], v, p, image_size=SIZE, ax=ax)
ax.set_title("Tracks of points, as drawn in 1999")

# %% [markdown]
# The second example: curves
# --------------------------
# The same sequence shows the wire. Its images are closed curves without a marked point. The cameras are known now, up to a
# similarity, from the points of the first example. So the curve can be triangulated in that frame, from six of the views.

# %%
few = slice(0, VIEWS, 2)
contours = as_seen(camera_from_krt(hidden.K, moving.R, moving.t), 80)
chosen = Curve(contours.x[few], contours.valid[few], contours.closed[few])
cameras = camera_from_krt(last.cameras.K, last.poses.R, last.poses.t)
again = triangulate_curves(chosen, cameras[few], samples=60)
Y = world.transform(again.curve.x[again.measured])
print(f"{Status(int(again.status)).name}: {len(Y)} of 60 samples found, {gap(Y).mean():.4f} off on average")

fig = plt.figure(figsize=(7, 5), layout="constrained")
ax = fig.add_subplot(projection="3d")
for k in range(VIEWS):
    loop = torch.cat((contours.x[k], contours.x[k, :1]))
    ax.plot(torch.full((81,), float(k)), *loop.T, color=plt.get_cmap("viridis")(k / VIEWS), linewidth=1)
ax.set(xlabel="image", ylabel="x [px]", zlabel="y [px]", title="Images of a curve, as drawn in 1999")
ax.set_ylim3d(-0.5, SIZE[0] - 0.5)
ax.set_zlim3d(SIZE[1] - 0.5, -0.5)

# %% [markdown]
# **Exercise 3.** How many views does the curve need? Try two, three and all. With two, look at ``again.measured`` where
# epipolar lines touch the curve.
#
# What autograd adds: straight lines have to be straight
# ------------------------------------------------------
# A lens bends lines. Photographers have calibrated with plumb lines since Brown (1971): find the distortion that makes the
# images of straight threads straight. No camera pose, no structure is needed. What remains is how far the undistorted
# points of a thread are off the line that fits them best. ``Camera.unproject`` solves the lens polynomial, and has a
# derivative by the implicit function theorem. So Gauss-Newton on one number is three lines.

# %%
lens = Camera(K, SimpleRadial(torch.tensor(-0.18)))
threads = torch.linspace(-2.4, 2.4, 9)[:, None, None] * torch.tensor([1.0, 0.0, 0.0]) + torch.linspace(-1.8, 1.8, 40)[
    :, None
] * torch.tensor([0.1, 1.0, 0.0])
hung = Pose(torch.eye(3), torch.tensor([0.0, 0.0, 5.0]))
bent = lens.project(hung.transform(threads)) + 0.3 * torch.randn(9, 40, 2, generator=g)


def off_lines(k: torch.Tensor) -> torch.Tensor:
    """Distances of the undistorted points from the lines that fit them best, in pixels, (threads, points)."""
    d, _ = Camera(K, SimpleRadial(k)).unproject(bent)
    y = 900 * d[..., :2] / d[..., 2:]
    y = y - y.mean(1, keepdim=True)
    # The best line is at its minimum: turning it changes the sum of squares in second order only.
    normal = torch.linalg.eigh((y.mT @ y).detach())[1][..., :1]
    return (y @ normal)[..., 0]


k = torch.tensor(0.0)
for step in range(5):
    r, slope = torch.func.jvp(off_lines, (k,), (torch.tensor(1.0),))
    print(f"step {step}: k = {k:8.5f}, threads straight to {r.square().mean().sqrt():.3f} px")
    k = k - (r * slope).sum() / slope.square().sum()
sigma = 0.3 / slope.norm()
print(f"found {k:.4f} +- {sigma:.4f}, in truth {-0.18:.4f}")

fig, axes = plt.subplots(1, 2, figsize=(11, 4.2), layout="constrained", sharex=True, sharey=True)
for ax, value, title in ((axes[0], torch.tensor(0.0), "as photographed"), (axes[1], k, "undistorted by the k found")):
    d, _ = Camera(K, SimpleRadial(value)).unproject(bent)
    for row in d[..., :2] / d[..., 2:]:
        ax.plot(*row.T, linewidth=1.2)
    ax.set(title=title, xlabel="x, in focal lengths", aspect="equal")
axes[0].set_ylabel("y, in focal lengths")
axes[0].invert_yaxis()

# %% [markdown]
# **Exercise 4.** Let the principal point be unknown, too. *Hint:* three numbers, ``torch.func.jacfwd``, and
# ``torch.linalg.lstsq``. Is it well determined by upright threads alone?
#
# **Exercise 5.** Which measure would you take if the threads were rims of cups? *Hint:* ``fit_ellipse(...).error``. But
# what does a lens with distortion make of an ellipse?
