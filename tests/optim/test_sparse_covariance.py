import dataclasses

import pytest
import torch
from torch import Tensor

from torchsfm.optim import (
    Block,
    SoftL1,
    Subset,
    Term,
    UnitSphere,
    marginal_covariance,
    sparse_covariance,
    sparse_levenberg_marquardt,
)

F64 = torch.float64


def problem(generator: torch.Generator) -> tuple[dict[str, Block], list[Term]]:
    """Distances between landmarks in the plane and stations: three dimensions of gauge (place and turn)."""
    station = torch.randn(7, 2, generator=generator, dtype=F64) * 3
    mark = torch.randn(15, 2, generator=generator, dtype=F64) * 3
    i, j = torch.cartesian_prod(torch.arange(7), torch.arange(15)).T
    draw = torch.rand(7, 15, generator=generator)
    # Four stations see every mark at least: one of them determines none, and two leave it on either side of their line.
    keep = (draw < draw.sort(0).values[4].clamp(min=0.7)).flatten()
    i, j = i[keep], j[keep]
    d = (station[i] - mark[j]).norm(dim=1, keepdim=True)

    def distance(s: Tensor, m: Tensor, d: Tensor) -> Tensor:
        return ((s - m).square().sum(1, keepdim=True).sqrt() - d) / 0.01

    blocks = {"station": Block(station), "mark": Block(mark)}
    return blocks, [Term(distance, ("station", "mark"), (i, j), (d,))]


def dense_jacobian(blocks: dict[str, Block], terms: list[Term]) -> Tensor:
    def stacked(z: Tensor) -> Tensor:
        x = {"station": z[:14].view(7, 2), "mark": z[14:].view(15, 2)}
        return torch.cat(
            [t.residual(*(x[n][i] for n, i in zip(t.blocks, t.index, strict=True)), *t.data).flatten() for t in terms]
        )

    return torch.func.jacrev(stacked)(torch.cat([b.x.flatten() for b in blocks.values()]))


def test_with_a_fixed_gauge_it_is_the_inverse(generator: torch.Generator) -> None:
    blocks, terms = problem(generator)
    fixed = torch.tensor([True, True] + [False] * 5)
    blocks["station"] = dataclasses.replace(blocks["station"], fixed=fixed)
    found = sparse_covariance(blocks, terms, eliminate="mark")
    assert found.nullity == 0
    jacobian = dense_jacobian(blocks, terms)[:, 4:]
    reference = torch.linalg.inv(jacobian.T @ jacobian)
    torch.testing.assert_close(found.joint, reference[:10, :10], rtol=1e-7, atol=1e-12)
    for k in range(5):
        torch.testing.assert_close(found.blocks["station"][2 + k], reference[2 * k : 2 * k + 2, 2 * k : 2 * k + 2])
    for k in range(15):
        at = slice(10 + 2 * k, 12 + 2 * k)
        torch.testing.assert_close(found.blocks["mark"][k], reference[at, at], rtol=1e-7, atol=1e-12)
    assert (found.blocks["station"][:2] == 0).all()
    assert found.redundancy == len(terms[0].index[0]) - 40
    kept = sparse_covariance(blocks, terms)
    torch.testing.assert_close(kept.blocks["mark"], found.blocks["mark"], rtol=1e-7, atol=1e-12)


def test_free_gauge(generator: torch.Generator) -> None:
    """What does not depend on the gauge has the covariance it has in any gauge."""
    blocks, terms = problem(generator)
    free = sparse_covariance(blocks, terms, eliminate="mark")
    assert free.nullity == 3
    fixed = torch.zeros(7, dtype=torch.bool)
    fixed[0] = True
    # Station 0 in place, station 1 on a line through it.
    x = blocks["station"].x
    direction = (x[1] - x[0]) / (x[1] - x[0]).norm()
    onto = Term(
        lambda s, d, o: 1e6 * ((s - o) * d).sum(1, keepdim=True),
        ("station",),
        (torch.tensor([1]),),
        (torch.stack((-direction[1], direction[0]))[None], x[1:2]),
    )
    held = sparse_covariance(blocks | {"station": Block(x, None, fixed)}, [*terms, onto], eliminate="mark")

    def length_variance(joint: Tensor, columns: Tensor, a: int, b: int) -> Tensor:
        slope = joint.new_zeros(len(joint) + 1)
        unit = (x[a] - x[b]) / (x[a] - x[b]).norm()
        slope[columns[a]] += unit
        slope[columns[b]] -= unit
        slope = slope[:-1] if (columns[b] >= 0).all() else torch.where(torch.arange(len(slope)) == len(joint), 0.0, slope)[:-1]
        return slope @ joint @ slope

    for a, b in ((2, 3), (4, 6), (5, 2)):
        one = length_variance(free.joint, free.columns["station"], a, b)
        two = length_variance(held.joint, held.columns["station"], a, b)
        torch.testing.assert_close(one, two, rtol=1e-5, atol=0)


def test_undetermined_and_unobserved(generator: torch.Generator) -> None:
    blocks, terms = problem(generator)
    j = terms[0].index[1]
    keep = ((j != 3) | (torch.cumsum(j == 3, 0) <= 1)) & (j != 4)
    terms = [terms[0].select(keep.nonzero()[:, 0])]
    fixed = torch.tensor([True, True] + [False] * 5)
    blocks["station"] = dataclasses.replace(blocks["station"], fixed=fixed)
    found = sparse_covariance(blocks, terms, eliminate="mark")
    assert found.determined["mark"].tolist() == [k not in (3, 4) for k in range(15)]
    assert (found.blocks["mark"][3:5].diagonal(dim1=1, dim2=2) == torch.inf).all()
    others = found.blocks["mark"][[k for k in range(15) if k not in (3, 4)]]
    assert others.isfinite().all()
    without = [terms[0].select((terms[0].index[1] != 3).nonzero()[:, 0])]
    torch.testing.assert_close(found.joint, sparse_covariance(blocks, without, eliminate="mark").joint, rtol=1e-5, atol=1e-9)


def test_monte_carlo(generator: torch.Generator) -> None:
    blocks, terms = problem(generator)
    fixed = torch.tensor([True, True] + [False] * 5)
    blocks["station"] = dataclasses.replace(blocks["station"], fixed=fixed)
    covariance = sparse_covariance(blocks, terms, eliminate="mark").blocks["mark"]
    errors = []
    for _ in range(80):
        noisy = terms[0].data[0] + 0.01 * torch.randn(terms[0].data[0].shape, generator=generator, dtype=F64)
        result = sparse_levenberg_marquardt(blocks, [dataclasses.replace(terms[0], data=(noisy,))], eliminate="mark")
        errors.append(result.x["mark"] - blocks["mark"].x)
    error = torch.stack(errors)
    chi2 = (error[..., None, :] @ torch.linalg.solve(covariance, error[..., None])).mean() / 2
    assert 0.9 < chi2 < 1.1


class TestDerivative:
    """The derivative of the minimum against central differences."""

    @staticmethod
    def compare(function: object, inputs: tuple[Tensor, ...], generator: torch.Generator, rtol: float = 1e-4) -> None:
        leaves = tuple(v.clone().requires_grad_() for v in inputs)
        value = function(*leaves)
        gradients = torch.autograd.grad(value, leaves)
        for k, gradient in enumerate(gradients):
            step = 1e-5 * torch.randn(inputs[k].shape, generator=generator, dtype=F64) * inputs[k].abs().mean()
            plus, minus = (function(*(v + s * step if k == n else v for n, v in enumerate(inputs))) for s in (1, -1))
            numeric = (plus - minus) / 2
            assert numeric.abs() > 0
            # By chance the terms may nearly cancel: their sum is measured by what it would be with signs drawn by lot.
            assert ((gradient * step).sum() - numeric).abs() < rtol * (gradient * step).norm()

    @pytest.mark.parametrize("loss", [None, SoftL1(1.0)])
    def test_data_weights_and_fixed_variables(self, generator: torch.Generator, loss: object) -> None:
        blocks, terms = problem(generator)
        fixed = torch.tensor([True, True] + [False] * 5)
        d = terms[0].data[0] + 0.05 * torch.randn(terms[0].data[0].shape, generator=generator, dtype=F64)
        weights = 0.5 + torch.rand(len(d), generator=generator, dtype=F64)
        away = torch.randn(22, 2, generator=generator, dtype=F64)

        def function(d: Tensor, weights: Tensor, station: Tensor) -> Tensor:
            moved = blocks | {"station": Block(station, None, fixed)}
            term = dataclasses.replace(terms[0], data=(d,), weights=weights, loss=loss)
            result = sparse_levenberg_marquardt(
                moved, [term], eliminate="mark", function_tolerance=1e-19, step_tolerance=1e-14, max_iterations=200
            )
            return (torch.cat((result.x["station"], result.x["mark"])) * away).sum()

        # Start where it ends, so that all converge to the same place; only the fixed stations' values matter.
        term = dataclasses.replace(terms[0], data=(d,), weights=weights, loss=loss)
        start = sparse_levenberg_marquardt(
            blocks | {"station": Block(blocks["station"].x, None, fixed)}, [term], eliminate="mark", function_tolerance=1e-15
        )
        blocks["mark"] = Block(start.x["mark"])
        self.compare(function, (d, weights, start.x["station"]), generator)
        gradient = torch.autograd.grad(function(d, weights, s := start.x["station"].requires_grad_()), s)[0]
        assert (gradient[2:] == 0).all()

    def test_free_gauge_and_residuals(self, generator: torch.Generator) -> None:
        blocks, terms = problem(generator)
        d = terms[0].data[0] + 0.05 * torch.randn(terms[0].data[0].shape, generator=generator, dtype=F64)

        def function(d: Tensor) -> Tensor:
            result = sparse_levenberg_marquardt(
                blocks, [dataclasses.replace(terms[0], data=(d,))], eliminate="mark", function_tolerance=1e-15
            )
            lengths = (result.x["station"][:3] - result.x["mark"][4:7]).norm(dim=1)
            return (lengths * torch.tensor([1.0, -2.0, 0.5])).sum() + result.residuals[0][::7].sum() / 100

        self.compare(function, (d,), generator)

    def test_gauss_newton_is_near(self, generator: torch.Generator) -> None:
        blocks, terms = problem(generator)
        d = (terms[0].data[0] + 0.01 * torch.randn(terms[0].data[0].shape, generator=generator, dtype=F64)).requires_grad_()
        gradients = []
        for hessian in ("exact", "gauss-newton"):
            result = sparse_levenberg_marquardt(
                blocks, [dataclasses.replace(terms[0], data=(d,))], eliminate="mark", function_tolerance=1e-13, hessian=hessian
            )
            length = (result.x["station"][0] - result.x["station"][5]).norm()
            gradients.append(torch.autograd.grad(length, d)[0])
        difference = (gradients[0] - gradients[1]).norm() / gradients[0].norm()
        assert 1e-9 < difference < 0.05

    def test_costs_nothing_and_bad_rows_hand_back_zero(self, generator: torch.Generator) -> None:
        blocks, terms = problem(generator)
        d = terms[0].data[0].clone()
        d[4] = torch.nan
        plain = sparse_levenberg_marquardt(blocks, [dataclasses.replace(terms[0], data=(d,))], eliminate="mark")
        assert not plain.x["mark"].requires_grad
        leaf = d.clone().requires_grad_()
        with torch.no_grad():
            quiet = sparse_levenberg_marquardt(blocks, [dataclasses.replace(terms[0], data=(leaf,))], eliminate="mark")
        assert not quiet.x["mark"].requires_grad
        followed = sparse_levenberg_marquardt(blocks, [dataclasses.replace(terms[0], data=(leaf,))], eliminate="mark")
        assert torch.equal(followed.x["mark"], plain.x["mark"])
        (gradient,) = torch.autograd.grad((followed.x["mark"][0] - followed.x["mark"][1]).norm(), leaf)
        assert gradient.isfinite().all()
        assert gradient[4] == 0

    def test_manifolds_and_nothing_eliminated(self, generator: torch.Generator) -> None:
        """A mean direction, and a line whose slope alone is free."""
        start = torch.tensor([[0.0, 0.0, 1.0]], dtype=F64)
        directions = torch.nn.functional.normalize(torch.randn(9, 3, generator=generator, dtype=F64) + 3 * start, dim=1)
        y = torch.randn(9, 1, generator=generator, dtype=F64)
        t = torch.arange(9, dtype=F64)[:, None]

        def function(directions: Tensor, y: Tensor) -> Tensor:
            line = torch.tensor([[0.3, 0.1]], dtype=F64)
            blocks = {"mean": Block(start, UnitSphere(3)), "line": Block(line, Subset(2, (1,)))}
            zero = torch.zeros(9, dtype=torch.long)
            terms = [
                Term(lambda m, d: torch.linalg.cross(m, d), ("mean",), (zero,), (directions,)),
                Term(lambda p, t, y: p[:, :1] + p[:, 1:] * t - y, ("line",), (zero,), (t, y)),
            ]
            result = sparse_levenberg_marquardt(blocks, terms, function_tolerance=0.0, max_iterations=100)
            return result.x["mean"][0] @ torch.tensor([1.0, 2.0, 3.0], dtype=F64) + result.x["line"][0, 1]

        self.compare(function, (directions, y), generator)


def test_what_is_known_of_differences_alone_has_no_covariance() -> None:
    """The information has a pivot that is exactly zero."""
    index = torch.tensor([0]), torch.tensor([1])
    term = Term(lambda a, b, z: b - a - z, ("p", "p"), index, (torch.ones(1, 1, dtype=F64),))
    found = marginal_covariance({"p": Block(torch.zeros(2, 1, dtype=F64))}, [term], "p")
    assert bool((found == torch.inf).all())
