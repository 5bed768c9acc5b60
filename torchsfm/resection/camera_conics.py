"""The camera that sees coplanar conics: patterns of circles, drawings, signs.

What is left between a measured ellipse and the image of its conic is the distance of parallel tangents, at sixteen places
around it. A pair of conics has ten numbers for six unknowns, but conics have symmetries, and a plane seen from afar has two
poses: all poses from which one of the conics looks right are tried, and the best different ones refined.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int8
from torch import Tensor

from torchsfm._types import Status, check_tensors, tensor_map
from torchsfm.geometry.conic_distance import square_root
from torchsfm.geometry.conics import shape_of_dual_conic
from torchsfm.geometry.poses import Pose
from torchsfm.linalg import adjugate_3x3, eigh, unit_scale, usable
from torchsfm.linalg.rows import inner
from torchsfm.optim import levenberg_marquardt, rotation_exponential
from torchsfm.optim.pytree import cut, flatten, join
from torchsfm.resection.ellipse_poses import ellipse_poses

_SLOTS = 4
"""As many symmetries has the most symmetric pair of conics that determines a pose: coaxial ellipses about one centre."""
_TANGENTS = 16
_KEPT, _REFINED = 20, 8
"""Starts that are refined a little, and to the end."""
_FIRST, _LAST = 6, 60
"""Steps."""
_NEAR, _SAME = 0.05, 1e-5
"""The difference of the rotations of starts that lead to one minimum, and of one minimum."""
_RIVAL = 4.0
"""By how much larger the error of another answer may be: chance does that to the errors of two conics in one of a hundred."""
_ROUNDING = 1e-9
"""Of an error, relative to the size of the images."""
_PIECE = 400
"""Conics whose poses are looked for together: all starts of more would not fit the memory."""
_RANK = 1e-11
"""Eigenvalues of the normal equations below this, relative to the largest, are nothing."""


@dataclass(frozen=True)
class ConicPoses:
    """Poses from which coplanar conics look as they were seen, the best first.

    Example:
        >>> import torch, torchsfm
        >>> from torchsfm.geometry import conic_from_ellipse, rotation_from_rotvec, transform_conic
        >>> centre = torch.tensor([[-1.0, 0.0], [1.0, 0.0]]).double()  # two equal circles
        >>> drawn = conic_from_ellipse(torchsfm.Ellipse(centre, torch.ones(2, 2).double(), torch.zeros(2).double()))
        >>> turn, t = torch.tensor([0.5, -0.3, 0.2]).double(), torch.tensor([0.0, 0.0, 6.0]).double()
        >>> P = torchsfm.Pose(rotation_from_rotvec(turn), t).matrix()
        >>> found = torchsfm.camera_conics(transform_conic(P[:, [0, 1, 3]], drawn), drawn)
        >>> found.valid  # they look alike from the front and from behind
        tensor([ True,  True, False, False])
        >>> found.pose.centre[found.valid][:, 2].sign().sort().values, bool((found.error[found.valid] < 1e-6).all())
        (tensor([-1.,  1.], dtype=torch.float64), True)
    """

    model: Float[Tensor, "*batch 4 3 4"]
    """`cam_from_world` as `[R | t]`, finite always."""
    valid: Bool[Tensor, "*batch 4"]
    """Which slots are minima that explain the images, none of them four times worse than the best. Several are where the conics
    have a symmetry (all circles in a row look the same from behind), or where they are so far away that noise hides on which
    side the plane leans."""
    error: Float[Tensor, "*batch 4"]
    """Weighted root-mean-square distance of the tangents, in the plane z = 1: times the focal length pixels."""
    status: Int8[Tensor, "*batch"]
    """OK; NOT_FINITE: data with weight are not finite; TOO_FEW: fewer than two conics; DEGENERATE: a conic or its image is no
    ellipse, or they do not determine the pose (circles about one centre, one conic twice); NOT_CONVERGED."""

    @property
    def pose(self) -> Pose:
        """The models as poses with a batch dimension of four at the end."""
        return Pose.from_matrix(self.model)


@dataclass(frozen=True)
class _State:
    R: Float[Tensor, "*batch 3 3"]
    t: Float[Tensor, "*batch 3"]

    def moved(self, delta: Float[Tensor, "*batch 6"]) -> "_State":
        return _State(self.R @ rotation_exponential(delta[..., :3]), self.t + delta[..., 3:])


@dataclass(frozen=True)
class _Data:
    """Conics m, and directions k around each image. Dual conics have corner 1."""

    dual: Float[Tensor, "*batch m 3 3"]
    n: Float[Tensor, "*batch m k 2"]
    """Unit normals of the tangents."""
    support: Float[Tensor, "*batch m k"]
    """Their distances from the origin."""
    counts: Bool[Tensor, "*batch m"]


def camera_conics(
    C: Float[Tensor, "*#batch m 3 3"],
    C_plane: Float[Tensor, "*#batch m 3 3"],
    *,
    weights: Float[Tensor, "*#batch m"] | None = None,
) -> ConicPoses:
    """The poses of a camera that sees two or more known ellipses of the plane z = 0.

    Least squares on the distances of parallel tangents of the measured ellipse and of the image of the known one, at sixteen
    places around it, which stand for edge points of one variance. Computed in float64; the derivatives are those of the minima
    (implicit function theorem with the exact Hessian).

    Args:
        C: Images, ellipses in the plane z = 1 of the camera: `K' C K` of the conics of pixels. Up to scale.
        C_plane: The ellipses themselves, in x and y of the world. Up to scale.
        weights: Factors of the squares, 0 for absent.

    Returns:
        Up to four poses by increasing error, from either side of the plane, and a status.

    Raises:
        ValueError: Shapes, dtypes or devices do not fit.

    Example:
        >>> import torch, torchsfm
        >>> from torchsfm.geometry import conic_from_ellipse, rotation_from_rotvec, transform_conic
        >>> centre, axes = torch.tensor([[0.0, 0.0], [2.0, 0.5]]), torch.tensor([[1.0, 0.5], [0.7, 0.6]])
        >>> drawn = conic_from_ellipse(torchsfm.Ellipse(centre.double(), axes.double(), torch.tensor([0.0, 1.0]).double()))
        >>> turn, t = torch.tensor([0.5, -0.3, 0.2]).double(), torch.tensor([0.0, 0.0, 6.0]).double()
        >>> P = torchsfm.Pose(rotation_from_rotvec(turn), t).matrix()
        >>> found = torchsfm.camera_conics(transform_conic(P[:, [0, 1, 3]], drawn), drawn)
        >>> found.valid, bool(found.model[0].allclose(P))
        (tensor([ True, False, False, False]), True)
    """
    batch = check_tensors(C=(C, "m>=1 3 3"), C_plane=(C_plane, "m 3 3"), weights=(weights, "?m"))
    dtype, m = C.dtype, C.shape[-3]
    w = C.new_ones(*batch, m).double() if weights is None else weights.double().expand(*batch, m)
    absent = w.detach() == 0
    fine = (w.detach() > 1e-30) & (w.detach() < 1e30)
    conics = [c.double().expand(*batch, m, 3, 3) for c in (C, C_plane)]
    sound = torch.stack([usable(c).all(-1).all(-1) for c in conics]).all(0) & fine
    broken = (~sound & ~absent).any(-1)
    counts = sound & ~broken[..., None]
    unit = torch.diag(torch.tensor([1.0, 1.0, -1.0], dtype=w.dtype, device=w.device))
    conics = [torch.where(counts[..., None, None], c, unit) for c in conics]
    w = torch.where(counts, w, 0.0)
    (c, D, seen), (c0, D0, drawn) = (shape_of_dual_conic(adjugate_3x3(c * unit_scale(c))) for c in conics)
    ellipses = ((seen & drawn) | ~counts).all(-1)
    counts = counts & ellipses[..., None]
    w = torch.where(counts, w, 0.0)
    with torch.no_grad():
        origin, scale = _middle(c0, D0, w)
    data = _measured(
        c, D, (c0 - origin[..., None, :]) / scale[..., None, None], D0 / scale.square()[..., None, None, None], counts
    )
    flat = flatten((data, (w, c.detach(), D.detach())), batch)
    step = max(1, _PIECE // m)
    pieces = [cut(flat, i, i + step) for i in range(0, max(batch.numel(), 1), step)]
    x, valid, error, regular, done = tensor_map(
        lambda v: v.reshape(batch + v.shape[1:]), join([_solve(data, *rest) for data, rest in pieces])
    )
    few = counts.sum(-1) < 2
    valid = valid & ~(broken | few | ~ellipses)[..., None]
    t = scale[..., None, None] * x.t - (x.R[..., :2] @ origin[..., None, :, None])[..., 0]
    model = torch.cat((x.R, t[..., None]), -1)
    valid = valid & torch.isfinite(model.detach().to(dtype)).all(-1).all(-1)
    status = torch.where(valid[..., 0], int(Status.OK), int(Status.DEGENERATE))
    for condition, code in (
        (regular & ~done, Status.NOT_CONVERGED),
        (few, Status.TOO_FEW),
        (~ellipses, Status.DEGENERATE),
        (broken, Status.NOT_FINITE),
    ):
        status = torch.where(condition, int(code), status)
    eye = torch.eye(3, 4, dtype=model.dtype, device=model.device)
    model = torch.where(valid[..., None, None], model, eye)
    return ConicPoses(model.to(dtype), valid, torch.where(valid, error, 0.0).to(dtype), status.to(torch.int8))


def _solve(data: _Data, w: Tensor, c: Tensor, D: Tensor) -> tuple[_State, Tensor, Tensor, Tensor, Tensor]:
    """The minima of a flat batch, which of them are answers, their errors; where the best is determined and a minimum."""
    weights = _by_tangent(w)[:, None]
    with torch.no_grad():
        _, size = _middle(c, D, w)
        fixed = tensor_map(torch.Tensor.detach, data)
        each = _beside(fixed)
        first = levenberg_marquardt(
            _residual, _starts(fixed, w, c, D), each, retract=_State.moved, size=6, weights=weights,
            linearize=_linearize, max_iterations=_FIRST,
        )  # fmt: skip
        start, _ = _distinct(first.x, first.cost, _REFINED, _NEAR)
    found = levenberg_marquardt(
        _residual, start, _beside(data), retract=_State.moved, size=6, weights=weights, linearize=_linearize,
        max_iterations=_LAST, function_tolerance=1e-12,
    )  # fmt: skip
    with torch.no_grad():
        total = (_TANGENTS * w.sum(-1, keepdim=True)).clamp_min(1e-300)
        error = (2 * found.cost / total).sqrt()
        # Of exact data the cost is rounding, and no step lowers it any more.
        rounding = _ROUNDING * size[:, None]
        done = torch.isfinite(error) & ((found.status == Status.OK) | (error < rounding))
    x, order = _distinct(tensor_map(torch.Tensor.detach, found.x), torch.where(done, error, torch.inf), _SLOTS, _SAME)
    with torch.no_grad():
        error, done = error.gather(-1, order), done.gather(-1, order)
        regular = _regular(x, each, w)
        own = torch.cat([(order[:, i : i + 1] != order[:, :i]).all(-1, keepdim=True) for i in range(_SLOTS)], -1)
        valid = own & done & regular & (error <= _RIVAL * error[:, :1] + rounding)
    return _pick(found.x, order), valid & valid[:, :1], error, regular[:, 0], done[:, 0]


def _middle(c: Tensor, D: Tensor, w: Tensor) -> tuple[Tensor, Tensor]:
    """The middle of ellipses and their size about it."""
    share = w / w.sum(-1, keepdim=True).clamp_min(1e-300)
    middle = (share[..., None] * c).sum(-2)
    square = (c - middle[..., None, :]).square().sum(-1) + D.diagonal(dim1=-2, dim2=-1).sum(-1)
    size = (share * square).sum(-1).sqrt()
    return middle, torch.where((size > 0) & torch.isfinite(size), size, 1.0)


def _measured(c: Tensor, D: Tensor, c0: Tensor, D0: Tensor, counts: Tensor) -> _Data:
    """Tangents all around each image, and what they are tangents of."""
    t = torch.arange(_TANGENTS, dtype=c.dtype, device=c.device) * (2 * math.pi / _TANGENTS)
    root = square_root(D)
    p = torch.stack((t.cos(), t.sin()), -1)
    a, b, d = root[..., 0, 0], root[..., 0, 1], root[..., 1, 1]
    n = p @ torch.stack((torch.stack((d, -b), -1), torch.stack((-b, a), -1)), -2)
    n = n / torch.linalg.vector_norm(n, dim=-1, keepdim=True)
    support = (n @ c[..., None])[..., 0] + ((n @ D) * n).sum(-1).sqrt()
    one = torch.ones_like(c0[..., :1])
    corner = torch.cat((c0, one), -1)
    flat = torch.nn.functional.pad(D0, (0, 1, 0, 1))
    return _Data(corner[..., :, None] * corner[..., None, :] - flat, n, support, counts)


def _beside(data: _Data) -> _Data:
    """For several states of each problem."""
    dim = data.counts.ndim - 1
    return tensor_map(lambda t: t.unsqueeze(dim), data)


def _by_tangent(w: Tensor) -> Tensor:
    return w[..., None].expand(*w.shape, _TANGENTS).flatten(-2)


def _images(H: Tensor, data: _Data) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """W H', the images' dual conics' corners, centre and square along the normals, and support; inf where not all in front."""
    half = data.dual @ H[..., None, :, :].mT
    dual = H[..., None, :, :] @ half
    corner = dual[..., 2, 2]
    depth = half[..., 2, 2]
    front = (corner.detach() > 0) & (depth.detach() > 0)
    safe = torch.where(front, corner, 1.0)[..., None]
    u = (data.n @ (dual[..., :2, 2] / safe)[..., None])[..., 0]
    g = inner(data.n @ dual[..., :2, :2], data.n) / safe
    square = u.square() - g
    some = front[..., None] & (square.detach() > 0)
    s = torch.where(some, torch.where(some, square, 1.0).sqrt(), torch.inf)
    return half, safe, u, g, s


def _homography(state: _State) -> Tensor:
    return torch.cat((state.R[..., :2], state.t[..., None]), -1)


def _residual(state: _State, data: _Data) -> Tensor:
    *_, u, _, s = _images(_homography(state), data)
    r = torch.where(data.counts[..., None], u + s - data.support, 0.0)
    return r.flatten(-2)[..., None]


def _linearize(state: _State, data: _Data) -> tuple[Tensor, Tensor]:
    H = _homography(state)
    half, corner, u, g, s = _images(H, data)
    R, zero = state.R, torch.zeros_like(state.R[..., 0])
    # By turns about the axes of the plane, then by shifts of the camera frame.
    slopes = [torch.stack(v, -1) for v in ((zero, R[..., 2], zero), (-R[..., 2], zero, zero), (R[..., 1], -R[..., 0], zero))]
    shifts = torch.zeros(3, 3, 3, dtype=R.dtype, device=R.device)
    shifts[:, :, 2] = torch.eye(3, dtype=R.dtype, device=R.device)
    dH = torch.cat((torch.stack(slopes, -3), shifts.expand(*R.shape[:-2], 3, 3, 3)), -3)
    S = dH[..., None, :, :, :] @ half[..., :, None, :, :]
    relative = (2 * S[..., 2, 2] / corner)[..., None, :]
    centre = (S[..., :2, 2] + S[..., 2, :2]) / corner[..., None]
    du = data.n @ centre.mT - u[..., None] * relative
    nS = torch.einsum("...ki,...pij,...kj->...kp", data.n, S[..., :2, :2], data.n)
    dg = 2 * nS / corner[..., None] - g[..., None] * relative
    J = du + (u[..., None] * du - 0.5 * dg) / s[..., None]
    J = torch.where(data.counts[..., None, None], J, 0.0)
    r = torch.where(data.counts[..., None], u + s - data.support, 0.0)
    return r.flatten(-2)[..., None], J.flatten(-3, -2)[..., None, :]


def _starts(data: _Data, w: Tensor, c: Tensor, D: Tensor) -> _State:
    """Poses from which the conic that counts most looks right, where the others look better than from its neighbours."""
    c0, D0, _ = shape_of_dual_conic(-data.dual)
    size = D.diagonal(dim1=-2, dim2=-1).sum(-1)
    first = torch.where(data.counts, w * size, -1.0).argmax(-1)[:, None]
    R, t = ellipse_poses(*(v.take_along_dim(first[(...,) + (None,) * (v.ndim - 2)], 1)[:, 0] for v in (c, D, c0, D0)))
    state = _State(R.flatten(1, 3), t.flatten(1, 3))
    rough = _Data(data.dual, data.n[..., ::2, :], data.support[..., ::2], data.counts)
    r = _residual(state, _beside(rough))[..., 0]
    some = w.repeat_interleave(_TANGENTS // 2, -1)[..., None, :]
    cost = (r.square() * some).sum(-1).nan_to_num(torch.inf, torch.inf).reshape(R.shape[:-2])
    beside = torch.nn.functional.pad(cost, (0, 0, 1, 1), value=torch.inf)
    cost = torch.where(cost <= torch.minimum(beside[:, :, :-2], beside[:, :, 2:]), cost, torch.inf)
    return _pick(state, cost.flatten(1).topk(_KEPT, largest=False).indices)


def _pick(state: _State, index: Tensor) -> _State:
    """Some of several states of each problem."""
    R = state.R.gather(-3, index[..., None, None].expand(*index.shape, 3, 3))
    return _State(R, state.t.gather(-2, index[..., None].expand(*index.shape, 3)))


def _distinct(state: _State, cost: Tensor, count: int, apart: float) -> tuple[_State, Tensor]:
    """The best ones whose rotations differ, and which they are; where there are none left, the first one."""
    cost = cost.nan_to_num(torch.inf, torch.inf)
    kept: list[Tensor] = []
    for _ in range(count):
        index = torch.where(torch.isfinite(cost.amin(-1, keepdim=True)), cost.argmin(-1, keepdim=True), kept[0] if kept else 0)
        kept.append(index)
        cost = torch.where((state.R - _pick(state, index).R).abs().amax((-2, -1)) < apart, torch.inf, cost)
    order = torch.cat(kept, -1)
    return _pick(state, order), order


def _regular(state: _State, data: _Data, w: Tensor) -> Tensor:
    """Where the images determine the pose."""
    _, J = _linearize(state, data)
    # Shifts along the view in units of the depth: all that is determined has slopes of one size.
    unit = torch.cat((torch.ones_like(state.R[..., 0]), torch.ones_like(state.t[..., :2]), state.t[..., 2:]), -1)
    J = torch.where(torch.isfinite(J), J, 0.0)[..., 0, :] * unit[..., None, :]
    values, _, ok = eigh((_by_tangent(w)[..., None, :, None] * J).mT @ J)
    return ok & (values[..., 0] > _RANK * values[..., -1])
