import pytest
import torch
from chance import assert_share
from multiview_scenes import F64, K, cameras, images, points, up_to_scale
from torch import Tensor

from torchsfm.motion import trifocal_6pt
from torchsfm.motion.three_views.trifocal_6pt import equations
from torchsfm.tensors import canonical_cameras, transform_trifocal, trifocal_from_cameras

EYE = torch.eye(3, dtype=F64)
SCALE = torch.diag(torch.tensor([1 / 800, 1 / 800, 1.0], dtype=F64))


def scene(count: int, generator: torch.Generator, family: str = "random", calibration: Tensor = K) -> tuple[Tensor, Tensor]:
    """Images (count, 3, 6, 2) and the cameras."""
    P = cameras(count, v=3, generator=generator, calibration=calibration)
    X = points(count, n=6, generator=generator)
    if family == "near planar":
        X[..., 2] = 0.3 * X[..., 0] + 0.02 * X[..., 2]
    elif family == "sideways":
        P = P[:, :1].repeat(1, 3, 1, 1)
        P[:, 1:, :2, 3] += 400 * torch.randn(count, 2, 2, generator=generator, dtype=F64)
    elif family == "narrow":
        X = 0.1 * X
    return images(P, X), P


def error(model: Tensor, valid: Tensor, P: Tensor) -> Tensor:
    """Of the nearest solution, tensors compared in coordinates of moderate size."""
    found, truth = trifocal_from_cameras(*model.double().unbind(-3)), trifocal_from_cameras(*P.unbind(-3))
    found, truth = (transform_trifocal(T, SCALE, SCALE, SCALE) for T in (found, truth))
    return torch.where(valid, up_to_scale(found, truth[..., None, :, :, :], 3), torch.inf).amin(-1)


@pytest.mark.parametrize(
    ("family", "tolerance"), [("random", 1e-8), ("near planar", 1e-6), ("narrow", 1e-6), ("sideways", 1e-8)]
)
def test_recall(family: str, tolerance: float, generator: torch.Generator) -> None:
    x, P = scene(2000, generator, family)
    solutions = trifocal_6pt(x)
    assert solutions.model.shape == (2000, 3, 3, 3, 4)
    assert_share(error(solutions.model, solutions.valid, P) < tolerance, 0.999)
    single = trifocal_6pt(x.float())
    assert single.model.dtype == torch.float32
    if family == "random":
        assert_share(error(single.model, single.valid, P) < 1e-2, 0.98)


def test_the_frame_is_the_canonical_one(generator: torch.Generator) -> None:
    x, P = scene(500, generator)
    solutions = trifocal_6pt(x)
    gap = (solutions.model - canonical_cameras(P)[:, None]).flatten(2).abs().amax(-1)
    assert_share(torch.where(solutions.valid, gap, torch.inf).amin(-1) < 1e-6, 0.995)
    again = canonical_cameras(solutions.model)
    assert (again - solutions.model)[solutions.valid].abs().max() < 1e-8


def test_soundness_and_number_of_solutions(generator: torch.Generator) -> None:
    x, _ = scene(1000, generator, calibration=EYE)
    # Also samples that no scene gave.
    x[500:, 2] = torch.rand(500, 6, 2, generator=generator, dtype=F64) - 0.5
    solutions = trifocal_6pt(x)
    residual = equations(solutions.model, x[:, None]).abs().amax(-1)
    assert residual[solutions.valid].quantile(0.999) < 1e-9
    assert torch.isfinite(solutions.model).all()
    count = solutions.valid.sum(-1)
    assert_share((count == 1) | (count == 3), 0.999)
    assert 0.7 < (count[:500] == 3).double().mean() < 0.95
    # No two alike.
    T = trifocal_from_cameras(*solutions.model.unbind(-3))
    for i, j in ((0, 1), (0, 2), (1, 2)):
        both = solutions.valid[:, i] & solutions.valid[:, j]
        assert_share(up_to_scale(T[:, i], T[:, j], 3)[both] > 1e-7, 0.999)


@pytest.mark.parametrize("shape", [(), (1,), (2, 3), (0,)])
def test_batches_are_loops(shape: tuple[int, ...], generator: torch.Generator) -> None:
    x, _ = scene(6, generator)
    count = torch.Size(shape).numel()
    solutions = trifocal_6pt(x[:count].reshape(*shape, 3, 6, 2))
    assert solutions.model.shape == (*shape, 3, 3, 3, 4)
    assert solutions.valid.shape == (*shape, 3)
    for k, one in enumerate(solutions.model.reshape(-1, 3, 3, 3, 4)):
        assert torch.equal(trifocal_6pt(x[k]).model, one)


def test_chunks_do_not_show(generator: torch.Generator) -> None:
    x, _ = scene(50, generator)
    one = trifocal_6pt(x)
    assert torch.equal(trifocal_6pt(x.repeat(60, 1, 1, 1)).model, one.model.repeat(60, 1, 1, 1, 1))


def test_order_of_points_and_views_and_similarities(generator: torch.Generator) -> None:
    x, P = scene(300, generator)
    order = torch.randperm(6, generator=generator)
    turned = trifocal_6pt(x[:, :, order])
    assert_share(error(turned.model, turned.valid, P) < 1e-8, 0.995)
    views = trifocal_6pt(x[:, [2, 0, 1]])
    assert_share(error(views.model, views.valid, P[:, [2, 0, 1]]) < 1e-8, 0.995)
    S = torch.tensor([[0.0, -3, 1], [3, 0, -2], [0, 0, 1]], dtype=F64)
    moved = trifocal_6pt(x @ S[:2, :2].mT + S[:2, 2])
    back = torch.linalg.inv(S) @ moved.model
    assert_share(error(back, moved.valid, P) < 1e-8, 0.995)


def test_degenerate_samples_leave_neighbours_alone(generator: torch.Generator) -> None:
    x, _ = scene(10, generator)
    reference = trifocal_6pt(x)
    x[1] = x[1, :, :1]
    x[2, :, 1] = x[2, :, 0]
    x[3, 1, 2, 0] = torch.nan
    x[4, 2, 0, 1] = torch.inf
    x[5] = 0
    x[6, 0, :, 1] = 7.0
    x[7, :, 4] = x[7, :, 5]
    x.requires_grad_()
    solutions = trifocal_6pt(x)
    assert torch.isfinite(solutions.model).all()
    untouched = [0, 8, 9]
    assert torch.equal(solutions.model[untouched], reference.model[untouched])
    assert torch.equal(solutions.valid[untouched], reference.valid[untouched])
    assert not solutions.valid[1:8].any()
    solutions.model.sum().backward()
    assert x.grad is not None
    assert torch.isfinite(x.grad).all()


def test_points_of_a_plane_have_no_cameras(generator: torch.Generator) -> None:
    P = cameras(50, v=3, generator=generator)
    X = points(50, n=6, generator=generator)
    X[..., 2] = 0.3 * X[..., 0]
    assert not trifocal_6pt(images(P, X)).valid.any()
    # A camera that only turns sees one image three times.
    X = points(50, n=6, generator=generator)
    P = torch.cat((P[:, :1], K @ EYE @ torch.linalg.inv(K) @ P[:, :1], P[:, :1] * 2), 1)
    found = trifocal_6pt(images(P, X))
    assert torch.isfinite(found.model).all()
    assert not found.valid.any()


@pytest.mark.parametrize("mode", ["reverse", "forward"])
@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # torch's own, where its forward derivatives are first used
def test_derivatives(mode: str, generator: torch.Generator) -> None:
    x, _ = scene(1, generator, calibration=EYE)
    valid = trifocal_6pt(x).valid
    forward = mode == "forward"
    assert torch.autograd.gradcheck(
        lambda x: trifocal_6pt(x).model[valid], x.requires_grad_(), atol=1e-4, rtol=1e-3,
        check_forward_ad=forward, check_backward_ad=not forward, fast_mode=True,
    )  # fmt: skip


def test_derivatives_in_pixels(generator: torch.Generator) -> None:
    x, _ = scene(3, generator)
    solutions = trifocal_6pt(x.requires_grad_())
    first = solutions.valid.double().argmax(-1)
    d = torch.randn(x.shape, generator=generator, dtype=F64)
    h = 1e-4
    moved = [trifocal_6pt(x.detach() + s * h * d).model for s in (1, -1)]
    for k in range(3):
        slope = (moved[0] - moved[1])[k, first[k]] / (2 * h)
        weight = torch.randn(3, 3, 4, generator=generator, dtype=F64) * slope.abs().reciprocal().nan_to_num(0, 0, 0).clamp(
            max=1e6
        )
        (grad,) = torch.autograd.grad((solutions.model[k, first[k]] * weight).sum(), x, retain_graph=True)
        torch.testing.assert_close((grad[k] * d[k]).sum(), (slope * weight).sum(), rtol=1e-3, atol=1e-3)


def test_values_do_not_depend_on_gradients(generator: torch.Generator) -> None:
    x, _ = scene(20, generator)
    followed = trifocal_6pt(x.clone().requires_grad_())
    plain = trifocal_6pt(x)
    assert torch.equal(plain.model, followed.model)
    assert followed.model.requires_grad
    assert not plain.model.requires_grad


def test_wrong_arguments(unchecked: None) -> None:
    for bad in (torch.zeros(3, 5, 2), torch.zeros(2, 6, 2), torch.zeros(3, 6, 3), torch.zeros(3, 6, 2, dtype=torch.long)):
        with pytest.raises(ValueError, match="wanted"):
            trifocal_6pt(bad)
