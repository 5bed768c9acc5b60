"""Which photographs to compare, their matches, and what epipolar geometry says of these: shard by shard."""

import hashlib
import math
from collections.abc import Callable
from dataclasses import dataclass, fields, replace

import torch
from jaxtyping import Int
from torch import Tensor

from torchsfm.images import Features, match_features, preview_matches, promising_pairs, retrieve_pairs
from torchsfm.images.preemptive import PARTNERS
from torchsfm.reconstruction.matching.image_points import SHARDS, ImagePoints, SavedFeatures
from torchsfm.reconstruction.matching.masks import Masks
from torchsfm.reconstruction.matching.overlays import beside_overlays, find_overlays
from torchsfm.reconstruction.matching.sequence import Corners, sequence_pairs, track_corners
from torchsfm.reconstruction.matching.stages import Arrays, Shards, Stages, one_thread
from torchsfm.reconstruction.matching.view_graph import VerifiedPairs, ViewGraph, verify_pairs
from torchsfm.reconstruction.messages import Progress

MAX_IMAGES_ALL_PAIRS = 80
"""Up to this many images all pairs are looked at; beyond it, each image with those that look most alike."""
NEAR_IMAGES = 16
"""Pairs of one block of so many by so many images are matched one after the other, and so need few images at a time."""
MATCHED_AT_ONCE = 128
"""Pairs whose images are in the memory together."""
FEW_FEATURES, RATIO_OF_FEW = 4096, 0.9
"""Images with fewer features match by a looser ratio: there are fewer others to take one for, and each match is needed."""
VERIFIED_AT_ONCE = 4096
"""Pairs of a shard of verification, which gains from large batches."""


@dataclass(frozen=True)
class PairShards:
    """How pairs of images are divided into shards: runs of them for verification, and parts of these for matching.

    Where they are divided depends on the pairs alone, never on how many processes there are. Pairs of the same images are
    matched together.
    """

    order: Int[Tensor, "q"]
    """The pairs in the order in which they are matched; the same as theirs from run to run."""
    size: int
    """Pairs of a shard of matching, which divides that of verification."""
    digest: str

    @classmethod
    def of(cls, pairs: Int[Tensor, "q 2"]) -> "PairShards":
        """Divide pairs."""
        block = torch.div(pairs, NEAR_IMAGES, rounding_mode="floor")
        key = torch.arange(len(pairs)) // VERIFIED_AT_ONCE
        for column in (block[:, 0], block[:, 1]):
            key = key * (int(block.max()) + 1 if len(block) else 1) + column
        size = 64
        while size < VERIFIED_AT_ONCE // 8 and size * SHARDS < len(pairs):
            size *= 2
        digest = hashlib.sha256(pairs.numpy().tobytes()).hexdigest()[:32]
        return cls(torch.argsort(key, stable=True), size, digest)

    @property
    def match_shards(self) -> int:
        """How many there are for matching."""
        return math.ceil(len(self.order) / self.size)

    @property
    def verify_shards(self) -> int:
        """How many there are for verification."""
        return max(1, math.ceil(len(self.order) / VERIFIED_AT_ONCE))

    def matched(self, shard: int) -> Int[Tensor, "_"]:
        """The pairs of a shard of matching."""
        return self.order[self.size * shard : self.size * (shard + 1)]

    def verified(self, shard: int) -> slice:
        """The pairs of a shard of verification."""
        return slice(VERIFIED_AT_ONCE * shard, VERIFIED_AT_ONCE * (shard + 1))

    def match_shards_of(self, shard: int) -> range:
        """The shards of matching that have the pairs of a shard of verification, and no others."""
        each = VERIFIED_AT_ONCE // self.size
        return range(each * shard, min(each * (shard + 1), self.match_shards))


@dataclass(frozen=True)
class FoundMatches:
    """Matches of all pairs, a shard of verification at a time."""

    work: PairShards
    pairs: Int[Tensor, "q 2"]
    matched: Shards
    features: list[int]
    """How many each image has; the corners come after them."""
    corners: Corners | None

    def of(self, shard: int) -> dict[int, Tensor]:
        """Those of the pairs of a shard, by the number of the pair."""
        matches: dict[int, Tensor] = {}
        for number in self.work.match_shards_of(shard):
            saved = self.matched[number]
            matches |= zip(
                self.work.matched(number).tolist(), torch.split(saved["match"], saved["count"].tolist()), strict=True
            )
        if self.corners is not None:
            for q in matches:
                i, j = self.pairs[q].tolist()
                before = torch.tensor([self.features[i], self.features[j]])
                matches[q] = torch.cat([matches[q], before + self.corners.matches(i, j)])
        return matches


def match_all(
    points: ImagePoints,
    stages: Stages,
    progress: Progress,
    seed: int,
    *,
    sequence: bool,
    neighbours: int,
    max_pixels: int,
    masks: Masks | None,
) -> ViewGraph:
    """Matches of all pairs worth comparing, verified.

    Args:
        points: The photographs and their features.
        stages: Where finished shards are saved.
        progress: Called as the work goes on.
        seed: Of the choice of samples.
        sequence: Whether the photographs are frames of a video.
        neighbours: Images each one is matched with where there are many.
        max_pixels: Larger frames cannot be read.
        masks: Where frames show nothing to track.
    """
    features = points.features

    def choose() -> Arrays:
        if sequence:
            return {"pairs": sequence_pairs(features)}
        if len(features) <= MAX_IMAGES_ALL_PAIRS:
            return {"pairs": torch.combinations(torch.arange(len(features)))}
        return {"pairs": retrieve_pairs(features, neighbours=neighbours)}

    pairs = stages.run("pairs", choose)["pairs"]
    if not sequence:
        pairs = _promising(pairs, features, stages, progress)
    work = PairShards.of(pairs)
    matched = _compared("match", _matches, pairs, features, stages, progress)
    x, color, weak, corners = points.x, points.color, points.weak, None
    if sequence:
        tracked = stages.run("track", lambda: track_corners(points, max_pixels, progress, masks))
        corners = Corners.of(tracked, len(points.names))
        x = tuple(torch.cat(both) for both in zip(points.x, corners.x, strict=True))
        color = tuple(torch.cat(both) for both in zip(points.color, corners.color, strict=True))
        weak = tuple(torch.cat((own, own.new_zeros(len(more)))) for own, more in zip(points.weak, corners.x, strict=True))
    x = tuple(a.double() for a in x)

    found = FoundMatches(work, pairs, matched, [len(a) for a in points.x], corners)

    offset = torch.tensor([0, *(len(a) for a in x)]).cumsum(0)

    def look_for_overlays(_: int) -> Arrays:
        again = torch.Generator().manual_seed(seed)
        fixed = find_overlays(points.image_size, x, pairs, lambda: map(found.of, range(work.verify_shards)), generator=again)
        return {"points": fixed.nonzero()[:, 0]}

    after = f"{work.digest} {seed}"
    fixed = torch.zeros(int(offset[-1]), dtype=torch.bool)
    with one_thread():
        fixed[stages.shards("overlays", 1, look_for_overlays, after=after)[0]["points"]] = True

    def verify(shard: int) -> Arrays:
        progress("verify", work.verified(shard).start, len(pairs))
        matches, still = found.of(shard), 0
        for q, match in matches.items():
            kept = ~fixed[match + offset[pairs[q]]].any(-1)
            matches[q], still = match[kept], still + int((~kept).sum())
        chosen = work.verified(shard)
        some = [matches[q] for q in range(len(pairs))[chosen]]
        # What a pair gets depends on the seed and the pair alone.
        verified = verify_pairs(points.image_size, x, pairs[chosen], some, generator=torch.Generator().manual_seed(seed))
        progress("verify", min(chosen.stop, len(pairs)), len(pairs))
        return {field.name: getattr(verified, field.name) for field in fields(verified)} | {"still": torch.tensor(still)}

    with one_thread():
        shards = stages.shards("verify", work.verify_shards, verify, after=after)
    parts = [dict(shard) for shard in shards]
    still = sum(int(part.pop("still")) for part in parts)
    verified = VerifiedPairs.join([VerifiedPairs(**part) for part in parts])
    graph = verified.graph(points.names, points.image_size, x, [c.double() for c in color], pairs)
    beside = beside_overlays(points.image_size, x, fixed)
    graph = replace(graph, still=still, fixed=fixed if bool(fixed.any()) else None, weak=torch.cat(weak) | beside)
    # Corners that were tracked through a sequence have no descriptors.
    return graph if sequence else replace(graph, descriptors=lambda: torch.cat([f.descriptors for f in features]))


def _promising(pairs: Int[Tensor, "q 2"], features: SavedFeatures, stages: Stages, progress: Progress) -> Int[Tensor, "_ 2"]:
    """The pairs that are worth comparing in full, by a look at some features of all."""
    if len(features) <= 2 * PARTNERS:
        return pairs  # nearly all would be kept
    shards = _compared("look", lambda some, local: {"found": preview_matches(some, local)}, pairs, features, stages, progress)
    found = torch.empty(len(pairs), dtype=torch.float64)
    found[PairShards.of(pairs).order] = torch.cat([shard["found"] for shard in shards])
    return pairs[promising_pairs(pairs, found)]


def _matches(features: list[Features], pairs: Int[Tensor, "k 2"]) -> Arrays:
    """The matches of pairs one after the other, and how many each has."""
    few = (torch.tensor([len(f) for f in features]) < FEW_FEATURES)[pairs].any(1)
    strict = iter(match_features(features, pairs[~few]))
    loose = iter(match_features(features, pairs[few], ratio=RATIO_OF_FEW))
    rows = [next(loose if of_few else strict) for of_few in few.tolist()]
    return {"count": torch.tensor([len(m) for m in rows]).long(), "match": torch.cat(rows)}


def _compared(
    stage: str,
    compare: Callable[[list[Features], Int[Tensor, "k 2"]], Arrays],
    pairs: Int[Tensor, "q 2"],
    features: SavedFeatures,
    stages: Stages,
    progress: Progress,
) -> Shards:
    """What features say of all pairs, shard by shard, with the images of a few pairs in the memory at a time."""
    work = PairShards.of(pairs)
    told = 0

    def shard(number: int) -> Arrays:
        nonlocal told
        parts = list[Arrays]()
        for some in torch.split(pairs[work.matched(number)], MATCHED_AT_ONCE):
            progress(stage, told, len(pairs))
            images, local = torch.unique(some, return_inverse=True)
            parts.append(compare([features[i] for i in images.tolist()], local))
            told += len(some)
        progress(stage, told, len(pairs))
        return {name: torch.cat([part[name] for part in parts]) for name in parts[0]}

    return stages.shards(stage, work.match_shards, shard, after=work.digest)
