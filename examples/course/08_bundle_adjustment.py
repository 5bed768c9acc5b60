"""
8. Bundle adjustment
====================

All cameras and all points at once: which of them explain the images best? Photogrammetry has asked this since the 1950s and
calls it *bundle adjustment*, for the bundles of rays. It is one large least squares problem with a special form. This notebook
looks at the form (the Schur complement), at what images cannot tell (the gauge), at wrong matches (robust losses), and at how
the answer depends on each single measurement, which is where derivatives come in.

*About 20 minutes. Reading: Hartley & Zisserman, chapter 18 and appendix 6; Triggs and others, "Bundle adjustment, a modern
synthesis" (2000).*
"""

# %%
import math
from dataclasses import replace

import matplotlib.pyplot as plt
import torch

from torchsfm.bundle import bundle_adjust, bundle_covariance
from torchsfm.geometry import BundleProblem, Camera, intrinsics, similarity_from_points
from torchsfm.optim import Cauchy, Huber, Loss, Tukey, loss_slope
from torchsfm.plot import plot_cameras, plot_points_3d
from torchsfm.simulation import orbit_poses, random_points, simulate_images

torch.set_default_dtype(torch.float64)

# %% [markdown]
# A small problem
# ---------------
# Eight cameras with known intrinsics look at sixty points. Each observation is disturbed by half a pixel, and a quarter of
# them is missing. The start is wrong by some degrees and by tenths of a unit. A ``BundleProblem`` is a list of
# observations: the image point ``x``, which ``view`` saw it, which ``point`` it is.

# %%
NOISE = 0.5
g = torch.Generator().manual_seed(3)
camera = Camera(intrinsics(torch.tensor(800.0), torch.tensor([499.5, 374.5])))
poses = orbit_poses(8, radius=5.0, height=(0.5, 2.0), sweep=math.pi / 2)
X = random_points(60, generator=g)
seen = simulate_images(X, poses, camera, image_size=(1000, 750), noise=NOISE, dropout=0.25, generator=g)
view, point = seen.visible.nonzero().unbind(-1)
truth = BundleProblem.of(poses, camera[None], X, seen.x[view, point], view, point)

guess = replace(
    truth,
    poses=poses.retract(torch.tensor([0.03] * 3 + [0.1] * 3) * torch.randn(8, 6, generator=g)),
    X=X + 0.1 * torch.randn(60, 3, generator=g),
)


def rms(problem: BundleProblem) -> float:
    """Root mean square of the residuals of each coordinate, in pixels."""
    return float((problem.residuals().square().mean() / 2).sqrt())


print(f"{len(view)} observations of {len(X)} points in {len(poses.t)} views")
print(f"reprojection error: {rms(guess):.1f} px at the start, {rms(truth):.2f} px at the truth")

# %% [markdown]
# Seen as a matrix
# ----------------
# The unknowns are six numbers for each pose and three for each point. Let *r* be the vector of all residuals and *J* its
# derivative. A Gauss-Newton step solves the *normal equations*
#
# .. math:: J^T J\, \delta = - J^T r.
#
# An observation knows one pose and one point, so each row of *J* has at most nine entries that are not zero. (Eight here: a
# step of a camera to the right moves no image point up or down.) ``torch.func.jacfwd`` makes the whole of *J* from the
# formula of the projection. (The library never stores the zeros.)

# %%
POSES, POINTS = 6 * len(poses.t), 3 * len(X)


def residuals(step: torch.Tensor, problem: BundleProblem) -> torch.Tensor:
    """All residuals after a step of all poses and points."""
    moved = replace(
        problem,
        poses=problem.poses.retract(step[:POSES].reshape(-1, 6)),
        X=problem.X + step[POSES:].reshape(-1, 3),
    )
    return (moved.projections() - problem.x).flatten()


zero = torch.zeros(POSES + POINTS)
J = torch.func.jacfwd(residuals)(zero, guess)
r = residuals(zero, guess)
N = J.T @ J
fig, axes = plt.subplots(1, 2, figsize=(10.5, 5), layout="constrained")
axes[0].spy(J, markersize=0.6, aspect="auto")
axes[0].set(
    title=f"J: {J.shape[0]} residuals, {J.shape[1]} unknowns", xlabel="poses | points", ylabel="observation by observation"
)
axes[1].spy(N, markersize=0.6)
axes[1].set(title="J'J: an arrow", xlabel="poses | points")
for ax in axes:
    ax.axvline(POSES - 0.5, color="tab:red", linewidth=1)
    ax.tick_params(bottom=False)
axes[1].axhline(POSES - 0.5, color="tab:red", linewidth=1)
print(f"entries that are not zero: {(J != 0).double().mean():.1%} of J, {(N != 0).double().mean():.1%} of J'J")

# %% [markdown]
# The Schur complement
# --------------------
# Points do not meet points: the lower right block *C* of
#
# .. math:: J^T J = \begin{pmatrix} A & B \\ B^T & C \end{pmatrix}
#
# is a row of 3x3 blocks on the diagonal, and inverting it costs next to nothing. *Eliminate* the points:
#
# .. math:: (A - B C^{-1} B^T)\, \delta_{poses} = b_{poses} - B C^{-1} b_{points}, \qquad
#           \delta_{points} = C^{-1} (b_{points} - B^T \delta_{poses}).
#
# The matrix on the left is the *Schur complement*. It has the size of the poses alone. In statistics it is the information
# about the poses when the points are unknown too: :math:`A` is what it would be if the points were known.
#
# A little damping :math:`\mu` on the diagonal makes the step safe (Levenberg-Marquardt) and *J'J* invertible; why it is not
# by itself comes next.

# %%
damped = N + 1e-6 * N.diagonal().mean() * torch.eye(len(N))
b = -J.T @ r
A, B, C = damped[:POSES, :POSES], damped[:POSES, POSES:], damped[POSES:, POSES:]
blocks = torch.stack([C[i : i + 3, i : i + 3] for i in range(0, POINTS, 3)])  # (points, 3, 3)


def by_C(right: torch.Tensor) -> torch.Tensor:
    """C^-1 times columns, block by block."""
    return torch.linalg.solve(blocks, right.reshape(len(X), 3, -1)).reshape(POINTS, -1)


S = A - B @ by_C(B.T)
step_poses = torch.linalg.solve(S, b[:POSES, None] - B @ by_C(b[POSES:]))
step = torch.cat((step_poses, by_C(b[POSES:, None] - B.T @ step_poses)))[:, 0]
direct = torch.linalg.solve(damped, b)
print(f"a system of {len(S)} unknowns instead of {len(N)}; the steps differ by {(step - direct).norm() / direct.norm():.0e}")
print(f"one step: sum of squares {r.square().sum():.0f} -> {residuals(step, guess).square().sum():.0f}")

# %% [markdown]
# A dense solve costs the cube of the number of unknowns. With a thousand cameras and a million points the whole matrix
# could not even be stored; its Schur complement can.
#
# **Exercise 1.** Look at *S* with ``plt.spy``. When is the block of two poses zero? *Hint:* no point was seen by both. What
# does that say of a long street, where each camera sees only its neighbours?
#
# **Exercise 2.** Make a loop of the step above, with :math:`\mu` ten times smaller after a step that helps and ten times
# larger after one that does not. How many steps do you need?

# %% [markdown]
# The library does it
# -------------------
# ``free`` names what is unknown inside the cameras: here nothing. At the minimum the residuals are *smaller* than at the
# truth. The fit follows the noise: with *m* residuals and *p* unknowns that the data determine, the expected mean square is
# :math:`\sigma^2 (m - p) / m`.

# %%
found = bundle_adjust(guess, free=())
best = replace(guess, poses=found.poses, X=found.X)
m, p = 2 * len(view), POSES + POINTS - 7
print(
    f"{found.status.name} after {found.iterations} steps: {rms(best):.4f} px, expected {NOISE * math.sqrt((m - p) / m):.4f} px"
)


def off(problem: BundleProblem) -> float:
    """How far the points are off, after the similarity that fits best; root mean square in the unit of the scene."""
    return float((similarity_from_points(problem.X, X).transform(problem.X) - X).square().sum(-1).mean().sqrt())


print(f"points: {off(guess):.4f} off at the start, {off(best):.4f} after adjustment")

# %% [markdown]
# The gauge
# ---------
# Why :math:`p` is less by 7? Move, turn or scale the whole world, cameras and points together, and no image changes. These
# seven directions are the *gauge freedom*. They show as seven eigenvalues of *J'J* that are zero.

# %%
J = torch.func.jacfwd(residuals)(zero, best)
values = torch.linalg.eigvalsh(J.T @ J)
# The directions can be written down. Scale: every t and every X grow alike. A shift of the world moves X, and t by -R times it.
scale = torch.cat((torch.cat((torch.zeros(8, 3), best.poses.t), -1).flatten(), best.X.flatten()))
shift = torch.cat((torch.cat((torch.zeros(8, 3), -best.poses.R[..., 0]), -1).flatten(), torch.eye(3)[0].repeat(60)))
for name, direction in (("scale", scale), ("shift along x", shift)):
    print(f"{name}: |J v| / |v| = {(J @ direction).norm() / direction.norm():.0e} px")

fig, ax = plt.subplots(figsize=(7.5, 4), layout="constrained")
ax.semilogy(range(1, 8), values[:7].abs().clamp_min(1e-12), "o", color="tab:red", label="gauge: zero but for rounding")
ax.semilogy(range(8, len(values) + 1), values[7:], ".", color="tab:blue", label="determined by the images")
ax.set(xlabel="number of the eigenvalue, from the smallest", ylabel="eigenvalue of J'J", title="What images do not tell")
ax.legend()
print(f"seventh eigenvalue {values[6].abs():.0e}, eighth {values[7]:.1f}")

# %% [markdown]
# *Choosing a gauge* is choosing coordinates: it changes numbers, not the reconstruction. But it changes what "uncertain"
# means. Left free, the covariance is given in the frame in which the cameras as a whole move least (a pseudo-inverse of
# *J'J*). Hold the first pose, and everything is uncertain relative to that camera; only the scale is left. Hold the first
# *and* the last, and twelve numbers are held where seven are free: five of them are claims, and everything looks more
# certain than it is.

# %%
first, last = torch.arange(8) == 0, torch.arange(8) == 7
spread = {
    "free": bundle_covariance(best, free=(), sigma=NOISE),
    "first held": bundle_covariance(best, free=(), sigma=NOISE, fixed_poses=first),
    "first and last held": bundle_covariance(best, free=(), sigma=NOISE, fixed_poses=first | last),
}
fig, ax = plt.subplots(figsize=(7.5, 4), layout="constrained")
for (name, covariance), marker in zip(spread.items(), "os^", strict=True):
    # The last three numbers of a pose's step are the change of t, in the camera's frame.
    deviation = covariance.poses[:, 3:, 3:].diagonal(dim1=-2, dim2=-1).sum(-1).sqrt()
    ax.plot(range(1, 9), 1000 * deviation, marker + "-", label=name)
    known = covariance.X.diagonal(dim1=-2, dim2=-1).sum(-1).sqrt().mean()
    print(f"{name:19s}: {covariance.nullity} directions free, points known to {1000 * known:.1f} thousandths of a unit")
ax.set(
    xlabel="camera",
    ylabel="standard deviation of t, thousandths",
    title="The same data: what is held looks certain",
    ylim=(0, None),
)
ax.legend()

# %% [markdown]
# **Exercise 3.** Which direction is left when the first pose is held? *Hint:* use the vector ``scale`` above, changed so
# that the first camera's centre stays. Check it with *J*.
#
# **Exercise 4.** Let the focal length be free, ``free=("focal",)``. How much do the points' standard deviations grow?

# %% [markdown]
# Robust losses
# -------------
# One wrong match in twenty, and least squares is lost, because it pays for the square. A *robust loss* :math:`\rho(s)` of
# the squared residual *s* pays less for large ones. What counts is its slope :math:`\rho'(s)`: the weight of the
# observation at the next step. Huber's pull stays constant, Cauchy's fades, Tukey's ends.

# %%
losses: dict[str, Loss | None] = {"squares": None, "Huber": Huber(1.0), "Cauchy": Cauchy(1.0), "Tukey": Tukey(4.0)}
distance = torch.linspace(0, 6, 200)
fig, axes = plt.subplots(1, 2, figsize=(10.5, 3.8), layout="constrained")
for name, loss in losses.items():
    s = distance.square()
    axes[0].plot(distance, s if loss is None else loss(s), label=name)
    axes[1].plot(distance, torch.ones_like(s) if loss is None else loss_slope(loss, s), label=name)
axes[0].set(xlabel="residual in pixels", ylabel="loss", ylim=(0, 12), title="what is paid")
axes[1].set(xlabel="residual in pixels", ylabel="weight", title="what it counts")
axes[0].legend()

wrong = torch.rand(len(view), generator=g) < 0.05
anywhere = torch.rand(len(view), 2, generator=g) * torch.tensor([1000.0, 750.0])
spoiled = replace(guess, x=torch.where(wrong[:, None], anywhere, guess.x))
for name, loss in losses.items():
    result = bundle_adjust(spoiled, free=(), loss=loss)
    print(f"{name:8s}: points {1000 * off(replace(guess, X=result.X)):6.1f} thousandths off after {result.iterations} steps")
print(f"without wrong matches: {1000 * off(best):.1f} thousandths")

# %% [markdown]
# Tukey's loss did not move at all: at the start every residual is beyond its end, all weights are zero, and there is
# nothing to do. What looks wrong at the start is ignored for good. Cauchy's loss always listens a little, and here it is
# nearly as good as if nothing had been wrong.
#
# **Exercise 5.** Start ``bundle_adjust`` with Tukey's loss from the result of Cauchy's. Is it better still? Then raise the
# share of wrong matches. Where does it break?

# %% [markdown]
# What autograd adds: the derivative of the optimum
# -------------------------------------------------
# The adjusted points are a function of the observations. As in notebook 7 the implicit function theorem gives its
# derivative, now for hundreds of unknowns, and the Schur complement serves once more. So write down *any* quantity that
# interests you, computed from the result, and call ``backward``.
#
# Take the angle at one point between two others. It does not depend on the gauge. Its derivative by each observation says
# which measurements it rests on.


# %%
def angle(X: torch.Tensor) -> torch.Tensor:
    """The angle at point 0 between points 1 and 2, in degrees."""
    a, b = X[1] - X[0], X[2] - X[0]
    return torch.atan2(torch.linalg.cross(a, b).norm(), a @ b).rad2deg()


x = guess.x.clone().requires_grad_()
adjusted = bundle_adjust(replace(best, x=x), free=(), tolerance=1e-12)
value = angle(adjusted.X)
(influence,) = torch.autograd.grad(value, x)
print(f"angle: {value:.3f} degrees, in truth {angle(X):.3f}")

# The most influential measurement, moved by a tenth of a pixel, and everything adjusted anew.
most = int(influence.norm(dim=-1).argmax())
moved = guess.x.clone()
moved[most, 0] += 0.1
again = angle(bundle_adjust(replace(best, x=moved), free=(), tolerance=1e-12).X)
print(f"x + 0.1 px: angle changes by {again - value:.6f} degrees, predicted {0.1 * influence[most, 0]:.6f}")

# %% [markdown]
# If each coordinate is off by noise of standard deviation :math:`\sigma`, to first order the angle is off by
# :math:`\sigma |\nabla|`. This is error propagation without a formula for the angle's variance. We try it: fifty new sets of
# measurements, fifty adjustments. (Fifty trials tell a standard deviation to about a tenth of it, so do not expect more.)

# %%
predicted = NOISE * influence.norm()
exact = truth.projections()
angles = []
for _ in range(50):
    fresh = exact + NOISE * torch.randn(exact.shape, generator=g)
    angles.append(angle(bundle_adjust(replace(truth, x=fresh), free=()).X))
print(f"standard deviation of the angle: predicted {predicted:.4f} degrees, observed {torch.stack(angles).std():.4f}")

own = point <= 2
share = influence[own].square().sum() / influence.square().sum()
print(f"{share:.0%} of the variance comes from the {int(own.sum())} observations of the three points themselves")
by_view = torch.stack([influence[view == i].square().sum() for i in range(8)]) / influence.square().sum()

fig = plt.figure(figsize=(11, 4.8), layout="constrained")
space, bars = fig.add_subplot(1, 2, 1, projection="3d"), fig.add_subplot(1, 2, 2)
plot_points_3d(best.X[3:], color="grey", ax=space)
plot_points_3d(best.X[:3], color="tab:red", s=40, ax=space)
space.plot(*best.X[[1, 0, 2]].T, color="tab:red")
plot_cameras(best.poses, camera, names=[str(i) for i in range(1, 9)], size=0.6, color="tab:blue", ax=space)
space.set_title("the angle, the cameras")
bars.bar(range(1, 9), by_view)
bars.set(xlabel="camera", ylabel="share of the angle's variance", title="On whose measurements it rests")

# %% [markdown]
# **Exercise 6.** *Plan the next photograph.* Write a function that adds a ninth camera at an angle :math:`\alpha` of the
# arc, and returns the variance of the angle from ``bundle_covariance``. Where should the camera stand?
#
# **Exercise 7.** Which observation is most dangerous if it is *wrong*? Compare ``influence.norm(dim=-1)`` with the weights
# that Cauchy's loss gives: a measurement on which much rests has a small residual even if it is wrong. Why?
