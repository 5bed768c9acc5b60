"""From image points whose correspondence is known to finished models."""

from collections.abc import Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchsfm._types import check_one_problem, check_options
from torchsfm.linalg.devices import on_the_cpu
from torchsfm.reconstruction.mappers.growth import Given, Wanted
from torchsfm.reconstruction.matching.stages import Stages
from torchsfm.reconstruction.matching.track_graph import graph_from_tracks
from torchsfm.reconstruction.messages import Progress
from torchsfm.reconstruction.models import build_models
from torchsfm.reconstruction.report import SfmResult


@on_the_cpu
def reconstruct_tracks(
    x: Float[Tensor, "n 2"],
    view: Int[Tensor, "n"],
    track: Int[Tensor, "n"],
    image_size: Int[Tensor, "v 2"],
    *,
    names: Sequence[str] | None = None,
    color: Float[Tensor, "n 3"] | None = None,
    camera: str | None = None,
    shared_camera: bool | None = None,
    K: Float[Tensor, "3 3"] | None = None,
    focal: float | None = None,
    free_principal_point: bool = True,
    method: str = "auto",
    seed: int = 0,
    progress: Progress | None = None,
) -> SfmResult:
    """Reconstruct from image points whose correspondence is known.

    Args:
        x: Image points in pixels.
        view: Image of each point, from 0.
        track: Scene point of each image point, from 0; wrong ones are sorted out.
        image_size: Width and height of each image in pixels.
        names: Names of the images.
        color: Colours of the image points in [0, 1].
        camera: Distortion model, see `reconstruct`.
        shared_camera: Whether all images of one size share a camera, as they do by default unless pairs and models say that
            their focal lengths differ.
        K: Known intrinsics of all images.
        focal: First guess of the focal length in pixels, which is then adjusted; one that the images refute is not used.
        free_principal_point: Estimate the principal point too.
        method: "incremental", "projective", "global", "windows" or "auto", see `reconstruct`.
        seed: The same seed gives the same model.
        progress: Called as images are registered.

    Returns:
        The models, the largest first, and a report.

    Raises:
        ValueError: Shapes disagree or an index is out of range.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> X, poses = torchsfm.random_points(60, generator=g), torchsfm.random_poses(3, generator=g)
        >>> K = torchsfm.intrinsics(torch.tensor(900.0), torch.tensor([499.5, 374.5])).double()
        >>> x = torchsfm.project_points(K @ poses.matrix(), X).flatten(0, 1)
        >>> view, track = torch.arange(3).repeat_interleave(60), torch.arange(60).repeat(3)
        >>> found = torchsfm.reconstruct_tracks(x, view, track, torch.tensor([[1000, 750]] * 3), K=K)
        >>> found.model.num_registered, found.model.num_points, found.report.images[0].model
        (3, 60, 0)
    """
    check_one_problem(x=(x, "n 2"), view=(view, "n: int"), track=(track, "n: int"), image_size=(image_size, "v 2: int"))
    check_one_problem(color=(color, "?n 3"))
    check_one_problem(K=(K, "?3 3"))
    check_options(
        names=(names, Sequence | None), focal=(focal, "?float > 0"), seed=(seed, "int"), camera=(camera, str | None),
        shared_camera=(shared_camera, bool | None),
    )  # fmt: skip
    v = len(image_size)
    if names is not None and (isinstance(names, str) or len(names) != v or not all(isinstance(n, str) for n in names)):
        raise ValueError(f"names: wanted {v} strings, one an image, got {names!r}")
    if len(view) and not (int(view.min()) >= 0 and int(view.max()) < v):
        raise ValueError(f"view: wanted indices from 0 to {v - 1}, got {int(view.min())} to {int(view.max())}")
    if len(track) and int(track.min()) < 0:
        raise ValueError("track: wanted numbers from 0, got a negative one")
    named = tuple(names) if names is not None else tuple(f"image {i}" for i in range(v))
    generator = torch.Generator().manual_seed(seed)
    finite = x.isfinite().all(-1)
    color = torch.full((len(x), 3), 0.5) if color is None else color
    graph, tracks = graph_from_tracks(
        named,
        image_size,
        x[finite].double(),
        view[finite],
        torch.unique(track[finite], return_inverse=True)[1],
        color[finite].double(),
        generator=generator,
    )
    return build_models(
        Given(graph, [""] * v, [focal] * v, tracks),
        Wanted(camera, shared_camera, K, free_principal_point, method),
        order=named,
        generator=generator,
        stages=Stages(None, False, ""),
        progress=progress or (lambda stage, done, total: None),
    )
