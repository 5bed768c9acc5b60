import pytest
import torch
from chance import assert_share

from torchsfm.linalg.elimination import least_squares_rows
from torchsfm.linalg.quadric_intersection import intersect_quadrics
from torchsfm.linalg.quaternary_forms import CUBIC, QUADRATIC, cubic_of_forms, product_of_forms

F64 = torch.float64


def values(q, v):
    """The form at points (4, n), by its definition."""
    monomials = QUADRATIC if len(q) == 10 else CUBIC
    return sum(c * v[list(m)].prod(0) for c, m in zip(q, monomials, strict=True))


def forms_through(v, size, generator):
    """Random forms that are zero at v."""
    monomials = QUADRATIC if size == 10 else CUBIC
    m = torch.stack([v[list(k)].prod(0) for k in monomials])
    q = torch.randn(size, v.shape[1], generator=generator, dtype=F64)
    return q - m * (q * m).sum(0) / (m * m).sum(0)


@pytest.mark.parametrize(("size", "most"), [(10, 8), (20, 12)])
def test_known_points_are_found(generator, size, most):
    v = torch.randn(4, 3000, generator=generator, dtype=F64)
    v = v / v.norm(dim=0)
    A, B, C = (forms_through(v, k, generator) for k in (10, 10, size))
    item, found = intersect_quadrics(A, B, C)
    assert torch.equal(item, item.sort().values)
    assert torch.bincount(item).max() <= most
    for q in (A, B, C):
        assert (values(q[:, item], found).abs() < 1e-9 * q[:, item].abs().amax(0)).all()
    gap = torch.minimum((found - v[:, item]).norm(dim=0), (found + v[:, item]).norm(dim=0))
    nearest = torch.full((3000,), torch.inf, dtype=F64).scatter_reduce(0, item, gap, "amin")
    assert_share(nearest < 1e-8, 0.999)
    # Real points come in pairs.
    assert_share(torch.bincount(item, minlength=3000) % 2 == 0, 0.995)


def test_products_of_forms(generator):
    a, b, c, v = torch.randn(4, 4, 7, generator=generator, dtype=F64)
    square = product_of_forms(a, b)
    torch.testing.assert_close(values(square, v), (a * v).sum(0) * (b * v).sum(0))
    torch.testing.assert_close(values(cubic_of_forms(square, c), v), (a * v).sum(0) * (b * v).sum(0) * (c * v).sum(0))


def test_bad_forms_have_no_points_and_touch_no_other(generator):
    v = torch.randn(4, 20, generator=generator, dtype=F64)
    forms = [forms_through(v, 10, generator) for _ in range(3)]
    good = intersect_quadrics(*forms)
    forms[0][:, 3] = torch.nan
    forms[1][2, 5] = torch.inf
    forms[2][:, 7] = 0
    item, found = intersect_quadrics(*forms)
    assert not torch.isin(item, torch.tensor([3, 5])).any()
    assert found.isfinite().all()
    untouched = ~torch.isin(item, torch.tensor([3, 5, 7]))
    before = ~torch.isin(good.item, torch.tensor([3, 5, 7]))
    assert torch.equal(item[untouched], good.item[before])
    assert torch.equal(found[:, untouched], good.point[:, before])
    assert len(intersect_quadrics(*(f[:, :0] for f in forms)).item) == 0


def test_least_squares_of_rows(generator):
    J, r = torch.randn(8, 5, 30, generator=generator, dtype=F64), torch.randn(8, 30, generator=generator, dtype=F64)
    J[:, 2] *= 1e6
    wanted = torch.linalg.lstsq(J.permute(2, 0, 1), r.T[..., None]).solution[..., 0].T
    torch.testing.assert_close(least_squares_rows(J, r), wanted, rtol=1e-8, atol=1e-12)
