"""What the images say of each other: matches between all pairs, checked against epipolar geometry in one batched call."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Any

import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from torchsfm._types import Status
from torchsfm.linalg import svdvals
from torchsfm.motion import estimate_fundamental, estimate_homography
from torchsfm.robust.sampling import draw_seed

MIN_INLIERS = 15
"""Fewer epipolar inliers than this also occur between unrelated images."""

MOST_ZOOM = 4.0
"""Largest ratio of the focal lengths of two images."""
CONFIDENCE = 0.999
MAX_ITERATIONS = 3000
"""Pairs of unrelated images, the most of many, never reach the confidence; this is what they may cost."""
FEW = 2 * MIN_INLIERS
"""So few matches are unrelated unless half of them are right, which takes fewer samples."""

_ROWS_PER_CALL = 4_000_000
"""Padded correspondences verified at once; bounds memory, changes no result."""


class Verdict(IntEnum):
    """What two images have to do with each other.

    Example:
        >>> import torch, torchsfm
        >>> from torchsfm.reconstruction import Verdict
        >>> g = torch.Generator().manual_seed(0)
        >>> X, poses = torchsfm.random_points(80, generator=g), torchsfm.random_poses(3, generator=g)
        >>> turned = torchsfm.geometry.rotation_from_rotvec(torch.tensor([0.0, 0.1, 0.0]).double())
        >>> R, t = poses.R.clone(), poses.t.clone()
        >>> R[2], t[2] = turned @ R[1], turned @ t[1]  # the third camera is where the second was
        >>> K = torchsfm.intrinsics(torch.tensor(900.0), torch.tensor([499.5, 374.5])).double()
        >>> x = torchsfm.project_points(K @ torchsfm.Pose(R, t).matrix(), X)
        >>> pairs, same = torch.tensor([[0, 1], [1, 2]]), torch.arange(80)[:, None].expand(80, 2)
        >>> found = torchsfm.reconstruct_matches(list(x), pairs, [same] * 2, torch.tensor([[1000, 750]] * 3), K=K)
        >>> [Verdict(k).name for k in found.report.pairs.verdict.tolist()]
        ['GENERAL', 'ROTATION']
    """

    UNRELATED = 0
    """Too few matches agree with any epipolar geometry."""
    GENERAL = 1
    """Structure in depth seen from two places: the fundamental matrix is determined."""
    PLANAR = 2
    """A homography explains nearly all: one plane, seen from two places."""
    ROTATION = 3
    """A homography explains nearly all and is that of a camera turning about its centre, or zooming: no depth can be found."""


@dataclass(frozen=True)
class ViewGraph:
    """Image points, and which of them show the same scene point.

    Attributes:
        names: File names of the images.
        image_size: Width and height in pixels.
        x: Image points of all images, those of one image together, in pixels.
        view: Image of each point.
        color: Red, green, blue in [0, 1] at each point.
        pairs: Pairs of images that were compared.
        num_matches: Matches found per pair.
        F: Fundamental matrix per pair, `x2' F x1 = 0`.
        H: Homography per pair, `x2 ~ H x1`; the identity for unrelated pairs.
        fundamental_inliers: Matches that agree with F.
        homography_inliers: Matches that agree with H.
        match: Verified matches, as indices into `x`.
        match_pair: Pair of each verified match.
        descriptors: Reads what the image points look like; None where that is not known of all.
        weak: Image points that are less distinct, so that it says nothing if another image misses them; None where none is.
        fixed: Image points that are fixed to the images and not to the scene, see `find_overlays`; None where none is.
        still: Matches left out because one of their points is.
    """

    names: tuple[str, ...]
    image_size: Int[Tensor, "v 2"]
    x: Float[Tensor, "n 2"]
    view: Int[Tensor, "n"]
    color: Float[Tensor, "n 3"]
    pairs: Int[Tensor, "q 2"]
    num_matches: Int[Tensor, "q"]
    F: Float[Tensor, "q 3 3"]
    H: Float[Tensor, "q 3 3"]
    fundamental_inliers: Int[Tensor, "q"]
    homography_inliers: Int[Tensor, "q"]
    match: Int[Tensor, "k 2"]
    match_pair: Int[Tensor, "k"]
    descriptors: Callable[[], UInt8[Tensor, "n d"]] | None = None
    weak: Bool[Tensor, "n"] | None = None
    fixed: Bool[Tensor, "n"] | None = None
    still: int = 0

    def only(self, kept: Bool[Tensor, "q"]) -> "ViewGraph":
        """The graph in which the other pairs have nothing in common."""
        own = kept[self.match_pair]
        return replace(
            self,
            match=self.match[own],
            match_pair=self.match_pair[own],
            fundamental_inliers=torch.where(kept, self.fundamental_inliers, 0),
            homography_inliers=torch.where(kept, self.homography_inliers, 0),
        )

    def part(self, images: Int[Tensor, "k"]) -> tuple["ViewGraph", Int[Tensor, "m"]]:
        """The graph of some images alone, given in ascending order, and the numbers of its image points."""
        number = torch.full((len(self.names),), -1, dtype=torch.long)
        number[images] = torch.arange(len(images))
        node = (number[self.view] >= 0).nonzero()[:, 0]
        place = torch.full((len(self.x),), -1, dtype=torch.long)
        place[node] = torch.arange(len(node))
        kept = (number[self.pairs] >= 0).all(1)
        own = kept[self.match_pair]
        part = replace(
            self,
            names=tuple(self.names[i] for i in images.tolist()),
            image_size=self.image_size[images],
            x=self.x[node],
            view=number[self.view[node]],
            color=self.color[node],
            pairs=number[self.pairs[kept]],
            **{
                name: getattr(self, name)[kept]
                for name in ("num_matches", "F", "H", "fundamental_inliers", "homography_inliers")
            },
            match=place[self.match[own]],
            match_pair=(kept.cumsum(0) - 1)[self.match_pair[own]],
            descriptors=None,
            weak=None if self.weak is None else self.weak[node],
            fixed=None if self.fixed is None else self.fixed[node],
        )
        return part, node

    def verdicts(self, K: Float[Tensor, "v 3 3"], unknown_focal: Bool[Tensor, "v"]) -> Int[Tensor, "q"]:
        """The `Verdict` on each pair, given intrinsics of each image, and where their focal length is only a guess.

        A pair is called planar or rotating when its homography explains at least 80 % of what the fundamental matrix does
        (Schönberger & Frahm 2016, section 4.1). The singular values of `K2^-1 H K1` are equal for a rotation alone; where the
        focal length is a guess, equal at any focal length will do, and where both are, with any other in the second image: who
        zooms and stays where he is sees no depth either.
        """
        related = torch.maximum(self.fundamental_inliers, self.homography_inliers) >= MIN_INLIERS
        flat = self.homography_inliers >= 0.8 * self.fundamental_inliers.double()
        scales = torch.logspace(-0.5, 0.5, 21, dtype=K.dtype)[:, None]
        scales = torch.where(unknown_focal, scales, 1.0)
        tried = K.repeat(len(scales), 1, 1, 1)
        tried[..., :2, :2] *= scales[..., None, None]
        K1, K2 = tried[:, self.pairs[:, 0]], tried[:, self.pairs[:, 1]]
        turn = torch.linalg.solve_ex(K2, self.H @ K1).result
        # The rows of a rotation are of one length, which the second focal length can make them.
        length = turn.norm(dim=-1)
        zoom = length[..., 2] / (length[..., 0] * length[..., 1]).sqrt().clamp(min=1e-12)
        zoom = torch.where(unknown_focal[self.pairs].all(-1), zoom.clamp(1 / MOST_ZOOM, MOST_ZOOM), 1.0)
        zoomed = turn * torch.stack((zoom, zoom, torch.ones_like(zoom)), -1)[..., None]
        s, _ = svdvals(torch.cat((turn, zoomed)))
        spread = (s[..., 0] / s[..., 2].clamp(min=1e-12) - 1).amin(0)
        verdict = torch.where(flat, int(Verdict.PLANAR), int(Verdict.GENERAL))
        verdict = torch.where(flat & (spread < 0.05), int(Verdict.ROTATION), verdict)
        return torch.where(related, verdict, int(Verdict.UNRELATED))


def scale_of_images(image_size: Int[Tensor, "*v 2"]) -> Float[Tensor, "*v"]:
    """How many times as many pixels as in images of 1600 pixels or less, along the longer side, a distance has."""
    return image_size.amax(dim=-1).double().div(1600).clamp(min=1)


@dataclass(frozen=True)
class VerifiedPairs:
    """What was found of pairs: members of `ViewGraph`, but with matches as indices into the points of their two images."""

    num_matches: Int[Tensor, "q"]
    F: Float[Tensor, "q 3 3"]
    H: Float[Tensor, "q 3 3"]
    fundamental_inliers: Int[Tensor, "q"]
    homography_inliers: Int[Tensor, "q"]
    match: Int[Tensor, "k 2"]
    match_pair: Int[Tensor, "k"]

    @classmethod
    def join(cls, parts: Sequence["VerifiedPairs"]) -> "VerifiedPairs":
        """Several lists of pairs as one."""
        whole = {name: torch.cat([getattr(part, name) for part in parts]) for name in cls.__dataclass_fields__}
        sizes = torch.tensor([len(part.match) for part in parts])
        pairs = torch.tensor([0, *(len(part.F) for part in parts[:-1])]).cumsum(0)
        return cls(**whole | {"match_pair": whole["match_pair"] + pairs.repeat_interleave(sizes)})

    def graph(
        self,
        names: Sequence[str],
        image_size: Int[Tensor, "v 2"],
        x: Sequence[Float[Tensor, "_ 2"]],
        color: Sequence[Float[Tensor, "_ 3"]],
        pairs: Int[Tensor, "q 2"],
    ) -> ViewGraph:
        """The view graph of the images that the pairs are of; the arguments are those of `verify_pairs`."""
        offset = torch.tensor([0, *(len(p) for p in x)], dtype=torch.long).cumsum(0)
        return ViewGraph(
            names=tuple(names),
            image_size=image_size,
            x=torch.cat(list(x)) if x else self.F.new_zeros(0, 2),
            view=torch.arange(len(x)).repeat_interleave(offset.diff()),
            color=torch.cat(list(color)) if color else self.F.new_zeros(0, 3),
            pairs=pairs,
            num_matches=self.num_matches,
            F=self.F,
            H=self.H,
            fundamental_inliers=self.fundamental_inliers,
            homography_inliers=self.homography_inliers,
            match=self.match + offset[pairs[self.match_pair]],
            match_pair=self.match_pair,
        )


def verify_pairs(
    image_size: Int[Tensor, "v 2"],
    x: Sequence[Float[Tensor, "_ 2"]],
    pairs: Int[Tensor, "q 2"],
    matches: Sequence[Int[Tensor, "_ 2"]],
    *,
    quality: Sequence[Float[Tensor, "_"]] | None = None,
    threshold: float = 3.0,
    generator: torch.Generator | None = None,
) -> VerifiedPairs:
    """Keep the matches that agree with the epipolar geometry of their pair; all pairs are estimated together.

    Args:
        image_size: Width and height in pixels.
        x: Image points per image, in pixels.
        pairs: Pairs of images that were matched.
        matches: Per pair, indices of matching points in its first and second image.
        quality: Per pair, how much each match can be trusted, the larger the more, in any unit: samples favour the best.
        threshold: Largest distance of an inlier in pixels, for images whose longer side is 1600 pixels or less; it grows in
            proportion beyond that.
        generator: Source of randomness.

    Returns:
        What was found; a pair with fewer than `MIN_INLIERS` inliers keeps its counts but none of its matches. What is found of
        a pair is a function of its matches and the randomness, up to rounding, whatever other pairs there are.
    """
    counts = torch.tensor([len(m) for m in matches], dtype=torch.long)
    q = len(pairs)
    dtype = x[0].dtype if x else torch.float64
    F, H = (torch.eye(3, dtype=dtype).repeat(q, 1, 1) for _ in range(2))
    num_F, num_H = torch.zeros(q, dtype=torch.long), torch.zeros(q, dtype=torch.long)
    kept: dict[int, Tensor] = {}
    scale = scale_of_images(image_size).to(dtype)
    seed = draw_seed(generator)
    for block in _blocks(counts):
        slots = int(counts[block].max())
        x1, x2 = torch.zeros(len(block), slots, 2, dtype=dtype), torch.zeros(len(block), slots, 2, dtype=dtype)
        for row, index in enumerate(block.tolist()):
            (i, j), m = pairs[index].tolist(), matches[index]
            x1[row, : len(m)], x2[row, : len(m)] = x[i][m[:, 0]], x[j][m[:, 1]]
        mask = torch.arange(slots) < counts[block, None]
        limit = threshold * scale[pairs[block]].amax(dim=-1)
        options: dict[str, Any] = {"confidence": CONFIDENCE, "max_iterations": _trials(slots)}
        if quality is not None:
            trusted = [quality[index].to(dtype) for index in block.tolist()]
            options["quality"] = torch.nn.utils.rnn.pad_sequence(trusted, batch_first=True)
        again = torch.Generator().manual_seed(seed)
        epipolar = estimate_fundamental(x1, x2, threshold=limit, mask=mask, generator=again, **options)
        F[block] = epipolar.model
        num_F[block] = epipolar.inliers.sum(-1) * (epipolar.status == Status.OK)
        # Images that do not differ, or differ by a homography, may leave F undetermined and yet have all in common.
        related = (num_F[block] >= MIN_INLIERS) | (epipolar.status == Status.DEGENERATE)
        if bool(related.any()):
            options |= {"quality": options["quality"][related]} if quality is not None else {}
            planar = estimate_homography(
                x1[related], x2[related], threshold=limit[related], mask=mask[related], generator=again, **options
            )
            H[block[related]] = planar.model
            num_H[block[related]] = planar.inliers.sum(-1) * (planar.status == Status.OK)
            planar_inliers = torch.zeros_like(mask)
            planar_inliers[related] = planar.inliers
        for row, index in enumerate(block.tolist()):
            if num_F[index] >= MIN_INLIERS:
                kept[index] = matches[index][epipolar.inliers[row, : len(matches[index])]]
            elif num_H[index] >= MIN_INLIERS:
                kept[index] = matches[index][planar_inliers[row, : len(matches[index])]]
    verified = sorted(kept)
    rows = [kept[index] for index in verified]
    return VerifiedPairs(
        num_matches=counts,
        F=F,
        H=H,
        fundamental_inliers=num_F,
        homography_inliers=num_H,
        match=torch.cat(rows) if rows else torch.zeros(0, 2, dtype=torch.long),
        match_pair=torch.tensor(verified, dtype=torch.long).repeat_interleave(torch.tensor([len(m) for m in rows]).long()),
    )


def _blocks(counts: Int[Tensor, "q"]) -> list[Int[Tensor, "_"]]:
    """Pairs with enough matches, like sizes together, cut so that a padded block stays within memory."""
    order = torch.argsort(counts, descending=True, stable=True)
    order = order[counts[order] >= MIN_INLIERS]
    few = counts[order] <= FEW
    blocks = []
    for rest in (order[~few], order[few]):
        while len(rest):
            rows = max(1, _ROWS_PER_CALL // int(counts[rest[0]]))
            blocks.append(rest[:rows])
            rest = rest[rows:]
    return blocks


def _trials(matches: int) -> int:
    """Most samples of a pair, by whether it has few matches alone, so that no other pair matters."""
    if matches > FEW:
        return MAX_ITERATIONS
    # They find `MIN_INLIERS` inliers with confidence.
    return math.ceil(math.log(1 - CONFIDENCE) / math.log1p(-((MIN_INLIERS / FEW) ** 7)))
