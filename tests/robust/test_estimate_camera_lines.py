"""The door for calibrated cameras with lines: mixtures with points, units, worlds, degenerate structure, PoseLib."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from chance import assert_share, seeded
from torch import Tensor

from torchsfm._types import Status
from torchsfm.geometry import line_from_points, pluecker_from_points, random_rotation, rotation_angle, rotvec_from_rotation
from torchsfm.resection import PointLineCameraEstimator, estimate_camera
from torchsfm.robust import Degeneracy, RobustResult, constant_weights

F64 = torch.float64
K = torch.tensor([[800.0, 0, 500], [0, 820, 400], [0, 0, 1]], dtype=F64)


@dataclass(frozen=True)
class Scene:
    """Points and segments of p problems; the ends of a segment are not those of its piece of the line."""

    x: Tensor
    X: Tensor
    l: Tensor  # noqa: E741
    ends: Tensor
    wrong: Tensor
    """Of points, then of lines."""
    pose: Tensor

    @property
    def L(self) -> Tensor:
        return pluecker_from_points(self.ends[..., 0, :], self.ends[..., 1, :])

    def estimate(self, threshold: float | None = 4.0, **options: object) -> RobustResult[Tensor]:
        return estimate_camera(
            self.x, self.X, K, self.l, self.L, threshold=threshold, **({"generator": seeded()} | options)  # type: ignore[arg-type]
        )  # fmt: skip


def project(X: Tensor, pose: Tensor) -> Tensor:
    Y = (X @ pose[..., :3].mT + pose[..., None, :, 3]) @ K.mT
    return Y[..., :2] / Y[..., 2:]


def make(
    p: int, n: int, k: int, generator: torch.Generator, share: float = 0.3, noise: float = 1.0, ends: Tensor | None = None
) -> Scene:
    """`share` of the image points and of the segments are anywhere in the image."""
    kind = {"generator": generator, "dtype": F64}
    R, t = random_rotation(p, **kind), 0.3 * torch.randn(p, 3, **kind) + torch.tensor([0.0, 0, 6])
    pose = torch.cat((R, t[..., None]), -1)
    X, space = 4 * torch.rand(p, n, 3, **kind) - 2, 4 * torch.rand(p, k, 2, 3, **kind) - 2
    space = space if ends is None else ends
    part = torch.tensor([[0.1, 0.9], [0.8, 0.2]], dtype=F64) @ space
    x, l = project(X, pose), project(part.flatten(1, 2), pose).unflatten(1, (k, 2))  # noqa: E741
    x, l = x + noise * torch.randn(x.shape, **kind), l + noise * torch.randn(l.shape, **kind)  # noqa: E741
    wrong = torch.rand(p, n + k, generator=generator) < share
    x = torch.where(wrong[:, :n, None], 1000 * torch.rand(x.shape, **kind), x)
    l = torch.where(wrong[:, n:, None, None], 1000 * torch.rand(l.shape, **kind), l)  # noqa: E741
    return Scene(x, X, l, space, wrong, pose)


def turn(model: Tensor, pose: Tensor) -> Tensor:
    return torch.rad2deg(rotation_angle(model[..., :3] @ pose[..., :3].mT))


def steps(model: Tensor, pose: Tensor) -> Tensor:
    """(w, v) from the poses to the models."""
    R = model[..., :3] @ pose[..., :3].mT
    return torch.cat((rotvec_from_rotation(R), model[..., 3] - (R @ pose[..., 3:])[..., 0]), -1)


def distances(scene: Scene, model: Tensor) -> Tensor:
    """Of points, then of lines, written out from two points of each line."""
    A, B = (torch.cat((project(scene.ends[..., i, :], model), torch.ones_like(scene.l[..., :1, 0])), -1) for i in (0, 1))
    line = torch.linalg.cross(A, B)
    h = torch.cat((scene.l, torch.ones_like(scene.l[..., :1])), -1)
    away = (h * line[..., None, :]).sum(-1) / line[..., None, :2].norm(dim=-1)
    return torch.cat(((project(scene.X, model) - scene.x).norm(dim=-1), away.norm(dim=-1)), -1)


@pytest.mark.parametrize(("n", "k", "share"), [(40, 40, 0.3), (0, 100, 0.5), (30, 200, 0.6), (200, 30, 0.6), (2, 30, 0.2)])
def test_poses_are_right(n: int, k: int, share: float, generator: torch.Generator) -> None:
    scene = make(24, n, k, generator, share)
    result = scene.estimate()
    assert (result.status == Status.OK).all()
    assert (result.degeneracy == Degeneracy.NONE).all()
    assert (turn(result.model, scene.pose) < 1.0).all()
    assert ((result.model - scene.pose)[..., 3].norm(dim=-1) < 0.15).all()
    gap = distances(scene, result.model)
    assert ((gap < 4.0) == result.inliers)[result.inliers].all()
    assert result.inliers.shape == scene.wrong.shape
    assert (result.inliers & ~scene.wrong).sum() > 0.95 * (~scene.wrong).sum()


def test_refinement_reaches_the_bound(generator: torch.Generator) -> None:
    scene = make(100, 60, 90, generator, 0.4)
    kind = torch.cat((torch.zeros(60, 1), torch.ones(90, 1))).double()
    length = scene.L[..., :3].norm(dim=-1, keepdim=True)
    X = torch.cat((torch.nn.functional.pad(scene.X, (0, 3)), scene.L / length), -2)
    x = torch.cat((torch.cat((scene.x, scene.x), -1), scene.l.flatten(-2)), -2)
    model, estimator = scene.pose, PointLineCameraEstimator(K.expand(100, 3, 3))
    for _ in range(4):
        model = estimator.step(model, x, X, kind, weigh=constant_weights((~scene.wrong).double()))
    for threshold in (2.5, 5.0):
        ratio = turn(scene.estimate(threshold).model, scene.pose) / turn(model, scene.pose)
        assert ratio.log().mean().exp() < 1.1


def test_lines_add_to_points(generator: torch.Generator) -> None:
    """Few points leave much of the pose to chance that lines determine."""
    scene = make(100, 8, 60, generator, 0.0)
    points = estimate_camera(scene.x, scene.X, K, threshold=4.0, generator=seeded())
    both = scene.estimate()
    assert turn(both.model, scene.pose).median() < 0.6 * turn(points.model, scene.pose).median()


def test_world_unit_and_form_of_the_lines_are_free(generator: torch.Generator) -> None:
    scene = make(6, 40, 40, generator)
    plain = scene.estimate()
    for size, shift in ((1e-3, 0.0), (1.0, 1e4), (1e4, -1e6)):
        moved = replace(scene, X=scene.X * size + shift, ends=scene.ends * size + shift).estimate()
        assert (turn(moved.model, plain.model) < 1e-3).all()
        assert (moved.inliers == plain.inliers).double().mean() > 0.99
    swapped = replace(scene, l=scene.l.flip(-2), ends=scene.ends.flip(-2)).estimate()
    torch.testing.assert_close(swapped.model, plain.model, rtol=1e-5, atol=1e-6)
    S = torch.diag(torch.tensor([1000.0, 1000, 1], dtype=F64))
    scaled = estimate_camera(
        1000 * scene.x, scene.X, S @ K, 1000 * scene.l, -3 * scene.L, threshold=4000.0, generator=seeded()
    )  # fmt: skip
    torch.testing.assert_close(scaled.model, plain.model, rtol=1e-5, atol=1e-6)
    assert torch.equal(scaled.inliers, plain.inliers)


def test_image_lines_without_ends(generator: torch.Generator) -> None:
    scene = make(12, 20, 80, generator, 0.3, 0.5)
    scale = torch.randn(12, 80, 1, generator=generator, dtype=F64).exp()
    l = -scale * line_from_points(scene.l[..., 0, :], scene.l[..., 1, :])  # noqa: E741
    result = estimate_camera(scene.x, scene.X, K, l, scene.L, threshold=6.0, generator=seeded())
    assert (result.status == Status.OK).all()
    assert (turn(result.model, scene.pose) < 1.5).all()


def test_ragged_problems_are_a_loop(generator: torch.Generator) -> None:
    scene = make(5, 40, 50, generator, 0.3)
    mask = torch.rand(5, 90, generator=generator) < 0.7
    mask[0, 40:], mask[1, :40], mask[2, 3:] = False, False, False
    together = scene.estimate(mask=mask, max_iterations=1000)
    assert not (together.inliers & ~mask).any()
    for i in range(5):
        alone = replace(scene, **{name: getattr(scene, name)[i] for name in ("x", "X", "l", "ends", "wrong", "pose")})
        found = alone.estimate(mask=mask[i], max_iterations=1000)
        torch.testing.assert_close(found.model, together.model[i], rtol=1e-7, atol=1e-7)
        assert torch.equal(found.inliers, together.inliers[i])
        assert found.status == together.status[i]
    assert (together.status[[0, 1, 3, 4]] == Status.OK).all()


def test_bad_rows_count_for_nothing(generator: torch.Generator) -> None:
    scene = make(4, 30, 60, generator, 0.2)
    absent = torch.zeros(4, 90, dtype=torch.bool)
    absent[:, [3, 31, 33, 37, 41]] = True
    plain = scene.estimate(mask=~absent)
    x, l, L = scene.x.clone(), scene.l.clone(), scene.L.clone()  # noqa: E741
    x[:, 3] = torch.nan
    l[:, 1, 0, 1], L[:, 3, 4] = torch.inf, torch.nan
    l[:, 7, 1] = l[:, 7, 0]
    L[:, 11, 3:] += L[:, 11, :3]  # no line
    found = estimate_camera(x, scene.X, K, l, L, threshold=4.0, generator=seeded())
    assert not (found.inliers & absent).any()
    torch.testing.assert_close(found.model, plain.model, rtol=1e-4, atol=1e-5)
    L[0] = torch.nan
    x[0] = torch.inf
    spoiled = estimate_camera(x, scene.X, K, l, L, threshold=4.0, generator=seeded())
    assert spoiled.status[0] == Status.NOT_FINITE
    assert spoiled.model.isfinite().all()
    assert torch.equal(spoiled.model[1:], found.model[1:])


def test_what_determines_no_pose_is_told(generator: torch.Generator) -> None:
    kind = {"generator": generator, "dtype": F64}
    A = 4 * torch.rand(8, 60, 3, **kind) - 2
    along = torch.nn.functional.normalize(torch.randn(8, 1, 3, **kind), dim=-1)
    cases = {
        "parallel": (torch.stack((A, A + 2 * along), -2), Degeneracy.UNDETERMINED),
        "concurrent": (torch.stack((A, 0.3 * torch.randn(8, 1, 3, **kind).expand_as(A)), -2), Degeneracy.UNDETERMINED),
        # A plane that is seen from its edge tells less than a plane.
        "plane": (torch.stack((A, A.roll(1, -2)), -2) * torch.tensor([1.0, 1, 0], dtype=F64), Degeneracy.PLANAR),
    }
    for name, (ends, code) in cases.items():
        found = make(8, 0, 60, generator, 0.2, ends=ends).estimate(max_iterations=300)
        told = (found.degeneracy == code) | (found.degeneracy == Degeneracy.UNDETERMINED)
        assert (told | (found.status != Status.OK)).all(), (name, found.degeneracy, found.status)
    # Points on one line, and that line too.
    scene = make(8, 60, 30, generator, 0.1)
    span = torch.rand(8, 60, 1, **kind) * 4 - 2
    X, ends = span * along, (torch.tensor([-1.0, 1.0], dtype=F64)[:, None] * along[:, None]).expand(8, 30, 2, 3)
    line = make(8, 0, 30, generator, 0.1, ends=ends)
    collinear = replace(scene, x=project(X, line.pose), X=X, l=line.l, ends=ends).estimate(max_iterations=300)
    assert (collinear.status != Status.OK).all() | (collinear.degeneracy == Degeneracy.COLLINEAR).all()


def test_nonsense_is_told(generator: torch.Generator) -> None:
    result = make(40, 60, 60, generator, share=1.0).estimate(2.0, max_iterations=300)
    assert_share(result.status == Status.NO_CONSENSUS, 0.95)
    few = make(3, 1, 1, generator, 0.0).estimate()
    assert (few.status == Status.TOO_FEW).all()


def test_no_threshold_below_single_precision_makes_inliers(generator: torch.Generator) -> None:
    """In a focal length beyond measure all image points are one, but for what single precision does not see."""
    scene = make(60, 20, 12, generator, 0.0)
    far = torch.tensor([[8e10, 0, 5e10], [0, 8e10, 4e10], [0, 0, 1]], dtype=F64)
    found = estimate_camera(scene.x, scene.X, far, scene.l, scene.L, threshold=2.0, generator=seeded(), max_iterations=64)
    Y = scene.X @ found.model[..., :3].mT + found.model[..., None, :, 3]
    # From the principal point, so that nothing cancels.
    gap = ((far[:2, :2] @ (Y[..., :2] / Y[..., 2:])[..., None])[..., 0] - (scene.x - far[:2, 2])).norm(dim=-1)
    wrong = found.inliers[:, :20] & (gap > 2.1)
    assert not wrong[found.status == Status.OK].any()


def test_covariance_is_that_of_the_errors(generator: torch.Generator) -> None:
    scene = make(200, 30, 40, generator, 0.2)
    result = scene.estimate(5.0, covariance=True)
    good = result.status == Status.OK
    e = steps(scene.pose, result.model)[good]
    square = (e * torch.linalg.solve(result.covariance[good], e[..., None])[..., 0]).sum(-1)
    # Chi-squared of 6 but for the scatter of the covariance itself, estimated from some 50 data.
    assert 5 < square.mean() < 9


def test_derivatives(generator: torch.Generator) -> None:
    scene = make(1, 20, 20, generator, 0.1, 0.3)
    inputs = [t[0].clone().requires_grad_() for t in (scene.x, scene.X, scene.l, scene.L)]
    camera = K.clone().requires_grad_()

    def pose(x: Tensor, X: Tensor, l: Tensor, L: Tensor, k: Tensor) -> Tensor:  # noqa: E741
        return estimate_camera(x, X, k, l, L, threshold=3.0, generator=seeded()).model

    weights = torch.randn(3, 4, generator=generator, dtype=F64)
    (weights * pose(*inputs, camera)).sum().backward()
    size = 1e-5
    for i, t in enumerate((*inputs, camera)):
        assert t.grad is not None
        change = size * torch.randn(t.shape, generator=generator, dtype=F64)
        if i == 3:
            # Along the lines: d'm = 0 stays.
            ends = scene.ends[0] + size * torch.randn(scene.ends[0].shape, generator=generator, dtype=F64)
            change = pluecker_from_points(ends[:, 0], ends[:, 1]) - t.detach()
        elif i == 4:
            change = change * 100 * torch.tensor([[1.0, 0, 1], [0, 1, 1], [0, 0, 0]], dtype=F64)
        both = []
        for sign in (1, -1):
            moved = [v.detach() for v in (*inputs, camera)]
            moved[i] = moved[i] + sign * change
            both.append((weights * pose(*moved)).sum())
        expected = (both[0] - both[1]) / 2
        torch.testing.assert_close((t.grad * change).sum(), expected, rtol=2e-3, atol=1e-9)


@pytest.mark.usefixtures("unchecked")
def test_wrong_arguments(generator: torch.Generator) -> None:
    s = make(2, 10, 12, generator)
    for arguments, options, name in (
        ((s.l, None), {}, "l, L: wanted both"), ((None, s.L), {}, "l, L: wanted both"), ((s.l, s.L[:, 1:]), {}, "L: wanted"),
        ((s.l[..., 0], s.L), {}, "l: wanted"), ((s.l.float(), s.L), {}, "l: "),
        ((s.l, s.L), {"mask": torch.ones(2, 10, dtype=torch.bool)}, "mask: wanted 22"),
        ((s.l, s.L), {"weights": torch.ones(12, dtype=F64)}, "weights: wanted 22"),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=name):
            estimate_camera(s.x, s.X, K, *arguments, threshold=2.0, **options)


@pytest.mark.reference
def test_as_good_as_poselib(generator: torch.Generator) -> None:
    poselib = pytest.importorskip("poselib")
    scene = make(40, 60, 80, generator, 0.5)
    ours = turn(scene.estimate(4.0).model, scene.pose)
    camera = {"model": "PINHOLE", "width": 1000, "height": 800, "params": [800.0, 820, 500, 400]}
    theirs = []
    for i in range(40):
        pose, _ = poselib.estimate_absolute_pose_pnpl(
            scene.x[i].numpy(), scene.X[i].numpy(), *(scene.l[i, :, j].numpy() for j in (0, 1)),
            *(scene.ends[i, :, j].numpy() for j in (0, 1)), camera, {"max_reproj_error": 4.0}, {},
        )  # fmt: skip
        theirs.append(turn(torch.tensor(np.asarray(pose.Rt)), scene.pose[i]))
    assert ours.median() <= 1.1 * torch.stack(theirs).median()


def test_one_answer_where_noise_hides_which_minimum_is_the_lowest(data: Path, generator: torch.Generator) -> None:
    """A staircase: the pose one step away has as many inliers, and costs of samples that lead to both are alike."""
    file = np.load(data / "absolute_pose" / "stairs_points_lines" / "localization_test_data_stairs_1.npz")
    x, X, l, intrinsics = (torch.tensor(file[name].astype(np.float64)) for name in ("p2ds", "p3ds", "l2ds", "K"))  # noqa: E741
    ends = torch.tensor(file["l3ds"].astype(np.float64))[torch.tensor(file["l3d_ids"].astype(np.int64))]
    L = pluecker_from_points(ends[:, 0], ends[:, 1])
    i, j = (torch.rand(120, len(rows), generator=generator).argsort(1) for rows in (x, l))
    found = estimate_camera(x[i], X[i], intrinsics, l[j], L[j], threshold=12.0, generator=generator)
    assert_share(found.support > found.support.max() - 8, 0.97)
