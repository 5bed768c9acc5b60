"""The absolute dual quadric by linear least squares.

`w*_i = K_i K_i' ~ P_i Q P_i'`: every known zero or ratio in w* is one linear equation in the ten entries of Q (Triggs,
"Autocalibration and the absolute quadric", CVPR 1997; Pollefeys, Koch & Van Gool, IJCV 1999). The unknown scale of each
equation, w*_33, is put right by solving again. Q has rank 3 and is positive semidefinite; the nearest such quadric is taken.

Whether the equations determine Q is asked of the equations themselves: without one view, or without one equation, they must
still say the same (the jackknife of Quenouille and Tukey). That needs to know neither the noise of the cameras nor how it
spreads over the equations, and two singular values that are nothing but rounding or noise do not pass for a gap.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int8
from torch import Tensor

from torchsfm._types import Status, check_options, check_tensors
from torchsfm.autocalibration.algebraic_fit import MAX_DEVIATION
from torchsfm.autocalibration.projective_input import image_scaling
from torchsfm.linalg import eigh, null_vector, svdvals

_PAIRS = tuple((i, j) for i in range(4) for j in range(i, 4))
SIGMA = {"aspect": 0.1, "skew": 0.01, "principal_point": 0.05, "focal": 3.0}
"""How far the entries of w* / w*_33 that should be zero may be off, in images of size 1."""


@dataclass(frozen=True)
class DualQuadric:
    """An absolute dual quadric and the intrinsics that it gives each view.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> K = torchsfm.intrinsics(torch.tensor(900.0), torch.tensor([499.5, 374.5])).double()
        >>> poses = torchsfm.random_poses(4, spread=3.0, generator=g)
        >>> still = torchsfm.Pose(poses.R[:1].expand(4, 3, 3), poses.t)  # the camera shifts, but never turns
        >>> P = torch.stack((K @ poses.matrix(), K @ still.matrix()))
        >>> found = torchsfm.autocalibration.dual_quadric_linear(P, image_size=(1000.0, 750.0))
        >>> [torchsfm.Status(k).name for k in found.status.tolist()]
        ['OK', 'DEGENERATE']
        >>> bool((found.K[0] - K).abs().max() < 1), found.plane[0].shape
        (True, torch.Size([4]))
    """

    model: Float[Tensor, "*batch 4 4"]
    """Symmetric, rank 3, positive semidefinite, |Q| = 1."""
    K: Float[Tensor, "*batch v 3 3"]
    """Intrinsics of each view, in pixels."""
    valid: Bool[Tensor, "*batch v"]
    """Views whose conic is that of a real camera; others have K = I."""
    plane: Float[Tensor, "*batch 4"]
    """The plane at infinity, Q plane = 0."""
    deviation: Float[Tensor, "*batch v"]
    """Standard deviation of the logarithm of each view's focal length by the equations alone, from what they say when a view or
    an equation is left out, and from how far the expected focal length moved it; at most 1, which stands also where a view has
    no conic of a real camera."""
    gap: Float[Tensor, "*batch"]
    """Ratio of the least to the second least singular value of the equations, both raised to their rounding: near 1 where they
    leave Q open."""
    negative: Float[Tensor, "*batch"]
    """The third over the largest eigenvalue before positivity was enforced; negative where it had to be."""
    status: Int8[Tensor, "*batch"]
    """OK; DEGENERATE: the equations leave a focal length open, or Q is not that of real cameras; TOO_FEW equations;
    NOT_FINITE."""


def dual_quadric_linear(
    P: Float[Tensor, "*#batch v 3 4"],
    *,
    image_size: tuple[float, float],
    weights: Float[Tensor, "*#batch v"] | None = None,
    zero_skew: bool = True,
    unit_aspect: bool = True,
    expected_focal: float | None = 1.2,
    iterations: int = 4,
) -> DualQuadric:
    """The absolute dual quadric of projective cameras whose principal points are in the middle of the images.

    Focal lengths may vary. Known to be fooled by artificial solutions where the motion is nearly critical (Gherardi & Fusiello
    2010); `autocalibrate_points` does not depend on it.

    Args:
        P: Cameras in pixels, of any scale and sign.
        image_size: Width and height in pixels.
        weights: Of the views; 0 leaves one out.
        zero_skew: Use that pixels are rectangular.
        unit_aspect: Use that they are square.
        expected_focal: Focal length, over the longer side of the image, that is softly expected (within a factor of about 2, as
            Pollefeys et al., IJCV 2004, do), as far as the disagreement of the other equations lets it count; None expects
            none. It has no part in deciding whether the focal lengths are determined.
        iterations: Number of solutions, each with the scales of the one before.

    Returns:
        The quadric, intrinsics per view and status.

    Raises:
        ValueError: Shapes, dtypes or devices do not fit.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> K = torchsfm.intrinsics(torch.tensor([700.0, 800.0, 900.0, 1000.0]), torch.tensor([499.5, 374.5])).double()
        >>> P = K @ torchsfm.random_poses(4, spread=3.0, generator=g).matrix()
        >>> P = P @ (torch.eye(4) + 0.1).double()  # in a projective frame
        >>> found = torchsfm.autocalibration.dual_quadric_linear(P, image_size=(1000.0, 750.0))
        >>> found.valid, bool((found.K / K - 1)[:, 0, 0].abs().max() < 0.1)
        (tensor([True, True, True, True]), True)
    """
    batch = check_tensors(P=(P, "v>=2 3 4"), weights=(weights, "?v"))
    check_options(
        image_size=(image_size, "2 float > 0"),
        expected_focal=(expected_focal, "?float > 0"),
        iterations=(iterations, "int >= 1"),
    )
    v = P.shape[-3]
    full = P.detach().double().expand(*batch, v, 3, 4)
    w = full.new_ones(*batch, v) if weights is None else weights.detach().double().expand(*batch, v)
    good = torch.isfinite(full).flatten(-2).all(-1) & torch.isfinite(w) & (w > 0)
    w = torch.where(good, w, 0.0)
    T = image_scaling(full.new_tensor(image_size))
    focal = 1.0 if expected_focal is None else expected_focal
    T = torch.diag(full.new_tensor([1 / focal, 1 / focal, 1.0])) @ T
    eye = torch.eye(3, 4, dtype=full.dtype, device=full.device)
    S = T @ torch.where(good[..., None, None], full, eye)
    # A frame in which the cameras' rows are about orthonormal on average makes the equations well conditioned.
    S = S / S.flatten(-2).norm(dim=-1)[..., None, None].clamp_min(1e-300)
    gram = (S.mT @ S * w[..., None, None]).sum(-3)
    gram = gram / gram.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None].clamp_min(1e-300)
    L, info = torch.linalg.cholesky_ex(gram + 1e-10 * torch.eye(4, dtype=full.dtype, device=full.device))
    eye4 = torch.eye(4, dtype=full.dtype, device=full.device)
    L = torch.where((info == 0)[..., None, None], L, eye4)
    frame = torch.linalg.inv_ex(L.mT).inverse
    S = S @ frame[..., None, :, :]
    S = S / S.flatten(-2).norm(dim=-1)[..., None, None].clamp_min(1e-300)

    def row(i: int, j: int) -> Tensor:
        a, b = S[..., i, :], S[..., j, :]
        terms = [a[..., k] * b[..., m] + (a[..., m] * b[..., k] if k != m else 0) for k, m in _PAIRS]
        return torch.stack(terms, -1)

    corner = row(2, 2)
    rows = [(row(0, 2), SIGMA["principal_point"] / focal), (row(1, 2), SIGMA["principal_point"] / focal)]
    rows += [(row(0, 1), SIGMA["skew"])] if zero_skew else []
    rows += [(row(0, 0) - row(1, 1), SIGMA["aspect"])] if unit_aspect else []
    A = torch.stack([r / sigma for r, sigma in rows], -2)
    prior = torch.stack((row(0, 0) - corner, row(1, 1) - corner), -2) / SIGMA["focal"]
    known = len(rows)
    count = good.sum(-1)
    rounding = 64 * torch.finfo(P.dtype).eps
    scale = torch.ones_like(w)
    q = A.new_zeros(*batch, 10)
    for _ in range(iterations):
        weight = (w.sqrt() / scale)[..., None, None]
        equations = A * weight
        values, _ = svdvals(torch.nn.functional.pad(equations.flatten(-3, -2), (0, 0, 0, 10)))
        noise = torch.maximum(values[..., -1] / (count * known - 9).clamp_min(1).to(w.dtype).sqrt(), rounding * values[..., 0])
        whole = equations
        if expected_focal is not None:
            whole = torch.cat((equations, noise[..., None, None, None] * prior * weight), -2)
        q, _ = null_vector(torch.nn.functional.pad(whole.flatten(-3, -2), (0, 0, 0, 10)))
        size = (corner * q[..., None, :]).sum(-1).abs()
        scale = size.clamp_min(1e-3 * size.amax(-1, keepdim=True)).clamp_min(1e-300)
    floor = rounding * values[..., 0] + 1e-300
    gap = (values[..., -1] + floor) / (values[..., -2] + floor)
    deviation = _jackknife(equations, S, q, good)
    Q = _symmetric(q)
    spectrum, axes, _ = eigh(Q)
    flip = (spectrum[..., 0] + spectrum[..., -1] < 0)[..., None]
    spectrum = torch.where(flip, -spectrum.flip(-1), spectrum)
    axes = torch.where(flip[..., None], axes.flip(-1), axes)
    third = spectrum[..., 1] / spectrum[..., 3].clamp_min(1e-300)
    kept = spectrum.clamp_min(0)
    kept = torch.cat((torch.zeros_like(kept[..., :1]), kept[..., 1:]), -1)
    Q = (axes * kept[..., None, :]) @ axes.mT
    plane = torch.linalg.solve_ex(frame.mT, axes[..., :1]).result[..., 0]
    Q = frame @ Q @ frame.mT
    conic = T @ full.nan_to_num(0.0, 0.0, 0.0) @ Q[..., None, :, :] @ (T @ full.nan_to_num(0.0, 0.0, 0.0)).mT
    K, valid = _upper_cholesky(conic)
    valid = valid & good
    K = torch.linalg.inv_ex(T).inverse @ torch.where(valid[..., None, None], K, T @ eye[:, :3])
    K = torch.where(valid[..., None, None], K / K[..., 2:, 2:], eye[:, :3])
    status = torch.full(batch, int(Status.OK), dtype=torch.int8, device=P.device)
    # Of two null vectors the solvers of some machines always return the same one: leaving out data then shows no spread.
    two = values[..., -2] <= 16 * floor
    open_ = two | ((deviation > MAX_DEVIATION) & good).any(-1)
    for condition, code in (
        ((third < 1e-9) | open_ | ~(valid | ~good).all(-1), Status.DEGENERATE),
        (count * known < 9, Status.TOO_FEW),
        (count == 0, Status.NOT_FINITE),
    ):
        status = torch.where(condition, int(code), status)
    dtype = P.dtype
    unit = Q / Q.flatten(-2).norm(dim=-1)[..., None, None].clamp_min(1e-300)
    plane = plane / plane.norm(dim=-1, keepdim=True).clamp_min(1e-300)
    numbers = (unit.to(dtype), K.to(dtype), valid, plane.to(dtype), deviation.to(dtype), gap.to(dtype), third.to(dtype))
    return DualQuadric(*numbers, status.to(torch.int8))


def _symmetric(q: Tensor) -> Tensor:
    i, j = torch.tensor(_PAIRS, device=q.device).unbind(-1)
    Q = q.new_zeros(*q.shape[:-1], 4, 4)
    Q[..., i, j] = q
    Q[..., j, i] = q
    return Q


def _jackknife(equations: Tensor, S: Tensor, q: Tensor, good: Tensor) -> Tensor:
    """Deviation (*batch, v) of the log focal lengths of q, the larger of what leaving out views and equations tells."""
    known = equations.shape[-2]
    outer = equations[..., :, None] * equations[..., None, :]
    normal = outer.sum((-4, -3))
    unit = normal.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None].clamp_min(1e-300)

    def solved(N: Tensor) -> Tensor:
        """Null vectors: squared equations are accurate enough for deviations that are not tiny."""
        return eigh(N)[1][..., 0]

    def focal(q: Tensor, cameras: Tensor) -> Tensor:
        """Logarithms of focal lengths, infinite where the conic is that of no real camera."""
        K, real = _upper_cholesky(cameras @ _symmetric(q)[..., None, :, :] @ cameras.mT)
        return torch.where(real, (K[..., 0, 0] * K[..., 1, 1]).log() / 2, torch.inf)

    def square(a: Tensor, b: Tensor) -> Tensor:
        return (a - b).square().nan_to_num(1.0).clamp_max(1.0)

    whole = focal(solved(normal / unit), S)
    told = torch.zeros_like(whole)
    number = good.sum(-1).to(whole.dtype)
    for left_out, each in ((outer.sum(-3), 1), (outer.flatten(-4, -3), known)):
        rest = focal(solved((normal[..., None, :, :] - left_out) / unit[..., None, :, :]), S[..., None, :, :, :])
        counted = good.repeat_interleave(each, -1)[..., None]
        spread = (square(rest, whole[..., None, :]) * counted).sum(-2)
        share = ((number * known - 9) / (number * known)).clamp(0, 1)[..., None]
        # Fewer than nine equations say nothing.
        enough = (number * known - known // each >= 9)[..., None]
        told = torch.where(enough, torch.maximum(told, share * spread), told)
    told = told + square(focal(q, S), whole)
    return torch.where(good, told.sqrt().clamp_max(1.0), 1.0)


def _upper_cholesky(C: Tensor) -> tuple[Tensor, Tensor]:
    """The upper triangular K with `K K' ~ C`, K_33 = 1, and where there is one."""
    c33 = C[..., 2, 2]
    good = c33.abs() > 0
    D = C / torch.where(good, c33, 1.0)[..., None, None]
    cx, cy = D[..., 0, 2], D[..., 1, 2]
    yy = D[..., 1, 1] - cy * cy
    good = good & (yy > 0)
    fy = torch.where(good, yy, 1.0).sqrt()
    skew = (D[..., 0, 1] - cx * cy) / fy
    xx = D[..., 0, 0] - cx * cx - skew * skew
    good = good & (xx > 0) & torch.isfinite(D).flatten(-2).all(-1)
    fx = torch.where(good, xx, 1.0).sqrt()
    zero = torch.zeros_like(fx)
    K = torch.stack((fx, skew, cx, zero, fy, cy, zero, zero, zero + 1), -1).reshape(C.shape)
    return torch.where(good[..., None, None], K, torch.eye(3, dtype=C.dtype, device=C.device)), good
