"""
9. Three views, many views, unknown cameras
===========================================

How much can be found from images alone, if nothing is known of the cameras? Three views have a tensor that transfers points and
lines. Many views can be factorised: all cameras and all points at once, up to a projective distortion of space. Autocalibration
removes the distortion, except where the motion of the camera hides what is needed. Then a good library must say no.

*About 20 minutes. Reading: Hartley & Zisserman, chapters 15, 18.2, 18.4 and 19.*
"""

# %%
import math

import matplotlib.pyplot as plt
import torch

from torchsfm import Status
from torchsfm.autocalibration import Assumption, Autocalibration, autocalibrate_points
from torchsfm.bundle import bundle_adjust, bundle_adjust_projective, bundle_covariance
from torchsfm.geometry import (
    BundleProblem,
    Camera,
    Pose,
    camera_from_krt,
    from_homogeneous,
    intrinsics,
    project_points,
    similarity_from_points,
    to_homogeneous,
)
from torchsfm.motion import factorize_affine, factorize_points
from torchsfm.plot import plot_points_3d
from torchsfm.simulation import look_at, orbit_poses, random_points, random_poses, simulate_images
from torchsfm.tensors import (
    epipolar_lines,
    fundamental_from_cameras,
    transfer_points_trifocal,
    trifocal_from_cameras,
)

torch.set_default_dtype(torch.float64)

# %% [markdown]
# Three views: transfer
# ---------------------
# A point is seen in views 1 and 2. Where is it in view 3? With fundamental matrices, intersect two epipolar lines,
# :math:`x_3 \sim (F_{31}\, x_1) \times (F_{32}\, x_2)`. That fails if the lines coincide, which they do for every point of
# the *trifocal plane* through the three centres; and for *all* points if the centres are on a line. The *trifocal tensor*
# does not mind. It is three 3x3 matrices made of the cameras, and
#
# .. math:: x_3^k = x_1^i\, l_{2j}\, T_i^{jk},
#
# where :math:`l_2` is a line through :math:`x_2`. Geometrically: the ray of :math:`x_1` meets the plane of :math:`l_2` in a
# point, and view 3 sees it.
#
# Three cameras on a curve that we bend more and more: on the left of the figure it is a line.

# %%
SIZE = (1200, 900)
FOCAL = 1000.0
K = intrinsics(torch.tensor(FOCAL), torch.tensor([620.0, 440.0]))
g = torch.Generator().manual_seed(0)
X = random_points(200, generator=g)
bends = torch.logspace(-3, 0, 10)
errors: dict[str, list[float]] = {"two epipolar lines": [], "trifocal tensor": []}
for bend in bends:
    centre = torch.stack((torch.tensor([-1.0, 0.0, 1.0]), torch.full((3,), -5.0), bend * torch.tensor([0.0, 1.0, 0.0])), -1)
    three = look_at(centre, torch.tensor([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.0, 0.1]]))
    P = camera_from_krt(K, three.R, three.t)
    exact = project_points(P, X)
    x1, x2 = (exact[:2] + 0.5 * torch.randn(2, 200, 2, generator=g)).unbind(0)
    lines = epipolar_lines(fundamental_from_cameras(P[0], P[2]), x1), epipolar_lines(fundamental_from_cameras(P[1], P[2]), x2)
    by_lines, _ = from_homogeneous(torch.linalg.cross(*lines))
    by_tensor = transfer_points_trifocal(trifocal_from_cameras(*P), x1, x2)
    for name, x3 in zip(errors, (by_lines, by_tensor), strict=True):
        errors[name].append(float((x3 - exact[2]).norm(dim=-1).median()))
fig, ax = plt.subplots(figsize=(7, 4), layout="constrained")
for name, values in errors.items():
    ax.loglog(bends, values, "o-", label=name)
    print(f"{name:18s}: {values[0]:7.2f} px off, centres nearly on a line; {values[-1]:.2f} px in a triangle")
ax.set(xlabel="bend of the path (units)", ylabel="median error in view 3, pixels", title="Transfer to the third view")
ax.legend()

# %% [markdown]
# **Exercise 1.** Compute *T* from the points alone: ``torchsfm.motion.trifocal_7pt`` takes views stacked, ``(3, n, 2)``.
# How far are transferred points off, with seven points and with fifty?
#
# **Exercise 2.** A line is the image of a plane through the centre. Why do two views say nothing about whether two image
# lines match, while three do? *Hint:* two planes always meet in a line.

# %% [markdown]
# Many views: rank
# ----------------
# A camera far from a shallow scene is nearly *affine*: :math:`x_{ij} = M_i X_j + t_i`. Subtract the centroid of each image
# and stack all coordinates of all views in one matrix *W*, two rows a view, one column a point. Then :math:`W = M X` has
# rank *three*, however many views and points there are. Tomasi and Kanade (1992) read cameras and points off its singular
# value decomposition.
#
# Below are the singular values of *W* for a camera that comes nearer. Far away only noise is left from the fourth on. Near
# by, perspective shows.

# %%
fig, ax = plt.subplots(figsize=(7, 4), layout="constrained")
for distance, color in ((200.0, "tab:blue"), (20.0, "tab:orange"), (5.0, "tab:red")):
    turned = random_poses(12, distance=(distance, distance), generator=torch.Generator().manual_seed(1))
    zoom = Camera(intrinsics(torch.tensor(FOCAL * distance / 5), torch.tensor([620.0, 440.0])))
    seen = simulate_images(X, turned, zoom, noise=0.5, generator=g)
    W = (seen.x - seen.x.mean(1, keepdim=True)).mT.flatten(0, 1)
    values = torch.linalg.svdvals(W)
    ax.semilogy(range(1, 13), values[:12], "o-", color=color, label=f"from a distance of {distance:.0f}")
    affine = factorize_affine(seen.x)
    root = affine.error.square().mean().sqrt()
    print(f"distance {distance:5.0f}: singular value 4 is {values[3] / values[0]:.1e} of the first; affine: {root:.2f} px off")
ax.axhline(0.5 * (math.sqrt(24) + math.sqrt(200)), color="grey", linestyle=":", label="largest that noise alone makes")
ax.set(xlabel="number", ylabel="singular value of W, pixels", title="Twelve views of 200 points: rank three from afar")
ax.legend()

# %% [markdown]
# With perspective the rank is four, if each image point is multiplied by its *depth*: :math:`\lambda_{ij} (x_{ij}, 1) = P_i
# X_j`. The depths are unknown. So find depths that make the stacked matrix as near to rank four as possible. Sparr's
# *shape* is a good way to say it: each image's depths and points span a space of dimension at most four, and all images'
# spaces are the same one. ``factorize_points`` descends on that *proximity*, without a first pair of views, and with points
# missing.
#
# The scene is a corner of a cube, so that we can see what happens to it.

# %%
u = torch.cartesian_prod(torch.linspace(-0.9, 0.9, 5), torch.linspace(-0.9, 0.9, 5))
wall = torch.full((25, 1), -0.9)
corner = torch.cat((torch.cat((u, wall), -1), torch.cat((u[:, :1], wall, u[:, 1:]), -1), torch.cat((wall, u), -1)))
colors = torch.eye(3).repeat_interleave(25, 0) * 0.75
camera = Camera(K)


def observe(poses: Pose) -> tuple[torch.Tensor, torch.Tensor]:
    """Image points with half a pixel of noise, and which are visible: a third is missing."""
    generator = torch.Generator().manual_seed(5)
    seen = simulate_images(corner, poses, camera, image_size=SIZE, noise=0.5, dropout=0.3, generator=generator)
    return seen.x, seen.visible


around = random_poses(12, spread=math.pi / 2.5, distance=(4.5, 6.0), generator=torch.Generator().manual_seed(2))
x, visible = observe(around)
found = factorize_points(x, visible=visible)
view, point = torch.isfinite(found.error).nonzero().unbind(-1)
bundle = bundle_adjust_projective(found.P, found.X, x[view, point], view, point)
print(f"factorisation: {Status(int(found.status)).name}, proximity {found.proximity[-1]:.1e}, {len(view)} observations")
before, reached = found.error[view, point].square().mean().sqrt(), bundle.residuals.square().mean().sqrt()
print(f"reprojection error: {before:.3f} px, after projective bundle adjustment {reached:.3f} px")

# %% [markdown]
# The images are explained to the noise. But *P* and *X* are one of many: for any invertible 4x4 matrix *H* the cameras
# :math:`P H^{-1}` and the points :math:`H X` have the same images. Straight lines stay straight, and that is all.
#
# From projective to metric
# -------------------------
# Fifteen numbers of *H* are unknown, seven of which are the gauge of notebook 8. The other eight are the *plane at
# infinity* and the intrinsics of one camera. *Autocalibration* finds them from what is known of all cameras: here, that
# they are the same camera with square pixels. In the terms of the *dual absolute quadric*, :math:`Q^*`, every view gives
#
# .. math:: P_i\, Q^* P_i^T \sim K K^T.

# %%
metric = autocalibrate_points(bundle.P, bundle.X, x, image_size=SIZE, visible=visible, assume=Assumption())
f, cx, cy = metric.K[0, 0, 0], metric.K[0, 0, 2], metric.K[0, 1, 2]
relative, _, _, dx, dy = metric.deviation[0].tolist()
print(f"autocalibration: {Status(int(metric.status)).name}")
print(f"focal length {f:.1f} +- {relative * f:.1f} px, in truth {FOCAL:.0f}")
print(f"principal point ({cx:.1f} +- {dx:.1f}, {cy:.1f} +- {dy:.1f}) px, in truth (620, 440)")

aligned = similarity_from_points(metric.X, corner).transform(metric.X)
print(f"points off by {(aligned - corner).norm(dim=-1).median():.4f} of the cube's 1.8 units (median)")
# One projective frame of many: the metric one, distorted by hand so that it is still recognised.
H = torch.eye(4)
H[3, :3] = torch.tensor([0.18, 0.12, -0.15])
projective, _ = from_homogeneous(to_homogeneous(aligned) @ H.T)
fig = plt.figure(figsize=(11, 5), layout="constrained")
for k, (points, title) in enumerate(((projective, "one projective reconstruction"), (aligned, "after autocalibration"))):
    ax = plot_points_3d(points, color=colors, ax=fig.add_subplot(1, 2, k + 1, projection="3d"), s=14)
    ax.view_init(elev=28, azim=38)
    ax.locator_params(nbins=5)
    ax.set_title(title)

# %% [markdown]
# Both explain the images equally well. On the right, angles are right.
#
# **Exercise 3.** Reproject both with the cameras :math:`P H^{-1}` and *P* and compare. *Hint:* ``torch.linalg.inv(H)``.

# %% [markdown]
# Critical motions
# ----------------
# Some motions leave a family of calibrations that all fit (Sturm 1997). Which ones depends on what is assumed. A camera
# that only moves sideways is the worst: nothing tells its focal length. A camera carried around an object at constant
# height turns about one axis, which is critical if nothing is known of *K*; it is not if pixels are square. What does the
# library say?


# %%
def from_images(poses: Pose) -> tuple[float, Autocalibration]:
    """Error of the projective reconstruction in pixels, and the autocalibration."""
    x, visible = observe(poses)
    found = factorize_points(x, visible=visible)
    view, point = torch.isfinite(found.error).nonzero().unbind(-1)
    bundle = bundle_adjust_projective(found.P, found.X, x[view, point], view, point)
    error = float(bundle.residuals.square().mean().sqrt())
    return error, autocalibrate_points(bundle.P, bundle.X, x, image_size=SIZE, visible=visible, assume=Assumption())


i = torch.linspace(-1, 1, 12)
start = look_at(torch.tensor([3.0, 3.0, 2.4]), torch.zeros(3))
sideways = torch.stack((1.5 * i, torch.zeros(12), torch.zeros(12)), -1)
motions = {
    "all around": around,
    "moving sideways": Pose(start.R.expand(12, 3, 3), start.t + sideways),
    "carried around": orbit_poses(12, radius=4.5, height=(2.0, 2.0), sweep=1.4, start=0.1),
}
for name, poses in motions.items():
    error, result = (float(reached), metric) if poses is around else from_images(poses)
    motion = result.motion
    kinds = [kind for kind in ("translation", "one_axis", "collinear", "orbital") if bool(getattr(motion, kind))]
    status, f, relative = Status(int(result.status)).name, result.K[0, 0, 0], result.deviation[0, 0]
    print(f"{name:15s}: {error:.2f} px {status:10s} f = {f:4.0f} +- {relative:.1%}; {', '.join(kinds) or 'general'}")

# %% [markdown]
# The projective reconstruction is as good in all cases: its error comes first. Sideways, the focal length cannot be had,
# and ``status`` says ``DEGENERATE``: the numbers are not to be used, whatever they look like. Carried around, the motion is
# recognised, and the answer is given with the deviation that it has: some times that of the general motion.
#
# How far from critical is far enough? Let the camera turn while it moves sideways, by a random rotation of a given size in
# each view, and ask ``bundle_covariance`` how well the focal length is known.

# %%
turns = torch.logspace(-2.5, -0.3, 6)
wobble = torch.randn(12, 3, generator=torch.Generator().manual_seed(3))
known = []
for turn in turns:
    centres = motions["moving sideways"].centre
    away = look_at(centres, centres - start.centre + turn * wobble * start.centre.norm())
    seen = simulate_images(corner, away, camera, generator=g)
    v, p = torch.ones_like(seen.visible).nonzero().unbind(-1)
    problem = BundleProblem.of(away, camera[None], corner, seen.x_true[v, p], v, p)
    known.append(float(bundle_covariance(problem, free=("focal", "principal_point"), sigma=0.5).cameras[0, 0, 0].sqrt()))
fig, ax = plt.subplots(figsize=(7, 4), layout="constrained")
ax.loglog(turns.rad2deg(), known, "o-")
ax.axhline(FOCAL, color="grey", linestyle=":", label="as large as the focal length")
ax.set(xlabel="turns of the camera, degrees (about)", ylabel="standard deviation of f, pixels", title="Sideways, with turns")
ax.legend()
for turn, deviation in ((turns[0], known[0]), (turns[-1], known[-1])):
    print(f"turns of {turn.rad2deg():4.1f} degrees: f +- {deviation:.1f} px")

# %% [markdown]
# **Exercise 4.** Known principal points: assume only the focal length unknown,
# ``assume=Assumption(free=("focal",))``. Which of the three motions is determined now?
#
# **Exercise 5.** Add one single image to the sideways motion, turned by 90 degrees about the optical axis. What happens to
# the deviation? Photographers who calibrate know this trick.

# %% [markdown]
# What autograd adds
# ------------------
# Autocalibration chooses and refuses; its result has no derivative. But the last step of any calibration is metric bundle
# adjustment with the intrinsics free, and that has one. How does the focal length depend on each image point? The sum of
# squares of that derivative, times the variance of the noise, must be the variance that ``bundle_covariance`` tells.

# %%
v, p = visible.nonzero().unbind(-1)
seen_x = x[v, p].clone().requires_grad_()
problem = BundleProblem.of(around, camera[None], corner, seen_x, v, p)
adjusted = bundle_adjust(problem, free=("focal", "principal_point"), tolerance=1e-12, hessian="gauss-newton")
(influence,) = torch.autograd.grad(adjusted.cameras.K[0, 0, 0], seen_x)
there = BundleProblem.of(adjusted.poses, adjusted.cameras, adjusted.X, x[v, p], v, p)
spread = bundle_covariance(there, free=("focal", "principal_point"), sigma=0.5).cameras[0, 0, 0].sqrt()
focal = adjusted.cameras.K[0, 0, 0]
print(f"f = {focal:.2f} px; its deviation by derivatives {0.5 * influence.norm():.3f}, by covariance {spread:.3f}")

fig, ax = plt.subplots(figsize=(7, 5), layout="constrained")
best = int(torch.stack([influence[v == k].square().sum() for k in range(12)]).argmax())
own = v == best
ax.quiver(*x[v, p][own].T, *influence[own].T, angles="xy", color="tab:red", width=0.004)
ax.plot(*x[v, p][own].T, ".", color="black", markersize=4)
ax.set(xlim=(0, SIZE[0]), ylim=(SIZE[1], 0), aspect="equal", xlabel="x in pixels", ylabel="y in pixels")
ax.set_title("How the focal length rises when a point of this image moves")

# %% [markdown]
# Most arrows point outwards, some inwards. A longer lens enlarges everything alike; a nearer camera enlarges near things
# more than far ones. The focal length lives on the difference, and so on how deep the scene is.
#
# **Exercise 6.** Draw the same for the principal point, ``K[0, 0, 2]``. Can you explain the picture?
