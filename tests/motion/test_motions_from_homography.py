"""From homographies to motions: against scenes, PoseLib and OpenCV."""

import numpy as np
import pytest
import torch
from chance import assert_share
from torch import Tensor
from two_view_scenes import F64, K

from torchsfm._types import Status
from torchsfm.geometry import rotation_from_rotvec
from torchsfm.motion import PlaneMotion, homography_dlt, motion_from_homography, motions_from_homography


def plane_scene(
    count: int, generator: torch.Generator, n: int = 8, move: float = 0.4
) -> tuple[PlaneMotion, Tensor, Tensor, Tensor]:
    """Motions, rays of n points of a plane before both cameras, and the homography in any scale and sign."""

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, dtype=F64, generator=generator)

    plane = torch.nn.functional.normalize(0.4 * normal(2 * count, 3) + torch.tensor([0.0, 0, 1]), dim=-1)
    R, t = rotation_from_rotvec(0.4 * normal(2 * count, 3)), move * normal(2 * count, 3)
    d1 = torch.cat((0.3 * normal(2 * count, n, 2), torch.ones(2 * count, n, 1, dtype=F64)), -1)
    depth = 1 / (d1 * plane[:, None]).sum(-1)
    d2 = depth[..., None] * d1 @ R.mT + t[:, None]
    seen = (depth > 0).all(-1) & (d2[..., 2] > 0).all(-1) & (1 + (plane * (R.mT @ t[..., None])[..., 0]).sum(-1) > 0)
    keep = seen.nonzero()[:count, 0]
    assert len(keep) == count
    H = (R + t[..., None] * plane[:, None])[keep] * normal(count, 1, 1)
    return PlaneMotion(R[keep], t[keep], plane[keep]), d1[keep], d2[keep], H


def gap(a: PlaneMotion, b: PlaneMotion) -> Tensor:
    parts = [(a.R - b.R).flatten(-2).norm(dim=-1), (a.t - b.t).norm(dim=-1), (a.normal - b.normal).norm(dim=-1)]
    return torch.stack(parts).amax(0)


def slots(motion: PlaneMotion) -> PlaneMotion:
    return PlaneMotion(motion.R[..., None, :, :], motion.t[..., None, :], motion.normal[..., None, :])


def test_recall(generator: torch.Generator) -> None:
    truth, _, _, H = plane_scene(2000, generator)
    found = motions_from_homography(H)
    error = torch.where(found.valid, gap(found.model, slots(truth)), 9).amin(-1)
    assert error.max() < 1e-9
    assert found.valid.all()
    single = motions_from_homography(H.float())
    assert single.model.R.dtype == torch.float32
    model = PlaneMotion(*(v.double() for v in (single.model.R, single.model.t, single.model.normal)))
    assert_share(gap(model, slots(truth)).amin(-1) < 1e-2, 0.99)


def test_every_motion_gives_the_homography(generator: torch.Generator) -> None:
    _, _, _, H = plane_scene(300, generator)
    m = motions_from_homography(H).model
    made = m.R + m.t[..., None] * m.normal[..., None, :]
    made, H = (A / A.flatten(-2).norm(dim=-1)[..., None, None] for A in (made, H[:, None]))
    assert torch.minimum((made - H).abs().amax((-2, -1)), (made + H).abs().amax((-2, -1))).max() < 1e-10
    assert (torch.linalg.det(m.R) - 1).abs().max() < 1e-10
    assert (m.normal[..., 2] > 0).all()
    assert (
        gap(PlaneMotion(m.R[:, 0], m.t[:, 0], m.normal[:, 0]), PlaneMotion(m.R[:, 1], m.t[:, 1], m.normal[:, 1])).min() > 1e-6
    )


def test_calibrations(generator: torch.Generator) -> None:
    truth, _, _, H = plane_scene(50, generator)
    K2 = K @ torch.diag(torch.tensor([1.3, 1.2, 1], dtype=F64))
    found = motions_from_homography(K2 @ H @ torch.linalg.inv(K), K, K2)
    assert gap(found.model, slots(truth)).amin(-1).max() < 1e-9


def test_pure_rotation_and_motion_along_the_normal(generator: torch.Generator) -> None:
    truth, d1, _, _ = plane_scene(20, generator)
    found = motions_from_homography(-3 * truth.R)
    assert found.valid.tolist() == [[True, False]] * 20
    assert found.model.t.abs().max() == 0
    torch.testing.assert_close(found.model.R[:, 0], truth.R)
    chosen = motion_from_homography(truth.R, d1, d1 @ truth.R.mT)
    assert (chosen.status == Status.DEGENERATE).all()
    assert chosen.in_front.all()
    torch.testing.assert_close(chosen.model.R, truth.R)
    along = 0.3 * (truth.R @ truth.normal[..., None])[..., 0]
    one = motions_from_homography(truth.R + along[..., None] * truth.normal[:, None])
    assert one.valid.tolist() == [[True, False]] * 20
    # A double root: half of the digits.
    assert gap(one.model, slots(PlaneMotion(truth.R, along, truth.normal)))[:, 0].max() < 1e-6


def test_points_choose_the_motion(generator: torch.Generator) -> None:
    truth, d1, d2, H = plane_scene(1000, generator)
    chosen = motion_from_homography(H, d1, d2)
    right = gap(chosen.model, truth) < 1e-8
    assert (chosen.status == Status.OK).all()
    assert chosen.in_front.all()
    assert right[~chosen.alternative_fits].all()
    assert (right | (gap(chosen.alternative, truth) < 1e-8)).all()
    assert_share(right, 0.7)
    # A plane that meets the optical axis behind the camera: the sign of (t, normal) follows the points.
    turn = rotation_from_rotvec(torch.tensor([0.0, 2.5, 0], dtype=F64))
    moved = motion_from_homography(H @ turn.mT, d1 @ turn.mT, d2)
    expected = PlaneMotion(truth.R @ turn.mT, truth.t, truth.normal @ turn.mT)
    found = torch.minimum(gap(moved.model, expected), gap(moved.alternative, expected))
    assert_share(found < 1e-8, 0.99)


def test_wrong_points_and_weights(generator: torch.Generator) -> None:
    _, d1, d2, H = plane_scene(60, generator)
    d2[:, :3] = -d2[:, :3]
    assert torch.equal(motion_from_homography(H, d1, d2).in_front[:, :3], torch.zeros(60, 3, dtype=torch.bool))
    weights = torch.ones(60, 8, dtype=torch.bool)
    weights[:, :3] = False
    d1[:, 0], d1[:, 1] = torch.nan, 0
    some = motion_from_homography(H, d1, d2, weights)
    assert (some.status == Status.OK).all()
    assert some.in_front.sum(-1).tolist() == [5] * 60
    # Rays to both sides cannot all meet in front.
    d2[:, 3:6] = -d2[:, 3:6]
    mixed = motion_from_homography(H, d1, d2, weights)
    assert (mixed.in_front.sum(-1) <= 3).all()
    assert (mixed.status[mixed.in_front.sum(-1) < 3] == Status.BEHIND).all()
    assert (motion_from_homography(H, d1, d2, 0 * weights.double()).status == Status.TOO_FEW).all()


def test_bad_homographies_leave_neighbours_alone(generator: torch.Generator) -> None:
    _, d1, d2, H = plane_scene(8, generator)
    reference = motions_from_homography(H)
    H[1, 0, 0], H[2], H[3, 2], H[4, 1, 1] = torch.nan, 0, H[3, 1], torch.inf
    H[5] = torch.diag(torch.tensor([1.0, 0, 0], dtype=F64))
    H.requires_grad_()
    found = motions_from_homography(H)
    assert not found.valid[1:6].any()
    assert torch.equal(found.model.R[[0, 6, 7]], reference.model.R[[0, 6, 7]])
    chosen = motion_from_homography(H, d1, d2)
    assert chosen.status.tolist() == [0, 4, 3, 3, 4, 3, 0, 0]
    (found.model.R.sum() + found.model.t.sum() + chosen.model.normal.sum()).backward()
    assert H.grad is not None
    assert torch.isfinite(H.grad).all()


def test_batches_and_derivatives(generator: torch.Generator) -> None:
    _, d1, d2, H = plane_scene(6, generator)
    together = motions_from_homography(H)
    for i in range(6):
        torch.testing.assert_close(motions_from_homography(H[i]).model.R, together.model.R[i], rtol=1e-9, atol=1e-12)
    assert motions_from_homography(H.reshape(2, 3, 3, 3), K, K).model.t.shape == (2, 3, 2, 3)
    assert motions_from_homography(H[:0]).valid.shape == (0, 2)
    wide = motion_from_homography(H[:, None], d1[:2], d2[:2])
    assert wide.in_front.shape == (6, 2, 8)
    x = (H[:2] / H[:2].norm(dim=(-2, -1), keepdim=True)).requires_grad_()

    def solve(H: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        m = motions_from_homography(H, K / 500, K / 400).model
        return m.R, m.t, m.normal

    assert torch.autograd.gradcheck(solve, (x,), eps=1e-8, atol=1e-4, rtol=1e-3)


def test_wrong_arguments(unchecked: None) -> None:
    with pytest.raises(ValueError, match="wanted"):
        motions_from_homography(torch.zeros(3, 4))
    with pytest.raises(ValueError, match="K2"):
        motions_from_homography(torch.eye(3), torch.eye(3), torch.eye(3, dtype=F64))
    with pytest.raises(ValueError, match="d2"):
        motion_from_homography(torch.eye(3), torch.ones(4, 3), torch.ones(5, 3))


@pytest.mark.reference
def test_against_poselib_and_opencv(generator: torch.Generator) -> None:
    poselib, cv2 = pytest.importorskip("poselib"), pytest.importorskip("cv2")
    _, _, _, H = plane_scene(100, generator)
    m = motions_from_homography(H).model
    for i in range(100):
        poses, _ = poselib.motion_from_homography(H[i].numpy())
        _, rotations, translations, normals = cv2.decomposeHomographyMat(H[i].numpy(), np.eye(3))
        for k in range(2):
            R, t, normal = m.R[i, k].numpy(), m.t[i, k].numpy(), m.normal[i, k].numpy()
            assert min(np.abs(p.R - R).max() + np.abs(p.t - t).max() for p in poses) < 1e-8
            theirs = zip(rotations, translations, normals, strict=True)
            gaps = [np.abs(A - R).max() + np.abs(b[:, 0] - t).max() + np.abs(c[:, 0] - normal).max() for A, b, c in theirs]
            assert min(gaps) < 1e-6


def test_noise(generator: torch.Generator) -> None:
    truth, d1, d2, _ = plane_scene(100, generator, n=60)
    x1, x2 = (d[..., :2] / d[..., 2:] for d in (d1, d2))
    x1, x2 = (x + 1e-4 * torch.randn(x.shape, dtype=F64, generator=generator) for x in (x1, x2))
    d1, d2 = (torch.nn.functional.pad(x, (0, 1), value=1.0) for x in (x1, x2))
    chosen = motion_from_homography(homography_dlt(x1, x2), d1, d2)
    error = torch.minimum(gap(chosen.model, truth), gap(chosen.alternative, truth))
    assert error.median() < 2e-3
    assert (chosen.status == Status.OK).all()
