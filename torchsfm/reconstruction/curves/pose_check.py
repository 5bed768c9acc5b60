"""Do poses that are given fit the photographs? Curves that some images find must lie next to edges of images left out."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm.geometry import Camera, Pose
from torchsfm.linalg.devices import on_the_cpu
from torchsfm.reconstruction.curves.camera_check import OtherCamera, other_camera
from torchsfm.reconstruction.curves.edge_maps import EdgeMap, EdgePoints
from torchsfm.reconstruction.curves.foretold_edges import Foretold, foretold_edges, runs_of
from torchsfm.reconstruction.curves.from_edges import SeenEdges, check_views, edges_of_images, neighbouring_views
from torchsfm.reconstruction.curves.fusion import piece_tangents
from torchsfm.reconstruction.curves.pieces import image_pieces
from torchsfm.reconstruction.messages import Progress
from torchsfm.reconstruction.model.curves import Curves

_REFERENCES = 12
"""Images, the most, whose edges are followed."""
_RUN = 48
"""Edge points of a run that is followed."""
_SHARE = 1 / 20
"""Of the edge points of an image, the part that is followed,"""
_LEAST, _MOST = 256, 1200
"""but not fewer and not more than so many."""
_THRESHOLD = 2.0
"""Pixels that edges may be off where they are followed."""
_AGREE = 3
"""Images, the followed one included, that must see a piece: what chance makes of so few is told afterwards."""
_SHORTEST = 4
"""Samples of the shortest piece."""
_WITNESSES = 2
"""Images around an image that must show a sample which it is asked for."""
_SURE = 4.0
"""Standard deviations of what chance does that are no chance: of few runs one or two hit by chance."""
_LITTLE = 0.05
"""Agreement of wrong poses, at most: curves that single images are right about."""
_MANY = 200
"""Samples, at least, by which poses are refuted: what few images far from each other see is found by chance, too."""
_CONFIDENT = 3.0
"""Standard deviations within which their agreement is then less"""
_NOTHING = 0.15
"""than this."""
_PART = 0.3
"""Of the usual agreement, the part that an image which fits is not below."""
_FEWEST = 60
"""Samples, or edge points that were followed, by which poses are judged, at least."""


@dataclass(frozen=True)
class PoseCheck:
    """How far edges that images foretell with given poses are there, see `check_poses`.

    Attributes:
        followed: Edge points that were followed through half of the images around theirs, if there are any; 0 of three images.
        left_out: What became of the pieces so found in the images of the other half, all together: a single number each.
        images: What became of the curves that two or more of the images around each image show.
        camera: Which camera would fit the edges better; None where no curves tell.

    Example:
        >>> import torch, torchsfm
        >>> scene = torchsfm.render_sequence(views=6, width=160, height=120, generator=torch.Generator().manual_seed(0))
        >>> given = scene.images, scene.cameras, scene.poses
        >>> check = torchsfm.reconstruction.check_poses(*given, torchsfm.reconstruction.reconstruct_curves(*given))
        >>> check.confirmed, check.refuted, int(check.contradicts.sum())
        (True, False, 0)
    """

    followed: int
    left_out: Foretold
    images: Foretold
    camera: OtherCamera | None

    @property
    def confirmed(self) -> bool:
        """Whether images left out show more of what others foretell than chance does."""
        told = self.left_out
        return bool((told.excess > _SURE) & (told.agreement > _LITTLE))

    @property
    def refuted(self) -> bool:
        """Whether enough was foretold to say that images left out show no more of it than chance does."""
        told = self.left_out
        highest = told.agreement + _CONFIDENT * told.sigma / told.samples.clamp_min(1)
        return not self.confirmed and bool((told.samples >= _MANY) & (highest < _NOTHING))

    @property
    def contradicts(self) -> Bool[Tensor, "v"]:
        """Images that show less than three tenths of what is usual of the curves that images around them show."""
        told = self.images
        good = told.excess > _SURE
        usual = told.agreement[good].median() if bool(good.any()) else torch.tensor(0.0)
        return (told.samples >= _FEWEST) & (told.agreement < _PART * usual)

    def doubts(self, names: Sequence[str]) -> list[str]:
        """What is to be told of the poses, a line each; none where they fit.

        Args:
            names: Of the images.
        """
        if self.refuted:
            return [f"the poses do not fit the photographs: {self._share_left_out()}"]
        if self.followed >= _FEWEST and not self.confirmed:
            why = "they are wrong, or too few edges are seen from where images are"
            return [f"nothing confirms the poses: {self._share_left_out()}; {why}"]
        lines = [f"doubtful: {name} ({doubt})" for name, doubt in zip(names, self.image_doubts(), strict=True) if doubt]
        return lines or ([] if self.camera is None else self.camera.doubts())

    def image_doubts(self) -> list[str]:
        """Why the pose or camera of each image may be wrong; empty where nothing says so."""
        if self.refuted:
            return ["the poses do not fit the photographs"] * len(self.images.samples)
        told = self.images
        hits, chance = ((100 * number / told.samples.clamp_min(1)).tolist() for number in (told.hits, told.chance))
        return [
            f"it shows {hits[i]:.0f} % of the curves that images around it show, {chance[i]:.0f} % would be chance"
            if own
            else ""
            for i, own in enumerate(self.contradicts.tolist())
        ]

    def _share_left_out(self) -> str:
        """How much of what some images foretell others show."""
        told = self.left_out
        if told.samples < _FEWEST:
            return "hardly an edge of one image is found in others where they say"
        hits, chance = (100 * float(number / told.samples) for number in (told.hits, told.chance))
        return f"of what some images foretell others show {hits:.0f} %, where chance would show {chance:.0f} %"


@on_the_cpu
def check_poses(
    images: Iterable[Float[Tensor, "c h w"] | None],
    cameras: Camera,
    poses: Pose,
    curves: Curves,
    *,
    points: Float[Tensor, "n 3"] | None = None,
    neighbours: int = 10,
) -> PoseCheck:
    """See whether poses fit photographs, by edges and the curves found with them.

    Some edges of images are followed through half of the images around them, as `reconstruct_curves` does with all. In the
    other half, most of the samples that are found so lie next to an edge that runs as they do if poses are right; if they are
    wrong, only as many as do some pixels aside, where nothing but chance puts edges. The curves themselves then tell which
    images see nothing of what images around them see, and whether other focal lengths would fit better.

    Told are poses of other photographs, from camera to world instead of the other way, axes of another program, images turned.
    It takes four images. Where these are far from each other nothing may confirm right poses; curves that are found then are no
    better confirmed. Poses that leave edges within a pixel of where they should be are not told from right ones.

    Args:
        images: The photographs, one after another, grey or red, green, blue; None for one that is missing.
        cameras: Of each image (v).
        poses: Of each image (v).
        curves: What `reconstruct_curves` found of them.
        points: Points of the scene, if any are known: they tell how far away it is.
        neighbours: Images in which the edges of an image are sought.

    Raises:
        ValueError: Wrong shape, dtype, device or option; another number of images than of cameras.

    Example:
        >>> import torch, torchsfm
        >>> scene = torchsfm.render_sequence(views=6, width=160, height=120, generator=torch.Generator().manual_seed(0))
        >>> given = scene.images, scene.cameras, scene.poses
        >>> check = torchsfm.reconstruction.check_poses(*given, torchsfm.reconstruction.reconstruct_curves(*given))
        >>> check.refuted, check.doubts(["a", "b", "c", "d", "e", "f"])
        (False, [])
    """
    check_views(cameras, poses, neighbours=neighbours)
    edges, size = edges_of_images(images, len(poses.R), lambda stage, done, total: None)
    return check_by_edges(
        SeenEdges.of(edges, size, cameras), size, cameras, poses, curves, points=points, neighbours=neighbours
    )


def check_by_edges(
    seen: SeenEdges,
    size: tuple[int, int],
    cameras: Camera,
    poses: Pose,
    curves: Curves,
    *,
    points: Float[Tensor, "n 3"] | None,
    neighbours: int = 10,
    progress: Progress | None = None,
) -> PoseCheck:
    """`check_poses` from the edges of images, of which `size` is the largest height and width."""
    report = progress or (lambda stage, done, total: None)
    kept, maps = seen
    P = cameras.K.double() @ poses.matrix().double()
    around = neighbouring_views(P, size, None if points is None else points.double(), neighbours)
    around = [[j for j in near if len(kept[j])] for near in around]
    there = [i for i in range(len(kept)) if len(kept[i])]
    references = there[:: -(-len(there) // _REFERENCES)] if there else []
    steps = len(references) + len(there)
    followed, left_out = 0, [Foretold.none(1)]
    for turn, i in enumerate(references):
        report("poses", turn, steps)
        start = turn % max(len(around[i]), 1)
        near = around[i][start:] + around[i][:start]
        use, other = near[0::2], near[1::2]
        own = _some(maps.points[i], len(references))
        followed += len(own.x) if len(there) > _AGREE else 0
        if len(use) < _AGREE - 1 or not other or not len(own.x):
            continue
        views = [i, *use]
        pieces = image_pieces(
            i, [EdgeMap.of(own, *size), *(maps[j] for j in use)], P[views], threshold=_THRESHOLD,
            least_views=_AGREE, shortest=_SHORTEST,
        )  # fmt: skip
        if len(pieces.X):
            tangent = piece_tangents(pieces.X, pieces.piece)
            found = foretold_edges(pieces.X, tangent, pieces.piece, [maps[j] for j in other], P[other], size)
            left_out.append(found.total())
    X, tangent, run = curves.X.double(), curves.tangents().double(), runs_of(curves.curve)
    shown = torch.zeros(len(X), len(kept), dtype=torch.bool)
    shown[curves.sample, curves.view] = True
    images = [Foretold.none(1)] * len(kept)
    for done, i in enumerate(there):
        report("poses", len(references) + done, steps)
        asked = shown[:, around[i]].sum(1) >= _WITNESSES
        if bool(asked.any()):
            images[i] = foretold_edges(X[asked], tangent[asked], run[asked], [maps[i]], P[i : i + 1], size)
    report("poses", 1, 1)
    return PoseCheck(followed, Foretold.cat(left_out).total(), Foretold.cat(images), other_camera(curves, cameras, poses))


def _some(points: EdgePoints, images: int) -> EdgePoints:
    """Runs of an image's edge points, evenly out of all: the more, the fewer images there are of which it is one."""
    run: Int[Tensor, "n"] = runs_of(points.chain, _RUN)
    long = torch.bincount(run, minlength=1)[run] >= _RUN // 3
    _, run = torch.unique_consecutive(run[long], return_inverse=True)
    wanted = min(max(_LEAST * _REFERENCES / images, len(points.x) * _SHARE), _MOST)
    every = max(1, round(len(run) / wanted))
    taken = run % every == 0
    return EdgePoints(points.x[long][taken], points.tangent[long][taken], run[taken])
