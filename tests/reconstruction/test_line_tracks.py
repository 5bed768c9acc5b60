"""Tracks of lines: which segments belong to a line, and where it ends."""

import torch
from torch import Tensor

from torchsfm.geometry import Pose, intrinsics, project_points, rotation_from_rotvec
from torchsfm.reconstruction.lines.tracks import Cameras, LineTracks, ViewSegments, link_lines

F64 = torch.float64
VIEWS, LINES, NOISE = 5, 20, 0.1


def link(shown: Tensor, moved: Tensor, generator: torch.Generator) -> tuple[LineTracks, Tensor]:
    """Lines about the origin, linked.

    Args:
        shown: The stretch of each that each view shows (VIEWS, LINES, 2); none where it is empty.
        moved: Pixels by which a segment is beside its line (VIEWS, LINES).
        generator: Source of randomness.

    Returns:
        The tracks, and the ends of the lines.
    """

    def randn(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=F64)

    angle = torch.linspace(-0.5, 0.5, VIEWS, dtype=F64)
    turn = torch.stack((0.3 * torch.cos(4 * angle), angle, torch.zeros_like(angle)), -1)
    poses = Pose(rotation_from_rotvec(turn), torch.tensor([[0.0, 0.0, 4.0]], dtype=F64).repeat(VIEWS, 1))
    K = intrinsics(torch.tensor(700.0, dtype=F64), torch.tensor([320.0, 240.0], dtype=F64)).expand(VIEWS, 3, 3)
    middle = torch.stack(torch.meshgrid(torch.arange(4.0), torch.arange(5.0), indexing="ij"), -1).reshape(LINES, 2).double()
    middle = torch.cat((0.6 * middle - 1, 0.2 * randn(LINES, 1)), -1)
    # Upright: no view has it in a plane with another one's centre.
    d = torch.nn.functional.normalize(torch.tensor([0.0, 1.0, 0.0], dtype=F64) + 0.2 * randn(LINES, 3), dim=-1)
    ends = torch.stack((middle - d, middle + d), 1)
    X = ends[:, :1] + shown[..., None] * (ends[:, 1:] - ends[:, :1])
    x = project_points((K @ poses.matrix())[:, None], X)
    along = torch.nn.functional.normalize(x[:, :, 1] - x[:, :, 0], dim=-1)
    across = torch.stack((-along[..., 1], along[..., 0]), -1)
    x = x + across[:, :, None] * (moved[..., None] + NOISE * randn(VIEWS, LINES, 2))[..., None]
    there = shown[..., 1] > shown[..., 0]
    look = torch.eye(LINES, dtype=F64).expand(VIEWS, LINES, LINES)
    view, line = there.nonzero().unbind(1)
    count = there.sum(1)
    weight = torch.full((len(view),), NOISE**-2, dtype=F64)
    segments = ViewSegments(x[there], look[there], view, weight, count.cumsum(0) - count, count)
    depth = torch.tensor([[0.1, 100.0]], dtype=F64).repeat(VIEWS, 1)
    cameras = Cameras(K, poses, depth, [[j for j in range(VIEWS) if j != i] for i in range(VIEWS)])
    reference = torch.stack([(line == i).nonzero()[0, 0] for i in range(LINES)])
    return link_lines(ends, reference, segments, cameras, 3.0), ends


def whole() -> tuple[Tensor, Tensor]:
    """Every view shows all of every line."""
    shown = torch.tensor([0.0, 1.0], dtype=F64).expand(VIEWS, LINES, 2).clone()
    return shown, torch.zeros(VIEWS, LINES, dtype=F64)


def test_lines_end_where_three_views_show_them(generator: torch.Generator) -> None:
    shown, moved = whole()
    shown[:, 0] = torch.tensor([[0.0, 0.6], [0.1, 0.7], [0.2, 0.8], [0.3, 1.0], [0.35, 1.0]], dtype=F64)
    tracks, ends = link(shown, moved, generator)
    assert len(tracks.ends) == LINES
    first, last = ends[0]
    wanted = torch.stack((first + 0.2 * (last - first), first + 0.8 * (last - first)))
    gap = (tracks.ends - wanted).norm(dim=-1).amax(-1).minimum((tracks.ends - wanted.flip(0)).norm(dim=-1).amax(-1))
    assert gap.min() < 0.02


def test_what_three_views_hardly_share_is_no_line(generator: torch.Generator) -> None:
    shown, moved = whole()
    shown[:, 0] = torch.tensor([[0.0, 0.55], [0.45, 1.0], [0.4, 0.9], [0.0, 0.0], [0.0, 0.0]], dtype=F64)
    tracks, ends = link(shown, moved, generator)
    assert len(tracks.ends) == LINES - 1
    gap = (tracks.ends.mean(1) - ends[0].mean(0)).norm(dim=-1)
    assert gap.min() > 0.3


def test_segments_farther_off_than_noise_are_of_no_line(generator: torch.Generator) -> None:
    shown, moved = whole()
    # Within the tolerance, and not within the noise: one of five views, and one of three.
    moved[3, 0] = moved[2, 1] = 1.5
    shown[3:, 1] = 0
    tracks, _ = link(shown, moved, generator)
    assert len(tracks.ends) == LINES - 1
    view_of = torch.bincount(tracks.line)
    assert int((view_of == VIEWS).sum()) == LINES - 2
    assert int((view_of == VIEWS - 1).sum()) == 1
    # Segments are numbered view by view.
    assert 3 * LINES not in tracks.segment.tolist()


def test_cameras_less_certain_than_segments_widen_what_belongs_together(generator: torch.Generator) -> None:
    shown, moved = whole()
    moved = 0.5 * torch.randn(moved.shape, generator=generator, dtype=F64)
    tracks, _ = link(shown, moved, generator)
    assert len(tracks.ends) >= 0.9 * LINES
    assert len(tracks.segment) >= 0.9 * VIEWS * LINES
