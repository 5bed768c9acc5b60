"""Figures hold what they were given; warnings are errors, also when drawing."""

import builtins
from typing import Any

import numpy as np
import pytest
import torch
from chance import seeded
from torch import Tensor

from torchsfm.geometry import Pose
from torchsfm.images import Photograph
from torchsfm.plot import (
    plot_cameras,
    plot_epipolar_lines,
    plot_lines_3d,
    plot_matches,
    plot_points_2d,
    plot_points_3d,
    plot_residuals,
    plot_tracks,
    show_image,
    show_scaled,
)
from torchsfm.plot.flat import clip_lines
from torchsfm.reconstruction.model.reconstruction import Reconstruction
from torchsfm.simulation import look_at
from torchsfm.tensors import fundamental_from_pose


def draw(ax: Any) -> None:
    ax.figure.canvas.draw()


def new_axes(**kw: Any) -> Any:
    import matplotlib.pyplot as plt

    return plt.figure().add_subplot(**kw)


def segments_of(ax: Any) -> np.ndarray:
    return np.concatenate([np.asarray(c._segments3d) for c in ax.collections if hasattr(c, "_segments3d")])


@pytest.mark.parametrize("shape", [(4, 6), (1, 4, 6), (3, 4, 6)])
def test_show_image_puts_pixel_centres_at_integers(shape: tuple[int, ...]) -> None:
    image = torch.linspace(-0.2, 1.2, torch.Size(shape).numel()).reshape(shape)
    ax = show_image(image, title="t")
    draw(ax)
    (shown,) = ax.images
    values = np.asarray(shown.get_array())
    expected = image.clamp(0, 1).reshape(-1, 4, 6)
    assert np.allclose(values, expected.permute(1, 2, 0).numpy() if shape[0] == 3 else expected[0].numpy())
    assert tuple(shown.get_extent()) == (-0.5, 5.5, 3.5, -0.5)
    assert shown.get_clim() == (0, 1)
    assert ax.get_title() == "t"


def test_photographs_are_shown_as_their_pixels_are() -> None:
    pixels, x = torch.rand(3, 4, 5), torch.tensor([[1.0, 2.0]])
    photograph = Photograph(pixels, "a.png")
    for draw in (
        show_image,
        lambda image: plot_matches(image, image, x, x),
        lambda image: plot_epipolar_lines(torch.eye(3), x, x, image, image)[1],
    ):
        first, second = (draw(image).images[0].get_array() for image in (photograph, pixels))
        assert (first == second).all()


def test_show_scaled_stretches_and_says_the_range() -> None:
    matrix = torch.tensor([[-3.0, 1.0], [5.0, torch.nan]])
    ax = show_scaled(matrix)
    draw(ax)
    assert np.allclose(np.asarray(ax.images[0].get_array()), [[0, 0.5], [1, 0.375]])
    assert ax.get_title() == "-3 ... 5"
    assert np.allclose(np.asarray(show_scaled(matrix, low=0.0, high=2.0).images[0].get_array()), [[0, 0.5], [1, 0]])


def test_points_are_drawn_where_visible_and_finite() -> None:
    x = torch.arange(12.0).reshape(2, 3, 2)
    x[1, 2, 0] = torch.inf
    visible = torch.tensor([[True, False, True], [True, True, True]])
    ax = plot_points_2d(x, visible=visible, marker="o")
    draw(ax)
    assert [line.get_xydata().tolist() for line in ax.lines] == [[[0, 1], [4, 5]], [[6, 7], [8, 9]]]
    assert ax.yaxis_inverted()
    over = show_image(torch.rand(20, 30))
    assert plot_points_2d(x, ax=over) is over
    assert over.yaxis_inverted()


def test_matches_join_their_points() -> None:
    x1, x2 = torch.rand(10, 2) * 20, torch.rand(10, 2) * 20
    inliers = torch.arange(10) < 7
    ax = plot_matches(torch.rand(3, 20, 30), torch.rand(25, 24), x1, x2, inliers=inliers)
    draw(ax)
    assert ax.images[0].get_array().shape[:2] == (25, 54)
    red, green = (np.asarray(c.get_segments()) for c in ax.collections)
    expected = torch.stack((x1, x2 + torch.tensor([30.0, 0.0])), 1)
    assert np.allclose(green, expected[:7].numpy())
    assert np.allclose(red, expected[7:].numpy())
    thin = plot_matches(torch.rand(20, 30), torch.rand(20, 30), x1, x2, every=3)
    draw(thin)
    assert sum(len(c.get_segments()) for c in thin.collections) == 4
    draw(plot_matches(torch.rand(20, 30), torch.rand(20, 30), x1[:0], x2[:0]))


def test_epipolar_lines_pass_through_their_points() -> None:
    dtype = torch.float64
    poses = look_at(torch.tensor([[0.0, 0.0, -4.0], [1.0, 0.5, -4.0]], dtype=dtype), torch.zeros(3, dtype=dtype))
    K = torch.tensor([[100.0, 0, 50], [0, 100, 40], [0, 0, 1]], dtype=dtype)
    relative = poses[1] @ poses[0].inverse()
    F = fundamental_from_pose(relative.R, relative.t, K, K)
    X = torch.randn(6, 3, dtype=dtype, generator=seeded()) * 0.4
    x = poses.transform(X) @ K.mT
    x1, x2 = x[..., :2] / x[..., 2:]
    first, second = plot_epipolar_lines(F, x1, x2, torch.rand(80, 100), torch.rand(3, 80, 100))
    draw(first)
    for ax, points in ((first, x1), (second, x2)):
        lines = [line.get_xydata() for line in ax.lines]
        segments, dots = [p for p in lines if len(p) == 2], [p for p in lines if len(p) == 1]
        assert len(segments) == len(dots) == 6
        assert np.allclose(np.concatenate(dots), points.numpy())
        for (a, b), p in zip(segments, points.numpy(), strict=True):
            n = np.array([a[1] - b[1], b[0] - a[0]])
            assert abs((p - a) @ n) / np.linalg.norm(n) < 1e-6
        assert ax.get_xlim() == (-0.5, 99.5)


def test_lines_are_clipped_to_the_image() -> None:
    lines = torch.tensor(
        [[0.0, 1, -5], [1, 0, -3], [1, -1, 0], [0, 1, 5], [0, 0, 1], [torch.nan, 1, 0], [1, 1, -100], [2, 2, -12]],
        dtype=torch.float64,
    )
    ends, meets = clip_lines(lines, 20, 10)
    assert meets.tolist() == [True, True, True, False, False, False, False, True]
    assert torch.isfinite(ends).all()

    def as_set(pair: Tensor) -> set[tuple[float, ...]]:
        return {tuple(round(v, 9) + 0.0 for v in p) for p in pair.tolist()}

    assert as_set(ends[0]) == {(-0.5, 5.0), (19.5, 5.0)}
    assert as_set(ends[1]) == {(3.0, -0.5), (3.0, 9.5)}
    assert as_set(ends[2]) == {(-0.5, -0.5), (9.5, 9.5)}
    assert as_set(ends[7]) == {(-0.5, 6.5), (6.5, -0.5)}


def test_points_in_space_leave_out_the_wild_ones() -> None:
    X = torch.randn(2, 50, 3, generator=seeded())
    X[0, 0], X[1, 3, 0] = 1e6, torch.nan
    ax = plot_points_3d(X, color=torch.rand(2, 50, 3), share=0.95)
    draw(ax)
    (dots,) = ax.collections
    assert len(dots._offsets3d[0]) == 95
    assert max(abs(v) for v in (*ax.get_xlim(), *ax.get_ylim(), *ax.get_zlim())) < 20
    draw(plot_points_3d(X[:, 10:], color="k"))
    draw(plot_points_3d(X[0, :0]))


def test_cameras_are_pyramids_with_their_apex_at_the_centre(model: Reconstruction) -> None:
    keep = model.registered
    poses = model.poses[keep]
    names = [name for name, k in zip(model.names, keep.tolist(), strict=True) if k]
    cameras = model.cameras[model.camera_index[keep]]
    ax = plot_cameras(poses, cameras, model.image_size[keep], names=names, size=0.5)
    draw(ax)
    segments = segments_of(ax).reshape(4, 9, 2, 3)
    assert np.allclose(segments[:, :4, 1], poses.centre.numpy()[:, None])
    # The corners project back to the corners of the image.
    corners = poses.transform(torch.from_numpy(segments[:, :4, 0]).double()) @ cameras.K.mT
    x = corners[..., :2] / corners[..., 2:]
    assert np.allclose(x[0].numpy(), [[-0.5, -0.5], [639.5, -0.5], [639.5, 479.5], [-0.5, 479.5]])
    assert np.allclose(corners[..., 2].numpy(), 0.5)
    # The tick is above the image, where y is negative.
    tick = poses.transform(torch.from_numpy(segments[:, 8]).double())[..., 1]
    assert (tick[:, 1] < tick[:, 0]).all()
    assert [t.get_text() for t in ax.texts] == names


def test_cameras_alone_and_over_points() -> None:
    draw(plot_cameras(Pose.identity(dtype=torch.float64)))
    draw(plot_cameras(Pose.identity(0, dtype=torch.float64)))
    ax = plot_points_3d(torch.randn(100, 3, dtype=torch.float64) * 10)
    assert plot_cameras(Pose.identity(3, dtype=torch.float64), ax=ax) is ax
    draw(ax)
    depth = np.abs(segments_of(ax)[..., 2]).max()
    assert 1 < depth < 10, "about 6 % of the extent of the points"


def test_tracks_run_through_the_images() -> None:
    view = torch.tensor([0, 1, 2, 2, 0, 1])
    track = torch.tensor([7, 7, 7, 3, 3, 9])
    x = torch.arange(12.0).reshape(6, 2)
    ax = plot_tracks(x, view, track, image_size=(64, 48))
    draw(ax)
    lines = [np.asarray(s).tolist() for c in ax.collections if hasattr(c, "_segments3d") for s in c._segments3d]
    assert sorted(lines, key=len) == [[[1, 10, 11]], [[0, 8, 9], [2, 6, 7]], [[0, 0, 1], [1, 2, 3], [2, 4, 5]]]
    assert ax.get_zlim() == (47.5, -0.5)
    draw(plot_tracks(x[:0], view[:0], track[:0]))


def test_residuals_of_an_image(model: Reconstruction) -> None:
    figure = plot_residuals(model, "view_1.png", pixels=torch.rand(480, 640))
    figure.canvas.draw()
    left, right = figure.axes[:2]
    own = model.view == 1
    (quiver,) = left.collections
    vectors = np.stack((quiver.U, quiver.V), -1)
    assert np.allclose(quiver.XY, model.x[own].numpy())
    assert np.allclose(vectors, (model.projections() - model.x)[own].numpy())
    assert sum(bar.get_height() for bar in right.patches) == int(own.sum())
    rms = float(model.residuals()[own].square().mean().sqrt())
    assert f"rms {rms:.3g} px" in right.get_title()
    import matplotlib.pyplot as plt

    axes = plt.subplots(1, 2)[1]
    assert plot_residuals(model, 0, axes=tuple(axes), magnify=3.0) is axes[0].figure


def test_figures_are_left_open_for_the_caller(model: Reconstruction) -> None:
    import matplotlib.pyplot as plt

    mine = plt.figure()
    show_image(torch.rand(4, 4))
    plot_residuals(model, 0)
    assert len(plt.get_fignums()) == 3
    ax = mine.add_subplot()
    show_image(torch.rand(4, 4), ax=ax)
    assert len(plt.get_fignums()) == 3


def test_wrong_arguments(model: Reconstruction, unchecked: None) -> None:
    x = torch.rand(5, 2)
    image = torch.rand(8, 8)
    with pytest.raises(ValueError, match="image: wanted shape"):
        show_image(torch.rand(2, 8, 8))
    with pytest.raises(ValueError, match="image: wanted shape"):
        show_scaled(torch.rand(3, 8, 8))
    with pytest.raises(ValueError, match="x2: wanted n = 5"):
        plot_matches(image, image, x, x[:3])
    with pytest.raises(ValueError, match="every: wanted"):
        plot_matches(image, image, x, x, every=0)
    with pytest.raises(ValueError, match="share: wanted"):
        plot_points_3d(torch.rand(5, 3), share=0.0)
    with pytest.raises(ValueError, match="ax: wanted 3D axes"):
        plot_points_3d(torch.rand(5, 3), ax=new_axes())
    with pytest.raises(ValueError, match="names: wanted 2"):
        plot_cameras(Pose.identity(2), names=["one"])
    with pytest.raises(ValueError, match=r"'view_3\.png' is not registered"):
        plot_residuals(model, 3)
    with pytest.raises(ValueError, match=r"no image named 'x\.png'"):
        plot_residuals(model, "x.png")
    with pytest.raises(ValueError, match=r"wanted a number in 0 \.\.\. 4"):
        plot_residuals(model, 5)


def test_without_matplotlib_the_error_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    real = builtins.__import__

    def absent(name: str, *args: Any, **kwargs: Any) -> Any:
        if name.split(".")[0] == "matplotlib":
            raise ImportError(name)
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", absent)
    with pytest.raises(ImportError, match=r"pip install 'torchsfm\[plot\]'"):
        show_image(torch.rand(4, 4))


def test_lines_in_space_are_drawn_where_they_are(generator: torch.Generator) -> None:
    ends, color = torch.randn(2, 6, 2, 3, generator=generator), torch.rand(2, 6, 3, generator=generator)
    ends[1, 2, 0, 1] = torch.nan
    ax = plot_lines_3d(ends, color=color)
    draw(ax)
    good = ends.isfinite().flatten(2).all(-1)
    assert np.allclose(segments_of(ax), ends[good].numpy())
    shown = next(c for c in ax.collections if hasattr(c, "_segments3d"))
    assert np.allclose(np.asarray(shown.get_colors())[:, :3], color[good].numpy())
    assert ax.get_xlim3d()[0] <= float(ends[good][..., 0].min())
    draw(plot_lines_3d(ends[:, :0]))
    draw(plot_lines_3d(ends[0], color="k", linewidths=2, ax=ax))
