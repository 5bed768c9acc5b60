"""
3. Epipolar geometry: F and E, drawn
====================================

Two photographs of one scene. A point in the first may be anywhere along a ray of space; in the second that ray is a line. This
one fact is the fundamental matrix *F*, and with known cameras the essential matrix *E*. We draw the lines, the epipoles and the
plane behind them, find F and E from matched photographs, and read the motion of the camera out of E. At the end, derivatives
tell how far an epipolar line can be trusted.

*About 20 minutes. Reading: Hartley & Zisserman, chapters 9 and 11.*
"""

# %%
import math

import matplotlib.pyplot as plt
import torch
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

from torchsfm.geometry import Camera, Pose, intrinsics, rotation_angle, sampson_distance, to_homogeneous
from torchsfm.images import detect_features, match_features
from torchsfm.motion import estimate_essential, estimate_fundamental, fundamental_8pt
from torchsfm.plot import plot_cameras, plot_epipolar_lines, plot_matches, plot_points_3d, show_image
from torchsfm.simulation import look_at, render_sequence
from torchsfm.tensors import (
    epipolar_lines,
    epipoles,
    essential_from_fundamental,
    fundamental_from_pose,
    pose_from_essential,
    poses_from_essential,
)
from torchsfm.triangulation import triangulate_points_dlt

torch.set_default_dtype(torch.float64)

# %% [markdown]
# A point becomes a line
# ----------------------
# Two cameras look at a courtyard. Take one pixel of the first photograph. Its point of space is somewhere on a ray; let us
# put it at depths from three to twenty metres, and look where the second camera would see it.

# %%
width, height = 480, 360
K = intrinsics(torch.tensor(440.0), torch.tensor([(width - 1) / 2, (height - 1) / 2]))
camera = Camera(K)
centres = torch.tensor([[3.0, -4.4, 1.6], [4.6, -2.9, 2.0]])
poses = look_at(centres, torch.tensor([0.0, 0.2, 0.8]))
seen = render_sequence(
    poses=poses, camera=camera, width=width, height=height, points=400, generator=torch.Generator().manual_seed(0)
)

pixel = torch.tensor([[232.0, 215.0]])  # on the ball
ray, _ = camera.unproject(pixel)
depths = torch.tensor([3.0, 4.0, 5.0, 6.0, 8.0, 12.0, 20.0])
candidates = poses[0].inverse().transform(ray * depths[:, None])
landed = camera.project(poses[1].transform(candidates))

fig, (left, right) = plt.subplots(1, 2, figsize=(11, 4.8), layout="constrained")
show_image(seen.images[0], title="one pixel of the first photograph ...", ax=left)
left.plot(*pixel.T, "o", color="cyan", markeredgecolor="black", markersize=9)
show_image(seen.images[1], title="... at different depths, in the second", ax=right)
right.plot(*landed.T, "o-", color="cyan", markeredgecolor="black")
for k, (depth, at) in enumerate(zip(depths, landed, strict=True)):  # in turn above and below the line
    shift = (-8, 8) if k % 2 else (-8, -17)
    right.annotate(f"{depth:.0f} m", at.tolist(), shift, textcoords="offset points", color="white")
right.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5))

# %% [markdown]
# They are on a line, the *epipolar line* of the pixel. The renderer knows the true depth:

# %%
depth = seen.depth[0, 215, 232]
apex = poses[0].inverse().transform(ray * depth)[0]
match_of_pixel = camera.project(poses[1].transform(apex[None]))[0]
print(f"depth {depth:.2f} m, seen by the second camera at {match_of_pixel.numpy().round(1)}: on the line, and on the ball")

# %% [markdown]
# The matrix behind it
# --------------------
# With the depths :math:`\lambda_1, \lambda_2` of a point in both cameras, and the second camera relative to the first,
# :math:`\lambda_2 d_2 = \lambda_1 R d_1 + t`. So the three vectors :math:`d_2`, :math:`R d_1` and :math:`t` are in one
# plane, their triple product is zero, and the unknown depths are gone:
#
# .. math:: d_2^T [t]_\times R \, d_1 = 0, \qquad E = [t]_\times R.
#
# With :math:`d = K^{-1} x` the same holds for pixels, :math:`x_2^T F x_1 = 0` with :math:`F = K_2^{-T} E K_1^{-1}`. The
# line is :math:`l_2 = F x_1`.

# %%
second_from_first = poses[1] @ poses[0].inverse()
F = fundamental_from_pose(second_from_first.R, second_from_first.t, K, K)
line = epipolar_lines(F, pixel)[0]  # a x + b y + c = 0 with a^2 + b^2 = 1, so that it measures distances
print(f"distance of the seven points from the line F x1: {(to_homogeneous(landed) @ line).abs().max():.0e} pixels")
F = F / F.norm()
print(f"determinant of F: {F.det():.0e}; singular values: {torch.linalg.svdvals(F).numpy().round(6)}")

# %% [markdown]
# *F* has nine entries. Its scale is free and its determinant is zero: seven degrees of freedom. (Its second singular value
# is small only because a pixel is a small unit.) It is singular because all epipolar lines of an image meet in one point,
# the *epipole*: the image of the other camera's centre. The next figure shows the plane in which it all happens. It
# contains both centres and the point, and cuts each image in an epipolar line. Other points have other planes, but all
# planes contain the *baseline* between the centres.

# %%
fig = plt.figure(figsize=(8, 6.5), layout="constrained")
ax = fig.add_subplot(projection="3d")
plot_points_3d(seen.X, color=seen.color.double(), s=3, ax=ax)
plot_cameras(poses, camera, size=0.9, ax=ax)
ax.add_collection3d(Poly3DCollection([torch.stack((*centres, apex)).numpy()], color="cyan", alpha=0.25))
for a, b, color in ((centres[0], apex, "tab:blue"), (centres[1], apex, "tab:blue"), (*centres, "tab:green")):
    ax.plot(*torch.stack((a, b)).T, color=color, linewidth=2)
ax.scatter(*apex[:, None], color="black", s=25)
for name, centre in zip(("first", "second"), centres, strict=True):
    ax.text(*(centre - torch.tensor([0.0, 0.2, 0.9])), name, color="tab:red", ha="center")
ax.view_init(elev=30, azim=-25)
ax.set_title("The epipolar plane (cyan), both rays (blue), the baseline (green)")

# %% [markdown]
# A dozen points and their lines
# ------------------------------
# Every point lies on the line of its partner, colour by colour. The lines run together towards the epipole, outside of the
# image here, because the camera moved sideways. A camera that walks forward has its epipole *in* the image: the point it
# walks towards. That is the second pair.

# %%
both = seen.visible.all(0).nonzero()[:, 0]
chosen = both[:: len(both) // 12][:12]
plot_epipolar_lines(F, *seen.x[:, chosen], *seen.images)[0].set_title("sideways: epipoles outside")

forward = look_at(torch.tensor([[4.6, -4.6, 1.4], [3.3, -3.3, 1.2]]), torch.tensor([0.0, 0.0, 0.9]))
walk = render_sequence(
    poses=forward, camera=camera, width=width, height=height, points=300, generator=torch.Generator().manual_seed(0)
)
step = forward[1] @ forward[0].inverse()
F_walk = fundamental_from_pose(step.R, step.t, K, K)
chosen = walk.visible.all(0).nonzero()[:, 0][::12][:12]
plot_epipolar_lines(F_walk, *walk.x[:, chosen], *walk.images)[0].set_title("forward: epipoles inside")

for name, matrix, cameras in (("sideways", F, poses), ("forward", F_walk, forward)):
    e1, _ = epipoles(matrix)
    other = camera.project(cameras[0].transform(cameras[1].centre[None]))[0]
    print(f"{name}: epipole {(e1[:2] / e1[2]).numpy().round(1)}, image of the other centre {other.numpy().round(1)}")

# %% [markdown]
# **Exercise 1.** Where do the lines of the *first* image come from? *Hint:* :math:`l_1 = F^T x_2`.
#
# **Exercise 2.** What is *F* when the camera only turns? Estimate it from such a pair and look at ``found.degeneracy``.
# *Hint:* with :math:`t = 0` there is nothing left of E; notebook 2 says what relates such images instead.
#
# From photographs
# ----------------
# Now forget the true cameras. Features are detected and matched; some matches are wrong. ``estimate_fundamental`` finds the
# *F* that most of them agree with, by RANSAC, which is the subject of notebook 5. A match agrees if it is nearer than the
# threshold to the epipolar geometry, in pixels (Sampson's distance: how far both points together must move to fit).

# %%
features = [detect_features(image, 2000) for image in seen.images]
(match,) = match_features(features, torch.tensor([[0, 1]]), ratio=0.9)
x1, x2 = features[0].x[match[:, 0]].double(), features[1].x[match[:, 1]].double()
found = estimate_fundamental(x1, x2, threshold=1.5, generator=torch.Generator().manual_seed(0))
good = found.inliers
exact = sampson_distance(found.model, *seen.x[:, both])
print(f"{len(x1)} matches, of which {int(good.sum())} agree")
print(f"distance of exact points from the estimated F: median {exact.median():.3f} px")
plot_matches(*seen.images, x1, x2, inliers=good, every=3).set_title("green matches agree with one F, red ones do not")
some = good.nonzero()[:, 0][:: int(good.sum()) // 12][:12]
plot_epipolar_lines(found.model, x1[some], x2[some], *seen.images)[0].set_title("the estimated epipolar lines")

# %% [markdown]
# Red matches join bricks and tiles that look alike. No descriptor can tell; the geometry can.
#
# Essential: the motion of the camera
# -----------------------------------
# With known *K*, pixels become rays, and *F* becomes *E*. An essential matrix has two equal singular values and a third of
# zero: five degrees of freedom, three of the rotation and two of the direction of *t*. How far the camera moved is not in
# the images: a courtyard twice as large, seen by a camera that moves twice as far, gives the same photographs.

# %%
E_from_F = essential_from_fundamental(found.model, K, K)
d1, d2 = (camera.unproject(x)[0] for x in (x1, x2))
essential = estimate_essential(d1, d2, threshold=1.5 / 440, generator=torch.Generator().manual_seed(0))
for name, E in (("K' F K", E_from_F), ("estimated as E", essential.model)):
    singular = torch.linalg.svdvals(E)
    motion = pose_from_essential(E, d1, d2, good).pose
    turn = math.degrees(rotation_angle(motion.R @ second_from_first.R.mT))
    cosine = torch.dot(motion.t, second_from_first.t) / second_from_first.t.norm() / motion.t.norm()
    direction = math.degrees(math.acos(cosine.clamp(-1, 1)))
    print(f"{name:15s} singular values {(singular / singular[0]).numpy().round(4)}")
    print(f"{name:15s} rotation off by {turn:.2f} degrees, direction of t by {direction:.2f} degrees")

# %% [markdown]
# :math:`K^T F K` is nearly an essential matrix, its singular values tell how nearly. The direct estimate is one exactly:
# five numbers from the same matches instead of seven.
#
# Four motions, one of them possible
# ----------------------------------
# An essential matrix comes from four motions: *t* may point either way, and the second camera may be turned by half a turn
# about the baseline. Algebra cannot choose. But a camera only sees what is in front of it. Triangulate the matches with
# each of the four.

# %%
first = Pose.identity()
some = good.nonzero()[:, 0][::4]
fig, axes = plt.subplots(1, 4, figsize=(12, 5.2), layout="constrained", sharex=True, sharey=True)
for ax, Rt in zip(axes, poses_from_essential(essential.model).model, strict=True):
    second = Pose.from_matrix(Rt)
    P = torch.stack((first.matrix(), Rt))
    X = triangulate_points_dlt(torch.stack((d1[some, :2] / d1[some, 2:], d2[some, :2] / d2[some, 2:])), P)
    front = (X[:, 2] > 0) & (second.transform(X)[:, 2] > 0)
    ax.scatter(X[:, 0], X[:, 2], s=4, c=["tab:green" if ok else "tab:red" for ok in front])
    for pose, color in ((first, "black"), (second, "tab:blue")):
        corners = pose.inverse().transform(torch.tensor([[-0.5, 0.0, 1.0], [0.0, 0.0, 0.0], [0.5, 0.0, 1.0]]))
        ax.plot(corners[:, 0], corners[:, 2], color=color, linewidth=2)
    ax.set(
        title=f"{int(front.sum())} of {len(some)} points\nin front of both",
        xlabel="x",
        aspect="equal",
        xlim=(-5, 5),
        ylim=(-6, 6),
    )
axes[0].set_ylabel("z (depth in the first camera)")
fig.suptitle("The four motions from above: first camera black, second one blue, length of the baseline 1")

# %% [markdown]
# ``pose_from_essential`` counts in the same way, and gives the winner.
#
# **Exercise 3.** Check the ten cubic constraints: :math:`2 E E^T E - \mathrm{tr}(E E^T) E = 0` and :math:`\det E = 0`. By
# how much do :math:`K^T F K` and the estimated *E* violate them?
#
# What autograd adds: how sure is a line?
# ---------------------------------------
# A match is searched for along the epipolar line, in a band: how wide must it be? *F* comes from noisy points, so the line
# is uncertain, and not by the same amount everywhere. To first order, noise of standard deviation :math:`\sigma` in the
# points gives the line the covariance :math:`\sigma^2 J J^T`, where *J* is the derivative of the line by all coordinates
# that *F* was computed from. Here *F* comes from twenty matches by the eight-point algorithm: normalisation, a singular
# value decomposition, rank two. Nobody wants to write *J* by hand. ``torch.func.jacrev`` goes through all of it.

# %%
sigma, count = 0.5, 20
fit = both[torch.randperm(len(both), generator=torch.Generator().manual_seed(3))[:count]]
y1, y2 = seen.x[:, fit]


def line_of_the_pixel(y1: torch.Tensor, y2: torch.Tensor) -> torch.Tensor:
    """The epipolar line of the pixel by the F of these matches."""
    return epipolar_lines(fundamental_8pt(y1, y2), pixel)[..., 0, :]


J = torch.cat([j.flatten(1) for j in torch.func.jacrev(line_of_the_pixel, argnums=(0, 1))(y1, y2)], 1)
covariance = sigma**2 * J @ J.mT
line = line_of_the_pixel(y1, y2)
at_x = torch.linspace(0, width - 1, 97)
on_line = torch.stack((at_x, -(line[0] * at_x + line[2]) / line[1], torch.ones_like(at_x)), -1)
predicted = ((on_line @ covariance) * on_line).sum(-1).sqrt()  # of the distance of each place from the line

g = torch.Generator().manual_seed(0)
noisy = [y + sigma * torch.randn(2000, count, 2, generator=g) for y in (y1, y2)]
lines = line_of_the_pixel(*noisy)  # two thousand fundamental matrices in one call
lines = lines * (lines @ line).sign()[:, None]
observed = (lines @ on_line.mT).std(0)
print(f"band predicted by derivatives / band of 2000 trials: {(predicted / observed).median():.3f}")
print(f"standard deviation: at the narrowest place {predicted.min():.2f} px, at the left border {predicted[0]:.2f} px")

fig, (left, right) = plt.subplots(1, 2, figsize=(11, 4.6), layout="constrained")
show_image(seen.images[1], title="60 lines of noisy matches, and the band of 2 sigma", ax=left)
for a, b, c in lines[:60]:
    left.plot(at_x, -(a * at_x + c) / b, color="yellow", linewidth=0.4, alpha=0.6)
for side in (-2, 2):
    left.plot(at_x, on_line[:, 1] + side * predicted / line[1].abs(), color="red", linewidth=1.5)
left.plot(*y2.T, ".", color="cyan", markersize=6)
left.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5))
right.plot(at_x, predicted, label="by derivatives")
right.plot(at_x, observed, "--", label="2000 trials")
right.axvline(float(match_of_pixel[0]), color="black", linewidth=0.8, label="the true match")
right.set(title="How far the line may be off", xlabel="x along the line [px]", ylabel="standard deviation [px]", ylim=(0, None))
right.legend()
right.grid(alpha=0.3)

# %% [markdown]
# The band is a hyperbola (Hartley & Zisserman, 11.11). It is narrowest near the true match: the matches that made *F* are
# of points about as far away, and they hold the line there. The ends of the line belong to depths where nothing was
# matched. One call replaced a page of algebra, and two thousand trials agree with it.
#
# **Exercise 4.** Add matches where the band is wide: which one helps most? *Hint:* compute the band with each match of
# ``both`` added in turn; all of them fit in one batch of ``fundamental_8pt``.
#
# **Exercise 5.** ``estimate_fundamental(..., covariance=True)`` gives the covariance of all nine entries of *F*. Make the
# same band from it.
