"""The measures of `python -m bench.curves`."""

from pathlib import Path

import numpy as np
import torch
from scipy.spatial import cKDTree

from bench.curves import Marks


def test_marks_are_lines_between_true_points(tmp_path: Path) -> None:
    (tmp_path / "gt-points.txt").write_text("0 0 1\n2 0 1\n0 0 3\n")
    (tmp_path / "gt-edges.txt").write_text("1\n2\n3\n1\n")
    marks = Marks.read(tmp_path, 0.01)
    assert abs(marks.length.sum() - 4) < 1e-9
    assert cKDTree(marks.X).query([[1.0, 0.0, 1.0], [0.0, 0.0, 2.5], [1.0, 0.5, 1.0]])[0].round(2).tolist() == [0, 0, 0.5]
    assert abs(marks.floor() - 1) < 0.011


def test_marks_that_images_show(tmp_path: Path) -> None:
    # Two marks on the border between dark and bright, one of which no image has inside, and one across it.
    (tmp_path / "gt-points.txt").write_text("0 -2 5\n0 2 5\n0 20 5\n0 30 5\n-2 0 5\n2 0 5\n")
    (tmp_path / "gt-edges.txt").write_text("1\n2\n3\n4\n5\n6\n")
    marks = Marks.read(tmp_path, 0.02)
    image = torch.zeros(1, 80, 100)
    image[:, :, 50:] = 1.0
    P = np.array([[50.0, 0, 49.5, 0], [0, 50.0, 39.5, 0], [0, 0, 1, 0]])
    number = marks.shown(np.stack((P, P)), [image, image])
    inside = np.abs(marks.X[:, 1]) < 2
    assert (number[(marks.line == 0) & inside] == 2).all()
    assert (number[marks.line == 1] == 0).all()
    assert number[marks.line == 2].mean() < 0.1
