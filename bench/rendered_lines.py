"""Lines of rendered photographs, by true cameras: which part of their length lies on surfaces?

`python -m bench.rendered_lines [--seeds 0 1 2 3]` prints a row a scene and their sum. Points are seen with noise of 0.2 px. A
place of a line is right where a view that shows the line has a surface there, within 1 % of its depth and two pixels; a line is
wrong where most of it is not. Even seeds look down on a courtyard, those of odd ones go around it at one height.
"""

import argparse
import tempfile
import time
from dataclasses import replace

import torch
from torch import Tensor

from torchsfm import orbit_poses, render_sequence
from torchsfm.reconstruction.lines.find_lines import FoundSegments, find_lines
from torchsfm.reconstruction.mapping.mapping import Mapping
from torchsfm.reconstruction.matching.segments import detect_all_segments
from torchsfm.reconstruction.matching.track_graph import graph_from_tracks
from torchsfm.reconstruction.model.lines import Lines
from torchsfm.simulation import RenderedSequence

VIEWS, WIDTH, HEIGHT, NOISE = 12, 960, 720, 0.2
NEAR, PIXELS, SAMPLES = 0.01, 2, 41


def lines_of(scene: RenderedSequence, generator: torch.Generator) -> tuple[Lines, float]:
    """The lines of a scene, and CPU seconds to find them among its segments."""
    view, point = scene.visible.nonzero().unbind(1)
    x = scene.x[view, point] + NOISE * torch.randn(len(view), 2, generator=generator, dtype=scene.x.dtype)
    color = torch.ones(len(view), 3, dtype=x.dtype)
    names, size = tuple(str(i) for i in range(VIEWS)), torch.tensor([[WIDTH, HEIGHT]] * VIEWS)
    graph, track = graph_from_tracks(names, size, x, view, point, color, generator=generator)
    start = Mapping.start(graph, track, scene.cameras[:1], torch.zeros(VIEWS, dtype=torch.long))
    mapping = replace(start, poses=scene.poses, registered=torch.ones(VIEWS, dtype=torch.bool), X=scene.X, point=track)
    with tempfile.TemporaryDirectory() as folder:
        found = FoundSegments.of(detect_all_segments(scene.save(folder), WIDTH * HEIGHT, lambda *_: None))
    begin = time.process_time()
    _, lines = find_lines(mapping, found, None)
    return lines, time.process_time() - begin


def share_on_surfaces(scene: RenderedSequence, lines: Lines) -> Tensor:
    """Share of each line (l) that a view that shows it sees on a surface."""
    s = torch.linspace(0, 1, SAMPLES, dtype=lines.ends.dtype)[:, None]
    X = lines.ends[:, :1] * (1 - s) + lines.ends[:, 1:] * s
    gap = torch.full(X.shape[:2], torch.inf, dtype=X.dtype)
    around = torch.cartesian_prod(*[torch.arange(-PIXELS, PIXELS + 1)] * 2)
    for i in range(VIEWS):
        shown = torch.unique(lines.line[lines.view == i])
        seen = scene.poses[i].transform(X[shown].flatten(0, 1))
        at = scene.cameras[i].project(seen).round().long()[:, None] + around
        inside = ((at >= 0) & (at < torch.tensor([WIDTH, HEIGHT]))).all(-1)
        column, row = torch.where(inside[..., None], at, 0).unbind(-1)
        off = torch.where(inside, (seen[:, None, 2] / scene.depth[i][row, column] - 1).abs(), torch.inf).amin(-1)
        gap[shown] = gap[shown].minimum(off.reshape(len(shown), SAMPLES))
    return (gap < NEAR).to(X.dtype).mean(1)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="*", default=[0, 1, 2, 3])
    options = parser.parse_args()
    torch.set_num_threads(1)
    print("seed  lines  wrong  length on surfaces  beside  CPU s")
    total = torch.zeros(5, dtype=torch.float64)
    for seed in options.seeds:
        generator = torch.Generator().manual_seed(seed)
        level = orbit_poses(VIEWS, radius=5.2, height=(1.2, 1.5), sweep=2.0, start=-2.4, target=(0.0, 0.0, 0.7))
        poses = level if seed % 2 else None
        scene = render_sequence(views=VIEWS, width=WIDTH, height=HEIGHT, poses=poses, generator=generator)
        lines, seconds = lines_of(scene, generator)
        share, length = share_on_surfaces(scene, lines), (lines.ends[:, 1] - lines.ends[:, 0]).norm(dim=1)
        wrong = float((share < 0.5).sum())
        row = [len(lines), wrong, float((length * share).sum()), float((length * (1 - share)).sum()), seconds]
        total += torch.tensor(row, dtype=torch.float64)
        print("{:4}  {:5.0f}  {:5.0f}  {:18.2f}  {:6.2f}  {:5.1f}".format(seed, *row), flush=True)
    print(" all  {:5.0f}  {:5.0f}  {:18.2f}  {:6.2f}  {:5.1f}".format(*total.tolist()))


if __name__ == "__main__":
    main()
