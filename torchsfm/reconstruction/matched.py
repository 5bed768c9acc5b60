"""Reconstruct from keypoints and matches that another program found: any learned matcher, COLMAP's database, hloc's files."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchsfm._types import check_one_problem, check_options
from torchsfm.linalg.devices import on_the_cpu
from torchsfm.reconstruction.mappers.growth import Given, Wanted
from torchsfm.reconstruction.matching.stages import Stages, one_thread
from torchsfm.reconstruction.matching.view_graph import verify_pairs
from torchsfm.reconstruction.messages import Progress
from torchsfm.reconstruction.models import build_models
from torchsfm.reconstruction.report import SfmResult


@dataclass(frozen=True)
class MatchedImages:
    """Keypoints of images and matches between pairs of them, as matchers leave them.

    Attributes:
        names: File names of the images.
        image_size: Width and height of each image in pixels.
        keypoints: Image points of each image in pixels, the centre of the top-left pixel at (0, 0).
        pairs: Pairs of images that were compared.
        matches: Per pair, indices of matching keypoints in its first and second image.
        weights: Per pair, how much each match can be trusted, the larger the more; None where nothing tells.
        camera_index: Which camera took each image; None where nothing tells.
        focal: Focal length in pixels that is known of each image, as far as it is.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> X, poses = torchsfm.random_points(60, generator=g), torchsfm.random_poses(3, generator=g)
        >>> K = torchsfm.intrinsics(torch.tensor(900.0), torch.tensor([499.5, 374.5])).double()
        >>> x = torchsfm.project_points(K @ poses.matrix(), X)
        >>> pairs, same = torch.tensor([[0, 1], [0, 2], [1, 2]]), torch.arange(60)[:, None].expand(60, 2)
        >>> size = torch.tensor([[1000, 750]] * 3)
        >>> matched = torchsfm.MatchedImages(("a.jpg", "b.jpg", "c.jpg"), size, tuple(x), pairs, (same,) * 3)
        >>> torchsfm.write_database(matched, "database.db")
        >>> read = torchsfm.read_database("database.db")  # such as other programs write
        >>> found = torchsfm.reconstruct_matches(read.keypoints, read.pairs, read.matches, read.image_size, K=K)
        >>> found.model.num_registered
        3
    """

    names: tuple[str, ...]
    image_size: Int[Tensor, "v 2"]
    keypoints: tuple[Float[Tensor, "_ 2"], ...]
    pairs: Int[Tensor, "q 2"]
    matches: tuple[Int[Tensor, "_ 2"], ...]
    weights: tuple[Float[Tensor, "_"], ...] | None = None
    camera_index: Int[Tensor, "v"] | None = None
    focal: tuple[float | None, ...] | None = None


@on_the_cpu
def reconstruct_matches(
    keypoints: Sequence[Float[Tensor, "_ 2"]],
    pairs: Int[Tensor, "q 2"],
    matches: Sequence[Int[Tensor, "_ 2"]],
    image_size: Int[Tensor, "v 2"],
    *,
    weights: Sequence[Float[Tensor, "_"]] | None = None,
    names: Sequence[str] | None = None,
    color: Sequence[Float[Tensor, "_ 3"]] | None = None,
    camera: str | None = None,
    camera_index: Int[Tensor, "v"] | None = None,
    shared_camera: bool | None = None,
    K: Float[Tensor, "3 3"] | None = None,
    focal: float | Sequence[float | None] | None = None,
    free_principal_point: bool = True,
    method: str = "auto",
    threshold: float = 3.0,
    seed: int = 0,
    progress: Progress | None = None,
) -> SfmResult:
    """Reconstruct from keypoints and matches, whoever found them.

    The matches of all pairs are checked against epipolar geometry in one batched call, joined into tracks, and mapped as
    `reconstruct` maps its own.

    Args:
        keypoints: Image points of each image in pixels, the centre of the top-left pixel at (0, 0). A keypoint that is not
            finite matches nothing.
        pairs: Pairs of images that were matched, each in any order and any number of times.
        matches: Per pair, indices of matching keypoints in its first and second image. Wrong ones are sorted out.
        image_size: Width and height of each image in pixels.
        weights: Per pair, how much each match can be trusted, the larger the more, in any unit: a matcher's scores. Samples
            favour the best, and where two matches of a pair contradict each other in a track the better one is taken. A match
            of weight 0 or less is absent.
        names: Names of the images.
        color: Colours of the keypoints in [0, 1].
        camera: Distortion model, see `reconstruct`.
        camera_index: Which camera took each image, numbered from 0; images of different size never share one.
        shared_camera: Whether all images of one size share a camera, as they do by default where `camera_index` is not given,
            unless pairs and models say that their focal lengths differ.
        K: Known intrinsics of all images.
        focal: First guess of the focal length in pixels, of all images or of each, which is then adjusted.
        free_principal_point: Estimate the principal point too.
        method: "incremental", "projective", "global", "windows" or "auto", see `reconstruct`.
        threshold: Largest distance of a match from its epipolar lines in pixels, for images of up to 1600 pixels; it grows in
            proportion beyond that.
        seed: The same seed gives the same model.
        progress: Called as the work goes on.

    Returns:
        The models, the largest first, and a report.

    Raises:
        ValueError: Shapes or numbers of entries disagree, or an index is out of range.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> X, poses = torchsfm.random_points(60, generator=g), torchsfm.random_poses(3, generator=g)
        >>> K = torchsfm.intrinsics(torch.tensor(900.0), torch.tensor([499.5, 374.5])).double()
        >>> x = torchsfm.project_points(K @ poses.matrix(), X)
        >>> pairs, same = torch.tensor([[0, 1], [0, 2], [1, 2]]), torch.arange(60)[:, None].expand(60, 2)
        >>> found = torchsfm.reconstruct_matches(list(x), pairs, [same] * 3, torch.tensor([[1000, 750]] * 3), K=K)
        >>> found.model.num_registered, found.report.pairs.count(torchsfm.reconstruction.Verdict.GENERAL)
        (3, 3)
    """
    check_one_problem(pairs=(pairs, "q 2: int"), image_size=(image_size, "v>=1 2: int"), K=(K, "?3 3"))
    check_one_problem(camera_index=(camera_index, "?v: int"))
    check_options(
        seed=(seed, "int"), threshold=(threshold, "float > 0"), camera=(camera, str | None),
        shared_camera=(shared_camera, bool | None), names=(names, Sequence | None),
    )  # fmt: skip
    v, q = len(image_size), len(pairs)
    of_images: dict[str, Any] = {"keypoints": keypoints, "names": names, "color": color, "camera_index": camera_index}
    of_images |= {"focal": focal if isinstance(focal, Sequence) else None}
    for name, values, count, what in (
        *((name, values, v, "image") for name, values in of_images.items()),
        ("matches", matches, q, "pair"),
        ("weights", weights, q, "pair"),
    ):
        if values is not None and (isinstance(values, str) or len(values) != count):
            raise ValueError(f"{name}: wanted {count} entries, one for each {what}, got {len(values)}")
    for i, x in enumerate(keypoints):
        check_one_problem(**{f"keypoints[{i}]": (x, "n 2")})
        if color is not None:
            check_one_problem(**{f"keypoints[{i}]": (x, "n 2"), f"color[{i}]": (color[i].to(x.dtype), "n 3")})
    if q and not (int(pairs.min()) >= 0 and int(pairs.max()) < v):
        raise ValueError(f"pairs: wanted indices from 0 to {v - 1}, got {int(pairs.min())} to {int(pairs.max())}")
    if camera_index is not None and v and int(camera_index.min()) < 0:
        raise ValueError("camera_index: wanted numbers from 0, got a negative one")
    finite = [x.isfinite().all(-1) for x in keypoints]
    kept, rows, trust = _one_entry_a_pair(pairs, matches, weights, finite)
    named = tuple(names) if names is not None else tuple(f"image {i}" for i in range(v))
    generator = torch.Generator().manual_seed(seed)
    stages = Stages(None, False, "")
    report = progress or (lambda stage, done, total: None)
    with stages.timed("verify"), one_thread():
        report("verify", 0, len(kept))
        points = [torch.where(good[:, None], x, 0.0).double() for x, good in zip(keypoints, finite, strict=True)]
        colors = [torch.full((len(x), 3), 0.5) for x in keypoints] if color is None else color
        verified = verify_pairs(image_size, points, kept, rows, quality=trust, threshold=threshold, generator=generator)
        graph = verified.graph(named, image_size, points, [values.double() for values in colors], kept)
        report("verify", len(kept), len(kept))
    labels = [""] * v if camera_index is None else [str(k) for k in camera_index.tolist()]
    focals = list(focal) if isinstance(focal, Sequence) else [focal] * v
    return build_models(
        Given(graph, labels, focals, known_cameras=camera_index is not None),
        Wanted(camera, shared_camera, K, free_principal_point, method),
        order=named,
        generator=generator,
        stages=stages,
        progress=report,
    )


def _one_entry_a_pair(
    pairs: Int[Tensor, "q 2"],
    matches: Sequence[Int[Tensor, "_ 2"]],
    weights: Sequence[Float[Tensor, "_"]] | None,
    finite: Sequence[Tensor],
) -> tuple[Int[Tensor, "p 2"], list[Int[Tensor, "_ 2"]], list[Float[Tensor, "_"]] | None]:
    """Each pair of images once, the smaller index first, its matches the best first and none twice."""
    collected: dict[tuple[int, int], list[tuple[Tensor, Tensor]]] = {}
    for k, (i, j) in enumerate(pairs.tolist()):
        m = matches[k]
        check_one_problem(**{f"matches[{k}]": (m, "m 2: int")})
        w = torch.ones(len(m), dtype=torch.float64)
        if weights is not None:
            check_one_problem(**{f"matches[{k}]": (m, "m 2: int"), f"weights[{k}]": (weights[k], "m")})
            w = weights[k].double().nan_to_num(0)
        limit = torch.tensor([len(finite[i]), len(finite[j])])
        if len(m) and bool(((m < 0) | (m >= limit)).any()):
            raise ValueError(f"matches[{k}]: wanted indices of the {limit.tolist()} keypoints, got up to {m.amax(0).tolist()}")
        if i == j:
            raise ValueError(f"pairs: wanted two images, got image {i} twice in pair {k}")
        good = finite[i][m[:, 0]] & finite[j][m[:, 1]] & (w > 0)
        m, w = m[good].long(), w[good]
        collected.setdefault((min(i, j), max(i, j)), []).append((m if i < j else m.flip(1), w))
    kept = sorted(collected)
    rows, trust = [], []
    for pair in kept:
        m, w = (torch.cat(parts) for parts in zip(*collected[pair], strict=True))
        order = torch.argsort(w, descending=True, stable=True)
        m, w = m[order], w[order]
        _, group = torch.unique(m, dim=0, return_inverse=True)
        first = torch.full((int(group.max()) + 1 if len(group) else 0,), len(m), dtype=torch.long)
        first = first.scatter_reduce(0, group, torch.arange(len(m)), "amin").sort().values
        rows.append(m[first])
        trust.append(w[first])
    return torch.tensor(kept, dtype=torch.long).reshape(-1, 2), rows, None if weights is None else trust
