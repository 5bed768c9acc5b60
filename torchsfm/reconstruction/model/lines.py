"""Lines of a model: parts of them in space, and the segments of images that show them."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm._types import check_index, check_tensors, tensor_map
from torchsfm.bundle import BundleLines
from torchsfm.geometry import Similarity, pluecker_from_points
from torchsfm.optim import Loss

_SPREAD = 12**-0.5
"""Standard deviation of what is spread evenly over a length, from its middle."""


@dataclass(frozen=True)
class Lines:
    """Lines of space, each as far as it was seen, and their tracks: the segments of images that show them, sorted by line.

    Several segments of one image may be parts of the same line.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> P, ends = torchsfm.random_poses(3, generator=g).matrix(), torchsfm.random_points(8, generator=g).reshape(4, 2, 3)
        >>> x = torchsfm.project_points(P[:, None], ends).flatten(0, 1)  # four lines in three images
        >>> view, line = torch.arange(3).repeat_interleave(4), torch.arange(4).repeat(3)
        >>> order = line.argsort(stable=True)
        >>> lines = torchsfm.Lines(ends, torch.ones(4, 3).double(), x[order], torch.ones(12).double(), view[order], line[order])
        >>> len(lines), lines.L.shape, lines.support()  # how many images show each
        (4, torch.Size([4, 6]), tensor([3, 3, 3, 3]))
        >>> lines.select(torch.tensor([True, False, False, True])).line
        tensor([0, 0, 0, 1, 1, 1])
    """

    ends: Float[Tensor, "l 2 3"]
    """Both ends in the world."""
    color: Float[Tensor, "l 3"]
    """Red, green, blue in [0, 1]."""
    x: Float[Tensor, "k 2 2"]
    """Ends of the segments, pixels."""
    weight: Float[Tensor, "k"]
    """Inverse variance across each segment of the two points of it, `fit_points`, that say of the line what all say."""
    view: Int[Tensor, "k"]
    """Image of each segment."""
    line: Int[Tensor, "k"]
    """Line of each segment."""

    def __post_init__(self) -> None:
        check_tensors(
            ends=(self.ends, "l 2 3"), color=(self.color, "l 3"), x=(self.x, "k 2 2"), weight=(self.weight, "k"),
            view=(self.view, "k: int"), line=(self.line, "k: int"),
        )  # fmt: skip
        check_index(line=(self.line, len(self.ends)))

    def __len__(self) -> int:
        """Number of lines."""
        return len(self.ends)

    @property
    def L(self) -> Float[Tensor, "l 6"]:
        """The lines as Pluecker vectors (d, m), d from the first end to the second."""
        return pluecker_from_points(self.ends[:, 0], self.ends[:, 1])

    def fit_points(self) -> Float[Tensor, "k 2 2"]:
        """The two points of each segment that say where its line is as all of its edge points do."""
        return fit_points(self.x)

    def support(self) -> Int[Tensor, "l"]:
        """Number of images that show each line."""
        pairs = torch.unique(torch.stack((self.line, self.view)), dim=1)
        return torch.bincount(pairs[0], minlength=len(self))

    def select(self, keep: Bool[Tensor, "l"]) -> "Lines":
        """Some of the lines, with their segments."""
        seen, number = self.seen_where(keep[self.line]), keep.cumsum(0) - 1
        return replace(seen, ends=self.ends[keep], color=self.color[keep], line=number[seen.line])

    def seen_where(self, keep: Bool[Tensor, "k"]) -> "Lines":
        """All lines, with some of their segments."""
        x, weight, view, line = (t[keep] for t in (self.x, self.weight, self.view, self.line))
        return Lines(self.ends, self.color, x, weight, view, line)

    def detached(self) -> "Lines":
        """The same as plain numbers on the CPU."""
        return tensor_map(lambda t: t.detach().cpu(), self)

    def transform(self, similarity: Similarity) -> "Lines":
        """The same lines in another world frame."""
        return replace(self, ends=similarity.transform(self.ends.flatten(0, 1)).reshape(-1, 2, 3))

    def bundle(self, *, unit: float = 1.0, loss: Loss | None = None, ends: bool = False) -> BundleLines:
        """As a part of a bundle in which an observation of a point has the standard deviation `unit`, pixels.

        With `ends` the segments are given by their ends, which are what people look at.
        """
        x = self.x if ends else self.fit_points()
        return BundleLines(self.L, x, self.view, self.line, weights=self.weight * unit**2, loss=loss)

    def adjusted(self, structure: BundleLines) -> "Lines":
        """The same where that part of a bundle was moved to."""
        return self.moved_to(structure.L)

    def moved_to(self, L: Float[Tensor, "l 6"]) -> "Lines":
        """The parts of other lines that are nearest to these."""
        d = L[:, None, :3]
        size = d.square().sum(-1, keepdim=True).clamp_min(1e-300)
        foot = torch.linalg.cross(d, L[:, None, 3:], dim=-1) / size
        along = (self.ends * d).sum(-1, keepdim=True) / size
        return replace(self, ends=foot + along * d)


def fit_points(ends: Float[Tensor, "*n 2 2"]) -> Float[Tensor, "*n 2 2"]:
    """The two points that stand for edge points spread evenly over segments."""
    middle, half = ends.mean(-2, keepdim=True), (ends[..., 1:, :] - ends[..., :1, :]) * _SPREAD
    return torch.cat((middle - half, middle + half), -2)
