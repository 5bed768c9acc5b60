"""What views see besides points: kinds of structure that a bundle adjusts together with them, each in a file of its own."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from jaxtyping import Float, Int
from torch import Tensor

from torchsfm.bundle.projection import Projection
from torchsfm.geometry import Camera, Pose, Similarity
from torchsfm.optim import Block, Term


@dataclass(frozen=True)
class Sight:
    """What is between the world and the images of a bundle: the variables, which of them each view has, and the formula."""

    blocks: tuple[str, ...]
    """Names of the variables: those of poses, one after the other from the world to the camera, and the camera's last."""
    index: tuple[Int[Tensor, "v"], ...]
    """Which variable of each block belongs to each view."""
    projection: Projection
    residual: Callable[..., Tensor]
    """Of points, by all of these variables, (m, 2) pixels; see `Projection`."""
    linearize: Callable[..., Tensor]
    """The same with derivatives."""
    poses: Pose
    """Of the views, at the start."""
    cameras: Camera
    """Of the views, at the start."""

    def at(self, view: Int[Tensor, "m"]) -> tuple[Int[Tensor, "m"], ...]:
        """The variables between the world and observations in some views."""
        return tuple(index[view] for index in self.index)

    @staticmethod
    def motions(*rows: Float[Tensor, "m 12"]) -> list[tuple[Float[Tensor, "3 3 m"], Float[Tensor, "3 m"]]]:
        """R and t of the motions from the world to the camera; rows of observations last."""
        return [(row.mT[:9].reshape(3, 3, -1), row.mT[9:]) for row in rows]


@runtime_checkable
class Structure(Protocol):
    """Variables of one kind and what the views show of them.

    They are eliminated as points are, each by itself, so that no residual may depend on two of them.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> truth = torchsfm.random_bundle_problem(4, 50, 100, layout="dome", noise=0.0, generator=g).truth
        >>> L = torchsfm.geometry.pluecker_from_points(truth.X[:1], truth.X[1:2])  # a line through two points
        >>> x = torchsfm.project_points(truth.poses, truth.X[:2], truth.cameras)  # the ends of a segment in every view
        >>> lines = torchsfm.BundleLines(L, x, torch.arange(4), torch.zeros(4, dtype=torch.int64))
        >>> found = torchsfm.bundle_adjust(truth, structure=(lines,))
        >>> lines.block, bool(found.structure[0].L.allclose(L, atol=1e-4))  # back as it came, and moved
        ('line', True)
    """

    @property
    def block(self) -> str:
        """The name of the variables."""

    @property
    def follows_world(self) -> bool:
        """Whether the variables can go where a motion of the world takes them; if not, noise seems to say where it is."""

    def check(self, views: int) -> None:
        """See that the observations fit a bundle of so many views.

        Raises:
            ValueError: An index points at nothing.
        """

    def variables(self, sight: Sight) -> Block:
        """The variables where they start.

        Args:
            sight: What is between the world and the images.
        """

    def term(self, sight: Sight, start: Block) -> Term:
        """The residuals, in units in which those of points are pixels, one row an observation.

        Args:
            sight: What is between the world and the images.
            start: The variables as `variables` gave them.
        """

    def covariance(self, x: Tensor, C: Tensor) -> Tensor:
        """Covariances of the variables in coordinates that mean something outside, from those of their steps.

        Args:
            x: The variables, as the block holds them.
            C: The covariances of steps along the block's manifold.
        """

    def moved(self, start: Tensor, end: Tensor, world: Similarity | None) -> "Structure":
        """The same with the variables moved, and then the world of those that did; others keep every bit.

        Args:
            start: The variables before, as the block holds them.
            end: The same after the adjustment.
            world: How the gauge then moved the world; None where it did not.
        """
