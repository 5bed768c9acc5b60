"""The second derivatives of reprojection that are written out are those of the cost."""

import dataclasses

import pytest
import torch
from structure_scenes import LENSES

from torchsfm.bundle import Rig
from torchsfm.bundle.blocks import Bundle
from torchsfm.geometry import BundleProblem, Camera, Pose, intrinsics
from torchsfm.optim import Block, Cauchy, Loss, Term
from torchsfm.optim.curvature import curvature
from torchsfm.optim.terms import prepare
from torchsfm.simulation import random_bundle_problem

F64 = torch.float64


def point_term(
    lens: str, rigged: bool, loss: Loss | None, generator: torch.Generator, **held: torch.Tensor
) -> tuple[dict[str, Block], Term]:
    """Reprojection with every number free, off its minimum; two cameras where there is no rig."""
    problem = random_bundle_problem(6, 12, 40, noise=1.0, generator=generator).problem
    c = torch.tensor([[499.5, 374.5], [510.0, 380.0]], dtype=F64)[: 2 - rigged]
    distortion = LENSES[lens]()
    some = dataclasses.replace(
        distortion, **{name: getattr(distortion, name).expand(len(c)) for name in distortion.parameter_names}
    )  # fmt: skip
    cameras = Camera(intrinsics(torch.full((len(c),), 900.0, dtype=F64), c), some)
    view = torch.arange(6)
    problem = BundleProblem(problem.poses, cameras, view % len(c), problem.X, problem.x, problem.view, problem.point)
    sensors = Pose.identity(2, dtype=F64).retract(0.1 * torch.randn(2, 6, generator=generator, dtype=F64))
    rig = Rig(sensors, view % 2, view) if rigged else None
    names = ("focal", "aspect", "skew", "principal_point", *distortion.parameter_names)
    weights = 0.5 + torch.rand(len(problem.x), generator=generator, dtype=F64)
    bundle = Bundle(problem, free=names, rig=rig, loss=loss, weights=weights, fixed_intrinsics=held or None)
    blocks, (term, *_), _ = prepare(*bundle.problem())
    return blocks, term


def compare(blocks: dict[str, Block], term: Term, wanted: list[bool], eliminated: str) -> None:
    assert term.bend is not None
    # Residuals that share all retained variables come to one place.
    retained = [i for name, i in zip(term.blocks, term.index, strict=True) if name != eliminated]
    term = term.select(torch.argsort(retained[0], stable=True))
    retained = [i for name, i in zip(term.blocks, term.index, strict=True) if name != eliminated]
    _, slot = torch.stack(retained).unique(dim=1, return_inverse=True)
    number = int(slot.max()) + 1
    first = torch.full((number,), len(slot)).scatter_reduce(0, slot, torch.arange(len(slot)), "amin")
    x = {name: block.x for name, block in blocks.items()}
    found, other = (
        curvature(some, x, blocks, wanted, eliminated, (slot, first)) for some in (term, dataclasses.replace(term, bend=None))
    )
    for mine, exact in zip(found, other, strict=True):
        assert mine.shape == exact.shape
        if exact.numel():
            torch.testing.assert_close(mine, exact, rtol=1e-7, atol=1e-9 * float(exact.abs().max()))


@pytest.mark.parametrize("loss", [None, Cauchy(0.5)])
@pytest.mark.parametrize("rigged", [False, True])
@pytest.mark.parametrize("lens", LENSES)
def test_of_every_lens_with_and_without_rig(lens: str, rigged: bool, loss: Loss | None, generator: torch.Generator) -> None:
    blocks, term = point_term(lens, rigged, loss, generator)
    compare(blocks, term, [True] * len(term.blocks), "point")


@pytest.mark.parametrize("rigged", [False, True])
def test_by_some_of_the_variables(rigged: bool, generator: torch.Generator) -> None:
    blocks, term = point_term("brown", rigged, Cauchy(0.5), generator)
    for k in range(1, 2 ** len(term.blocks)):
        compare(blocks, term, [bool(k >> i & 1) for i in range(len(term.blocks))], "point")


def test_numbers_held_in_some_cameras(generator: torch.Generator) -> None:
    held = {"focal": torch.tensor([True, False]), "k1": torch.tensor([False, True])}
    blocks, term = point_term("radial", False, None, generator, **held)
    compare(blocks, term, [True] * 3, "point")


@pytest.mark.parametrize("rigged", [False, True])
def test_poses_eliminated(rigged: bool, generator: torch.Generator) -> None:
    blocks, term = point_term("brown", rigged, Cauchy(0.5), generator)
    compare(blocks, term, [True] * len(term.blocks), "pose")


def test_pieces_are_joined(generator: torch.Generator, monkeypatch: pytest.MonkeyPatch) -> None:
    blocks, term = point_term("radial", False, Cauchy(0.5), generator)
    monkeypatch.setattr("torchsfm.optim.curvature.PIECE", 7)
    compare(blocks, term, [True] * 3, "point")


def test_points_far_along_their_rays(generator: torch.Generator) -> None:
    """Where a step along the ray is far from a step of coordinates."""
    blocks, term = point_term("none", False, None, generator)
    point = blocks["point"]
    far = torch.cat((point.x[:, 3:] + 1e3 * (point.x[:, :3] - point.x[:, 3:]), point.x[:, 3:]), 1)
    compare(blocks | {"point": dataclasses.replace(point, x=far)}, term, [True] * 3, "point")
