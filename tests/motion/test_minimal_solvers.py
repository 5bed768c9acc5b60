"""The laws of the minimal two-view solvers, each against every solver."""

from collections.abc import Callable
from dataclasses import dataclass

import pytest
import torch
from chance import assert_share
from torch import Tensor
from two_view_scenes import F64, FAMILIES, distance, fundamental, pixels, two_views

from torchsfm._types import Solutions
from torchsfm.motion import essential_5pt, fundamental_7pt, homography_4pt
from torchsfm.motion.two_views.essential_5pt import equations as essential_equations
from torchsfm.motion.two_views.fundamental_7pt import equations as fundamental_equations
from torchsfm.motion.two_views.homography_4pt import equations as homography_equations
from torchsfm.tensors import poses_from_essential


@dataclass(frozen=True)
class Case:
    """A solver, its equations, and exact samples with the model they come from."""

    solve: Callable[[Tensor, Tensor], Solutions[Tensor]]
    equations: Callable[[Tensor, Tensor, Tensor], Tensor]
    size: int
    slots: int
    tolerance32: float

    def sample(self, family: str, count: int, generator: torch.Generator) -> tuple[Tensor, Tensor, Tensor]:
        if self.solve is homography_4pt:
            # Any four points and any homography without a line at infinity among them.
            x1 = torch.rand(count, 4, 2, dtype=F64, generator=generator) * 640
            H = torch.eye(3, dtype=F64) + torch.randn(count, 3, 3, dtype=F64, generator=generator) * torch.tensor(
                [[0.3, 0.3, 100], [0.3, 0.3, 100], [3e-4, 3e-4, 0.1]], dtype=F64
            )
            y = torch.nn.functional.pad(x1, (0, 1), value=1.0) @ H.mT
            return x1, y[..., :2] / y[..., 2:], H / H.norm(dim=(-2, -1), keepdim=True)
        X1, X2, E = two_views(family, count, self.size, generator)
        if self.solve is fundamental_7pt:
            return pixels(X1), pixels(X2), fundamental(E)
        return X1 / X1.norm(dim=-1, keepdim=True), X2 / X2.norm(dim=-1, keepdim=True), E


CASES = {
    "essential_5pt": Case(essential_5pt, essential_equations, 5, 10, 1e-3),
    "fundamental_7pt": Case(fundamental_7pt, fundamental_equations, 7, 3, 1e-2),
    "homography_4pt": Case(homography_4pt, homography_equations, 4, 1, 1e-2),
}


@pytest.fixture(params=CASES)
def case(request: pytest.FixtureRequest) -> Case:
    return CASES[request.param]


def test_recall_on_random_scenes(case: Case, generator: torch.Generator) -> None:
    x1, x2, truth = case.sample("random", 2000, generator)
    solutions = case.solve(x1, x2)
    assert solutions.model.shape == (2000, case.slots, 3, 3)
    assert_share(distance(solutions.model, solutions.valid, truth) < 1e-8, 0.999)
    single = case.solve(x1.float(), x2.float())
    assert single.model.dtype == torch.float32
    assert_share(distance(single.model, single.valid, truth) < case.tolerance32, 0.98)


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize("name", ["essential_5pt", "fundamental_7pt"])
def test_recall_on_hard_families(name: str, family: str, generator: torch.Generator) -> None:
    x1, x2, truth = CASES[name].sample(family, 2000, generator)
    solutions = CASES[name].solve(x1, x2)
    assert_share(distance(solutions.model, solutions.valid, truth) < 1e-6, 0.99)


def test_soundness(case: Case, generator: torch.Generator) -> None:
    for family in ("random", "near planar", "small baseline"):
        x1, x2, _ = case.sample(family, 300, generator)
        # Also samples that no scene could give.
        x2[150:] = x2[150:].flip(0).roll(1, 1)
        solutions = case.solve(x1, x2)
        residual = case.equations(solutions.model, x1[:, None], x2[:, None]).abs()
        # Points in pixels weigh the equations: judge relative to them.
        size = x1.abs().amax((-2, -1)).clamp_min(1) * x2.abs().amax((-2, -1)).clamp_min(1)
        relative = residual.amax(-1) / size[:, None]
        assert relative[solutions.valid].max() < 1e-8
        assert_share(solutions.valid.any(-1), 0.95)
        assert torch.isfinite(solutions.model).all()


def test_solutions_are_distinct(case: Case, generator: torch.Generator) -> None:
    x1, x2, _ = case.sample("random", 1000, generator)
    solutions = case.solve(x1, x2)
    unit = solutions.model.flatten(-2) / solutions.model.flatten(-2).norm(dim=-1, keepdim=True)
    gap = 1 - (unit[:, :, None] * unit[:, None]).sum(-1).abs()
    both = solutions.valid[:, :, None] & solutions.valid[:, None] & ~torch.eye(case.slots, dtype=torch.bool)
    assert_share(~((gap < 1e-14) & both).any(-1).any(-1), 0.995)


def test_no_solution_stands_twice_where_problems_are_solved_twice(generator: torch.Generator) -> None:
    d1, d2, truth = CASES["essential_5pt"].sample("tiny baseline", 2000, generator)
    solutions = essential_5pt(d1, d2)
    unit = solutions.model.flatten(-2) / 2**0.5
    gap = torch.minimum((unit[:, :, None] - unit[:, None]).norm(dim=-1), (unit[:, :, None] + unit[:, None]).norm(dim=-1))
    both = solutions.valid[:, :, None] & solutions.valid[:, None] & ~torch.eye(10, dtype=torch.bool)
    assert_share(~((gap < 1e-8) & both).any(-1).any(-1), 0.997)
    # Alone, and in a batch of which others are solved twice.
    for i in range(0, 2000, 250):
        alone = essential_5pt(d1[i], d2[i])
        assert torch.equal(alone.model, solutions.model[i])
        assert torch.equal(alone.valid, solutions.valid[i])
    assert_share(solutions.valid.sum(-1) >= 2, 0.99)
    assert_share(distance(solutions.model, solutions.valid, truth) < 1e-6, 0.98)


@pytest.mark.parametrize("name", ["essential_5pt", "fundamental_7pt"])
def test_two_solutions_are_found_until_they_merge(name: str, generator: torch.Generator) -> None:
    """Between two samples the number of solutions changes where two are one; a little before, both must be there."""
    case = CASES[name]
    a1, a2, _ = case.sample("random", 300, generator)
    b1, b2, _ = case.sample("random", 300, generator)

    def count(s: Tensor) -> Tensor:
        s = s[:, None, None]
        return case.solve(a1 + s * (b1 - a1), a2 + s * (b2 - a2)).valid.sum(-1)

    low, high = torch.zeros(300, dtype=F64), torch.full((300,), 0.05, dtype=F64)
    first = count(low)
    for _ in range(40):
        middle = 0.5 * (low + high)
        same = count(middle) == first
        low, high = torch.where(same, middle, low), torch.where(same, high, middle)
    before, after = count(low), count(high)
    change = (before - after).abs() == 2
    assert change.sum() > 20
    for step in (1e-6, 1e-8):
        near = count(torch.where(before > after, low - step, high + step))
        assert_share((near >= torch.maximum(before, after))[change], 0.95)


@pytest.mark.parametrize("shape", [(), (1,), (2, 3), (0,), (4, 0)])
def test_batch_shapes(case: Case, shape: tuple[int, ...], generator: torch.Generator) -> None:
    x1, x2, _ = case.sample("random", 6, generator)
    count = torch.Size(shape).numel()
    solutions = case.solve(x1[:count].reshape(*shape, *x1.shape[1:]), x2[:count].reshape(*shape, *x2.shape[1:]))
    assert solutions.model.shape == (*shape, case.slots, 3, 3)
    assert solutions.valid.shape == (*shape, case.slots)
    reference = case.solve(x1, x2)
    assert torch.equal(solutions.model.reshape(-1, case.slots, 3, 3), reference.model[:count])


def test_batch_equals_loop_bit_for_bit(case: Case, generator: torch.Generator) -> None:
    x1, x2, _ = case.sample("near planar", 41, generator)
    x1, x2 = torch.cat((x1, x1.flip(0))), torch.cat((x2, x2.flip(0) + 0.01))
    solutions = case.solve(x1, x2)
    for i in range(0, 82, 3):
        one = case.solve(x1[i], x2[i])
        assert torch.equal(one.model, solutions.model[i])
        assert torch.equal(one.valid, solutions.valid[i])
    some = torch.arange(5, 70, 7)
    assert torch.equal(case.solve(x1[some], x2[some]).model, solutions.model[some])


def test_chunks_do_not_show(case: Case, generator: torch.Generator) -> None:
    x1, x2, _ = case.sample("random", 60, generator)
    many = case.solve(x1.repeat(80, 1, 1), x2.repeat(80, 1, 1))
    one = case.solve(x1, x2)
    assert torch.equal(many.model, one.model.repeat(80, 1, 1, 1))
    assert torch.equal(many.valid, one.valid.repeat(80, 1))


def test_broadcasting(case: Case, generator: torch.Generator) -> None:
    x1, x2, _ = case.sample("random", 4, generator)
    solutions = case.solve(x1[:, None], x2[None, :2])
    assert solutions.model.shape == (4, 2, case.slots, 3, 3)
    assert torch.equal(solutions.model[1, 1], case.solve(x1[1], x2[1]).model)


def test_inputs_are_left_alone_and_may_be_strided(case: Case, generator: torch.Generator) -> None:
    x1, x2, _ = case.sample("random", 12, generator)
    copies = x1.clone(), x2.clone()
    reference = case.solve(x1, x2)
    strided = case.solve(x1.mT.contiguous().mT, x2.repeat_interleave(2, 0)[::2])
    assert torch.equal(strided.model, reference.model)
    assert torch.equal(x1, copies[0])
    assert torch.equal(x2, copies[1])


def test_degenerate_samples_leave_neighbours_alone(case: Case, generator: torch.Generator) -> None:
    x1, x2, _ = case.sample("random", 14, generator)
    reference = case.solve(x1, x2)
    x1[1], x2[1] = x1[1, :1], x2[1, :1]  # one point
    x1[2, 1], x2[2, 1] = x1[2, 0], x2[2, 0]  # a point twice
    x1[3, 2, 0] = float("nan")
    x2[4, 0, 1] = float("inf")
    x1[5] = 0
    x2[6, :, 0] = x2[6, :1, 0]  # a line, or a plane through the centre
    x2[7] = x1[7]  # no motion
    x1[8], x2[8] = 1e300 * x1[8], 1e-300 * x2[8]
    x1[9, 3], x2[9] = float("-inf"), float("nan")
    x1.requires_grad_()
    solutions = case.solve(x1, x2)
    assert torch.isfinite(solutions.model).all()
    untouched = [0, 10, 11, 12, 13]
    assert torch.equal(solutions.model[untouched], reference.model[untouched])
    assert torch.equal(solutions.valid[untouched], reference.valid[untouched])
    assert not solutions.valid[[1, 2, 3, 4, 5, 9]].any()
    solutions.model.sum().backward()
    assert x1.grad is not None
    assert torch.isfinite(x1.grad).all()


def test_planar_points_and_pure_rotation_have_no_fundamental_matrix(generator: torch.Generator) -> None:
    case = CASES["homography_4pt"]
    _, _, H = case.sample("random", 50, generator)
    x1 = torch.rand(50, 7, 2, dtype=F64, generator=generator)
    y = torch.nn.functional.pad(x1 * 640, (0, 1), value=1.0) @ H.mT
    x2 = y[..., :2] / y[..., 2:]
    assert not fundamental_7pt(x1 * 640, x2).valid.any()
    # With one point off the plane still five equations or six, with two the seven are independent.
    for off, wanted in ((1, False), (2, True)):
        moved = x2.clone()
        moved[:, :off] += 20 * torch.rand(50, off, 2, dtype=F64, generator=generator) + 5
        assert_share(fundamental_7pt(x1 * 640, moved).valid.any(-1) == wanted, 0.97)


def test_collinear_points_have_no_homography(generator: torch.Generator) -> None:
    x1, x2, _ = CASES["homography_4pt"].sample("random", 40, generator)
    for line in ((0, 1, 2), (1, 2, 3), (0, 2, 3)):
        y = x1.clone()
        y[:, line[2]] = 0.3 * y[:, line[0]] + 0.7 * y[:, line[1]]
        assert not homography_4pt(y, x2).valid.any()
        assert not homography_4pt(x2, y).valid.any()


def test_permutation_of_the_points(case: Case, generator: torch.Generator) -> None:
    x1, x2, truth = case.sample("random", 300, generator)
    order = torch.randperm(case.size, generator=generator)
    a, b = case.solve(x1, x2), case.solve(x1[:, order], x2[:, order])
    assert_share(a.valid.sum(-1) == b.valid.sum(-1), 0.99)
    gap = torch.stack([distance(b.model, b.valid, a.model[:, i]) for i in range(case.slots)], -1)
    assert_share((gap < 1e-6)[a.valid], 0.99)
    assert_share(distance(b.model, b.valid, truth) < 1e-8, 0.99)


def test_swapping_the_views(case: Case, generator: torch.Generator) -> None:
    x1, x2, truth = case.sample("random", 300, generator)
    swapped = torch.linalg.inv(truth) if case.solve is homography_4pt else truth.mT
    solutions = case.solve(x2, x1)
    assert_share(distance(solutions.model, solutions.valid, swapped) < 1e-8, 0.99)


def test_similarities_of_the_images(case: Case, generator: torch.Generator) -> None:
    x1, x2, truth = case.sample("random", 300, generator)
    if case.solve is essential_5pt:
        # Rays of any length, cameras turned.
        length = 10 ** torch.randn(300, 5, 1, dtype=F64, generator=generator)
        Q = torch.linalg.qr(torch.randn(2, 3, 3, dtype=F64, generator=generator)).Q
        Q = Q * torch.linalg.det(Q)[:, None, None]
        solutions = case.solve(x1 * length @ Q[0], -x2 @ Q[1])
        expected = Q[1].mT @ truth @ Q[0]
    else:
        T = torch.tensor([[0.0, -3e-3, 1], [3e-3, 0, -2], [0, 0, 1]], dtype=F64)
        S = torch.tensor([[5.0, 0, 4000], [0, 5, 3000], [0, 0, 1]], dtype=F64)
        solutions = case.solve(x1 @ T[:2, :2].mT + T[:2, 2], x2 @ S[:2, :2].mT + S[:2, 2])
        back, forth = torch.linalg.inv(S), torch.linalg.inv(T)
        expected = (S if case.solve is homography_4pt else back.mT) @ truth @ forth
    assert_share(distance(solutions.model, solutions.valid, expected) < 1e-7, 0.99)


def test_rays_all_around(generator: torch.Generator) -> None:
    X = torch.randn(1000, 5, 3, dtype=F64, generator=generator) * 4
    _, _, E = two_views("random", 1000, 5, generator)
    pose = poses_from_essential(E).model[:, 0]
    solutions = essential_5pt(X, X @ pose[..., :3].mT + pose[:, None, :, 3])
    assert_share(distance(solutions.model, solutions.valid, E) < 1e-8, 0.998)


def gaps(a: Tensor, b: Tensor) -> Tensor:
    """Between all matrices of the slots of one and of the other."""
    return (a[:, :, None] - b[:, None]).flatten(-2).norm(dim=-1)


@pytest.mark.parametrize("mode", ["reverse", "forward"])
@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # torch's own, where its forward derivatives are first used
def test_derivatives_of_valid_slots(case: Case, mode: str, generator: torch.Generator) -> None:
    x1, x2, _ = case.sample("random", 1 if case.solve is essential_5pt else 2, generator)
    if case.solve is not essential_5pt:
        x1, x2 = x1 / 640 - 0.5, x2 / 640 - 0.5
    base = case.solve(x1, x2)
    # Differences say nothing of a solution that moves much faster than the data, as where two solutions almost meet.
    moved = case.solve(x1 + 1e-6 * torch.randn(x1.shape, dtype=F64, generator=generator), x2)
    checked = base.valid & (gaps(base.model, moved.model).amin(-1) < 5e-4)
    assert checked.any()

    def following(x1: Tensor, x2: Tensor) -> Tensor:
        # Slots have no order that small changes keep: each of the first solutions is followed to the nearest one.
        model = case.solve(x1, x2).model
        nearest = gaps(base.model, model.detach()).argmin(-1)
        return model.gather(1, nearest[..., None, None].expand_as(model))[checked]

    inputs = (x1.requires_grad_(), x2.requires_grad_())
    forward = mode == "forward"
    assert torch.autograd.gradcheck(
        following, inputs, atol=1e-4, rtol=1e-3, check_forward_ad=forward, check_backward_ad=not forward
    )


def test_values_do_not_depend_on_gradients(case: Case, generator: torch.Generator) -> None:
    x1, x2, _ = case.sample("random", 20, generator)
    plain = case.solve(x1, x2)
    followed = case.solve(x1.clone().requires_grad_(), x2)
    assert torch.equal(plain.model, followed.model)
    assert followed.model.requires_grad
    assert not plain.model.requires_grad
    with torch.no_grad():
        assert not case.solve(x1.clone().requires_grad_(), x2).model.requires_grad


def test_wrong_arguments(case: Case, unchecked: None) -> None:
    width = 3 if case.solve is essential_5pt else 2
    good = torch.zeros(case.size, width)
    for bad in (
        torch.zeros(case.size + 1, width),
        torch.zeros(case.size, width + 1),
        good.long(),
        good.double(),
        good.tolist(),
    ):
        with pytest.raises(ValueError, match="wanted"):
            case.solve(good, bad)
    with pytest.raises(ValueError, match="broadcast"):
        case.solve(good.expand(2, -1, -1), good.expand(3, -1, -1))


@pytest.mark.reference
def test_every_solution_of_poselib_is_found(generator: torch.Generator) -> None:
    poselib = pytest.importorskip("poselib")
    case = CASES["essential_5pt"]
    d1, d2, _ = case.sample("random", 200, generator)
    ours = case.solve(d1, d2)
    complete, total = torch.ones(200, dtype=torch.bool), 0
    for i in range(200):
        for E in poselib.essential_matrix_5pt(d1[i].numpy(), d2[i].numpy()):
            E = torch.from_numpy(E) * (2**0.5 / torch.from_numpy(E).norm())
            if case.equations(E, d1[i], d2[i]).abs().max() < 1e-9:
                total += 1
                complete[i] &= distance(ours.model[i], ours.valid[i], E) < 1e-5
    assert total > 700
    # Solutions come in pairs, and go so.
    assert_share(complete, 0.9995)


@pytest.mark.reference
def test_as_many_solutions_as_poselib(generator: torch.Generator) -> None:
    poselib = pytest.importorskip("poselib")
    d1, d2, _ = CASES["essential_5pt"].sample("random", 1000, generator)
    ours = essential_5pt(d1, d2).valid.sum(-1)
    theirs = torch.tensor([len(poselib.essential_matrix_5pt(a, b)) for a, b in zip(d1.numpy(), d2.numpy(), strict=True)])
    assert_share(ours == theirs, 0.99)
    assert abs(ours.double().mean() - theirs.double().mean()) < 0.02


@pytest.mark.reference
def test_fundamental_and_homography_against_opencv(generator: torch.Generator) -> None:
    cv2 = pytest.importorskip("cv2")
    x1, x2, _ = CASES["fundamental_7pt"].sample("random", 50, generator)
    ours, gaps = fundamental_7pt(x1, x2), []
    for i in range(50):
        theirs, _ = cv2.findFundamentalMat(x1[i].numpy(), x2[i].numpy(), cv2.FM_7POINT)
        gaps += [distance(ours.model[i], ours.valid[i], F) for F in torch.from_numpy(theirs).reshape(-1, 3, 3)]
    x1, x2, _ = CASES["homography_4pt"].sample("random", 50, generator)
    found = homography_4pt(x1, x2)
    for i in range(50):
        H, _ = cv2.findHomography(x1[i].numpy(), x2[i].numpy())
        gaps.append(distance(found.model[i], found.valid[i], torch.from_numpy(H)))
    # OpenCV computes in single precision, which badly placed points do not bear.
    assert_share(torch.stack(gaps) < 1e-3, 0.98)


def test_a_homography_of_which_rounding_leaves_no_digits_is_none() -> None:
    """Two points a hundred pixels apart, seen from two that are 5e14 away."""
    x1 = torch.tensor([[585.85, 208.76], [551.40, 327.53], [5.48622403e14, 4.32709795e14], [4.73781626e14, 4.8768918e14]])
    x2 = torch.tensor([[438.5, 120.5], [417.0, 217.3], [419.9, 303.3], [359.9, 355.6]])
    assert not homography_4pt(x1.double(), x2.double()).valid.any()
