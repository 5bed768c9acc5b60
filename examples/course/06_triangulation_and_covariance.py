"""
6. Triangulation and covariance
===============================

The cameras are known: where is the point? Two rays should meet in it. They never do, because image points are measured with
noise. This notebook finds the point that is most likely, says how sure it is, and shows where that certainty comes from: the
angle between the rays. Then it turns the question round and finds a camera from what was triangulated.

*About 15 minutes. Reading: Hartley & Zisserman, chapter 12.*
"""

# %%
import math

import matplotlib.pyplot as plt
import torch

from torchsfm import Status
from torchsfm.geometry import (
    Camera,
    Pose,
    camera_from_krt,
    epipolar_distance,
    intrinsics,
    project_points,
    rotation_angle,
    to_homogeneous,
)
from torchsfm.plot import plot_cameras, plot_points_3d
from torchsfm.simulation import look_at
from torchsfm.tensors import fundamental_from_cameras
from torchsfm.triangulation import correct_matches, triangulate_points, triangulate_points_dlt, triangulate_points_robust

torch.set_default_dtype(torch.float64)

# %% [markdown]
# Two rays that miss
# ------------------
# Two cameras, two units apart, look at a point ten units away. We measure its images a thousand times, each time with one
# pixel of noise. The two viewing rays are then *skew*.

# %%
FOCAL = 1000.0
K = intrinsics(torch.tensor(FOCAL), torch.tensor([499.5, 374.5]))


def two_cameras(baseline: float) -> Pose:
    """Side by side, both looking at the origin from a distance of ten."""
    x = torch.tensor([-baseline / 2, baseline / 2])
    centre = torch.stack((x, torch.full((2,), -10.0), torch.zeros(2)), -1)
    return look_at(centre, torch.zeros(2, 3))


g = torch.Generator().manual_seed(0)
poses = two_cameras(2.0)
P = camera_from_krt(K, poses.R, poses.t)
X = torch.tensor([0.3, 0.5, 0.2])
exact = project_points(P, X[None])  # (views, 1, 2)
x = exact + torch.randn(2, 1000, 2, generator=g)


def viewing_rays(x: torch.Tensor, poses: Pose) -> torch.Tensor:
    """Directions of the viewing rays in the world, (views, n, 3)."""
    return to_homogeneous(x) @ torch.linalg.inv(K).mT @ poses.R


rays = viewing_rays(x, poses)
across = torch.linalg.cross(rays[0], rays[1])
gap = ((poses.centre[1] - poses.centre[0]) * across).sum(-1).abs() / across.norm(dim=-1)
print(f"the rays miss each other by {1000 * gap.median():.1f} thousandths of a unit (median)")

# %% [markdown]
# Which point is best? Three answers:
#
# - the *midpoint* of the shortest segment between the rays: simple, and without a meaning in the images;
# - the *linear* one: each image point gives two equations :math:`(x\, p_3 - p_1) X = 0`, and the smallest singular vector
#   solves them. It minimises an algebraic error;
# - the *optimal* one: the point whose projections are nearest to what was measured, in the sum of squares over the images.
#   For noise that is alike in all directions it is the most likely point.
#
# In two views the optimal one has a closed form, nearly: move both image points as little as possible so that they satisfy
# the epipolar constraint :math:`x_2^T F x_1 = 0`, then the rays meet. ``correct_matches`` does this.

# %%
F = fundamental_from_cameras(P[0], P[1])
y1, y2 = correct_matches(F, x[0], x[1])
moved = torch.cat((y1 - x[0], y2 - x[1]), -1).norm(dim=-1)
before, after = epipolar_distance(F, x[0], x[1]), epipolar_distance(F, y1, y2)
print(f"distance from epipolar lines: {before.mean():.2f} px before the correction, {after.max():.0e} px after it")
print(f"image points were moved by {moved.mean():.2f} px in all")

# %% [markdown]
# Now all three, for these cameras, and for a pair that is unlike: the second camera ten times nearer than the first.


# %%
def midpoints(x: torch.Tensor, poses: Pose) -> torch.Tensor:
    """The middles of the shortest segments between two rays, (n, 3)."""
    rays = viewing_rays(x, poses)
    between = (poses.centre[1] - poses.centre[0]).expand(len(rays[0]), 3)
    s = torch.linalg.lstsq(torch.stack((rays[0], -rays[1]), -1), between[..., None]).solution
    return (poses.centre[0] + s[:, 0] * rays[0] + poses.centre[1] + s[:, 1] * rays[1]) / 2


unlike = look_at(torch.tensor([[-1.0, -10.0, 0.0], [0.9, -0.2, 0.5]]), X.expand(2, 3))
for title, pair_poses in (("alike", poses), ("unlike", unlike)):
    pair = camera_from_krt(K, pair_poses.R, pair_poses.t)
    seen = project_points(pair, X[None]) + torch.randn(2, 1000, 2, generator=g)
    answers = {
        "midpoint": midpoints(seen, pair_poses),
        "linear": triangulate_points_dlt(seen, pair),
        "optimal": triangulate_points(seen, pair).model,
    }
    for name, model in answers.items():
        reprojected = (project_points(pair, model) - seen).square().sum((0, -1)).mean().sqrt()
        off = (model - X).square().sum(-1).mean().sqrt()
        print(f"cameras {title:6s}, {name:8s}: reprojection error {reprojected:.3f} px, off by {off:.4f}")

# %% [markdown]
# Where the cameras are alike, so are the answers. Where they are not, the midpoint and the linear point treat both rays
# alike, although a pixel of the far camera is ten times longer in space.
#
# **Exercise 1.** Why does the reprojection error of the optimal point have a root mean square near 1, although four
# coordinates were measured with noise of 1? *Hint:* the point has three unknowns, and so one of four degrees of freedom is
# left.

# %% [markdown]
# How sure is the point?
# ----------------------
# Near the optimum, image points change linearly with *X*: let *J* be the derivative of all projections. Then the covariance
# is
#
# .. math:: C = \sigma^2 (J^T J)^{-1}.
#
# ``triangulate_points`` returns it for :math:`\sigma = 1` pixel. Is it true? We draw the thousand answers from above, seen
# from the top, and the ellipse that should hold 95 percent of them. And the same for cameras ten times nearer to each
# other.


# %%
def ellipse(C: torch.Tensor, share: float) -> torch.Tensor:
    """Points of the ellipse that holds a share of a normal distribution in the plane."""
    turn = torch.linspace(0, 2 * math.pi, 100)
    circle = torch.stack((turn.cos(), turn.sin()))
    return (torch.linalg.cholesky(C) @ circle * math.sqrt(-2 * math.log(1 - share))).T


fig, axes = plt.subplots(1, 2, figsize=(11, 5), layout="constrained", sharey=True)
for ax, baseline in zip(axes, (2.0, 0.2), strict=True):
    cameras = two_cameras(baseline)
    pair = camera_from_krt(K, cameras.R, cameras.t)
    trials = triangulate_points(project_points(pair, X[None]) + torch.randn(2, 1000, 2, generator=g), pair)
    once = triangulate_points(project_points(pair, X[None]), pair)  # at the truth
    C = once.covariance[0]
    off = trials.model - X
    chi2 = (off * torch.linalg.solve(C, off.mT).mT).sum(-1)
    inside = (chi2 < 7.815).double().mean()  # 95 % of chi squared with three degrees of freedom
    deviation = C.diagonal().sqrt()
    angle = float(once.parallax[0])
    print(
        f"baseline {baseline:.1f}: rays meet at {math.degrees(angle):4.1f} degrees; deviation across {deviation[0]:.4f}, "
        f"in depth {deviation[1]:.4f}"
    )
    print(f"baseline {baseline:.1f}: the 95 % ellipsoid holds {inside:.1%} of the trials")
    ax.plot(*off[:, :2].T, ".", markersize=3, alpha=0.5, label="1000 trials")
    ax.plot(*ellipse(C[:2, :2], 0.95).T, color="tab:red", label="95 % by the covariance")
    ax.set(
        xlabel="error in x",
        title=f"baseline {baseline}, {math.degrees(angle):.1f} degrees of parallax",
        xlim=(-0.15, 0.15),
        ylim=(-4, 4),
    )
axes[0].set_ylabel("error in y, which is depth")
axes[0].legend()

# %% [markdown]
# The point is known well across the line of sight and badly along it. For two cameras with baseline *b* at distance *Z* the
# geometry gives
#
# .. math:: \sigma_Z \approx \frac{Z^2}{f\, b}\, \sqrt{2}\, \sigma.
#
# Depth becomes uncertain with the *square* of the distance. Below, the formula and the covariance for a row of points
# behind each other, in the middle between the cameras.

# %%
cameras = two_cameras(0.2)
pair = camera_from_krt(K, cameras.R, cameras.t)
row = torch.stack((torch.zeros(25), torch.linspace(-6, 90, 25), torch.zeros(25)), -1)
Z = row[:, 1] + 10
known = triangulate_points(project_points(pair, row), pair).covariance[:, 1, 1].sqrt()
formula = Z.square() / (FOCAL * 0.2) * math.sqrt(2)
fig, ax = plt.subplots(figsize=(7, 4), layout="constrained")
ax.loglog(Z, known, "o", label="covariance of triangulate_points")
ax.loglog(Z, formula, color="tab:red", linewidth=1, label="Z² √2 / (f b)")
ax.loglog(Z, Z, ":", color="grey", label="as uncertain as it is far")
ax.set(xlabel="distance Z", ylabel="standard deviation in depth", title="Depth from two cameras 0.2 apart, one pixel of noise")
ax.legend()
print(f"formula against covariance: at most {((known / formula - 1).abs().max()):.1%} apart")

# %% [markdown]
# Where the deviation is not small against the distance the ellipse is a poor picture: inverse depth is normal then, depth
# is not. Of a point at infinity only a direction is left.
#
# **Exercise 2.** Triangulate the row with noise and plot histograms of *Z* and of *1 / Z* for the farthest point. Which one
# looks normal?
#
# **Exercise 3.** Twenty cameras on an arc of ten degrees, or two cameras ten degrees apart: which knows the depth better,
# and by which factor? *Hint:* stack the poses, everything here takes any number of views.

# %% [markdown]
# What can go wrong
# -----------------
# Data can be bad, and in a batch of a million points some always are. Then the point gets a ``status``, and its neighbours
# do not notice.

# %%
cases = {
    "a good point": exact[:, 0],
    "parallel rays": project_points(P, torch.tensor([[0.0, 1e12, 0.0]]))[:, 0],
    "rays that meet behind": torch.stack((exact[0, 0] - torch.tensor([400.0, 0]), exact[1, 0] + torch.tensor([400.0, 0]))),
    "not a number": torch.stack((exact[0, 0], torch.full((2,), math.nan))),
}
checked = triangulate_points(torch.stack(list(cases.values()), 1), P)
for name, status, angle in zip(cases, checked.status, checked.parallax, strict=True):
    print(f"{name:22s} {Status(int(status)).name:11s} parallax {math.degrees(float(angle)):.2f} degrees")

# %% [markdown]
# In many views some observations may be wrong. ``triangulate_points_robust`` tries pairs of views and keeps the point that
# most views agree with, for all points at once.

# %%
arc = torch.linspace(-0.5, 0.5, 8)
ring = look_at(10 * torch.stack((arc.sin(), -arc.cos(), 0.1 * torch.cos(9 * arc)), -1), torch.zeros(8, 3))
views = camera_from_krt(K, ring.R, ring.t)
cloud = 2 * torch.rand(200, 3, generator=g) - 1
measured = project_points(views, cloud) + torch.randn(8, 200, 2, generator=g)
wrong = torch.rand(8, 200, generator=g) < 0.2
measured = torch.where(wrong[..., None], 1000 * torch.rand(8, 200, 2, generator=g), measured)
plain, robust = triangulate_points(measured, views), triangulate_points_robust(measured, views, threshold=4.0, generator=g)
for name, result in (("all views", plain), ("those that agree", robust)):
    print(f"{name:16s}: median point off by {(result.model - cloud).norm(dim=-1).median():.4f}")

fig = plt.figure(figsize=(6.5, 5.5), layout="constrained")
ax = plot_points_3d(robust.model[robust.status == Status.OK], ax=fig.add_subplot(projection="3d"), s=6, color="tab:blue")
plot_cameras(ring, Camera(K), size=1.5, ax=ax)
ax.set_title("200 points from eight views, a fifth of the observations wrong")

# %% [markdown]
# What autograd adds: one more way to the covariance
# --------------------------------------------------
# The triangulated point is a function of the image points, and its derivative :math:`\partial X / \partial x` is that of
# the optimum. Then the covariance is :math:`\sigma^2\, (\partial X / \partial x) (\partial X / \partial x)^T`. It must be
# the same. But now the cameras may be uncertain too: differentiate by them, and add.


# %%
def located(x: torch.Tensor, motion: torch.Tensor) -> torch.Tensor:
    """The point, from its two images and a small motion of the second camera."""
    second = poses[1].retract(motion)
    cameras = torch.stack((P[0], camera_from_krt(K, second.R, second.t)))
    return triangulate_points(x[:, None], cameras).model[0]


by_x, by_motion = torch.autograd.functional.jacobian(located, (exact[:, 0], torch.zeros(6)))
by_x = by_x.flatten(1)
from_noise = by_x @ by_x.T
print(f"two ways to the covariance: {(from_noise / triangulate_points(exact, P).covariance[0] - 1).abs().max():.0e} apart")

turned = math.radians(0.1)  # the second camera's rotation is known to a tenth of a degree only
from_turn = turned**2 * by_motion[:, :3] @ by_motion[:, :3].T
for name, C in (("image noise", from_noise), ("uncertain rotation", from_turn), ("together", from_noise + from_turn)):
    print(f"{name:18s}: deviation in depth {C[1, 1].sqrt():.4f}")

# %% [markdown]
# A tenth of a degree costs more than a pixel of noise: a rig must be calibrated better than its image points are measured.
#
# Turned round: calibrate with a stick
# ------------------------------------
# So let us do that. A stick of length one is waved in front of the two cameras, thirty times. Both ends are seen in both
# images. The second camera was knocked: its pose is some degrees and tenths of a unit off. We triangulate both ends with
# the pose we believe in, and ask that the stick be as long as it is and that the rays meet. Derivatives flow through the
# triangulation to the pose; nobody derives a formula.

# %%
middle = 1.5 * torch.rand(30, 3, generator=g) - 0.75
along = torch.nn.functional.normalize(torch.randn(30, 3, generator=g), dim=-1)
ends = torch.cat((middle - along / 2, middle + along / 2))
waved = project_points(P, ends) + 0.3 * torch.randn(2, 60, 2, generator=g)
knocked = poses[1].retract(torch.tensor([0.03, -0.04, 0.05, 0.3, -0.2, 0.2]))


def residuals(motion: torch.Tensor) -> torch.Tensor:
    """Errors of lengths and of reprojections, each over the noise that it has, after a motion of the second camera."""
    second = now.retract(motion)
    cameras = torch.stack((P[0], camera_from_krt(K, second.R, second.t)))
    model = triangulate_points(waved, cameras).model
    length = (model[30:] - model[:30]).norm(dim=-1)
    return torch.cat(((length - 1) / 0.02, (project_points(cameras, model) - waved).flatten() / 0.3))


now = knocked
history = []
for _ in range(7):
    history.append([float(rotation_angle(now.R @ poses[1].R.mT).rad2deg()), float((now.centre - poses[1].centre).norm())])
    J, r = torch.func.jacfwd(residuals)(torch.zeros(6)), residuals(torch.zeros(6))
    now = now.retract(torch.linalg.lstsq(J, -r[:, None]).solution[:, 0])
fig, ax = plt.subplots(figsize=(7, 4), layout="constrained")
ax.semilogy(torch.tensor(history)[:, 0], "o-", label="rotation, degrees")
ax.semilogy(torch.tensor(history)[:, 1], "s-", label="centre, units")
ax.set(xlabel="step", ylabel="error of the second camera", title="A stick calibrates a pair of cameras")
ax.legend()
for name, (degrees, units) in (("at first", history[0]), ("in the end", history[-1])):
    print(f"{name:10s}: second camera off by {degrees:.3f} degrees and {units:.4f} units")

# %% [markdown]
# **Exercise 4.** Make the focal length of the second camera unknown as well. *Hint:* ``intrinsics(FOCAL * torch.exp(a),
# ...)`` with a new parameter *a*.
#
# **Exercise 5.** What if the length of the stick is not known, but constant? Replace ``length - 1`` by ``length -
# length.mean()``. What does the answer lose? *Hint:* the word is scale. What must be held then?
