import math
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from chance import numpy_seeded
from torch import Tensor

from torchsfm.images import Photograph, Tracks, detect_corners, read_image, track_points, track_sequence


def texture(seed: int, size: int = 900) -> np.ndarray:
    rng = numpy_seeded(seed)
    image = sum(cv2.GaussianBlur(rng.standard_normal((size, size)), (0, 0), s) * s for s in (2, 4, 8, 16))
    return ((image - image.min()) / np.ptp(image)).astype(np.float32)


def view(canvas: np.ndarray, A: np.ndarray, b: np.ndarray, width: int = 320, height: int = 240) -> Tensor:
    """The canvas seen so that canvas point X is at A X + b; bilinear, as common cubic kernels bend ramps."""
    y, x = np.mgrid[:height, :width].astype(np.float64)
    points = (np.stack([x, y], -1) - b) @ np.linalg.inv(A).T
    grid = torch.from_numpy(points / (canvas.shape[0] - 1) * 2 - 1)[None]
    image = torch.from_numpy(canvas).double()[None, None]
    image = torch.nn.functional.grid_sample(image, grid, mode="bilinear", padding_mode="reflection", align_corners=True)
    return image[0].clamp(0, 1).float()


def turn(degrees: float, zoom: float = 1.0) -> np.ndarray:
    a = math.radians(degrees)
    return zoom * np.array([[math.cos(a), -math.sin(a)], [math.sin(a), math.cos(a)]])


def inside(x: Tensor, margin: float, width: int = 320, height: int = 240) -> Tensor:
    return ((x > margin) & (x < torch.tensor([width - 1.0, height - 1.0]) - margin)).all(-1)


@pytest.mark.parametrize(
    ("A", "shift", "most"),
    [
        (turn(0), (0.37, -0.62), 0.03),
        (turn(0), (21.3, -14.7), 0.03),
        (turn(4), (3.0, 5.0), 0.2),  # a square that does not turn with the image
        (turn(0, 1.06), (-4.0, 2.0), 0.15),
    ],
)
def test_points_are_followed_to_a_fraction_of_a_pixel(A: np.ndarray, shift: tuple[float, float], most: float) -> None:
    canvas = texture(0)
    middle = np.array([450.0, 450.0])
    first = view(canvas, np.eye(2), np.array([160.0, 120.0]) - middle)
    second = view(canvas, A, np.array([160.0, 120.0]) + shift - A @ middle)
    x1 = detect_corners(first, 200).x
    expected = torch.from_numpy((x1.numpy() - [160.0, 120.0]) @ A.T + [160.0, 120.0] + shift).float()
    seen = inside(expected, 12) & inside(x1, 12)
    tracked = track_points(first, second, x1)
    error = (tracked.x - expected).norm(dim=1)[tracked.valid & seen]
    assert int(seen.sum()) > 40
    assert len(error) > 0.9 * int(seen.sum())
    assert float(error.median()) < most
    assert float((error < 5 * most).float().mean()) > 0.97
    # What leaves the image, and what was never in it, is known to be lost.
    assert not bool((tracked.valid & ~inside(expected, -1)).any())


def test_a_guess_reaches_farther() -> None:
    canvas = texture(1)
    first = view(canvas, np.eye(2), np.array([-300.0, -300.0]))
    second = view(canvas, np.eye(2), np.array([-400.0, -300.0]))
    x1 = detect_corners(first, 100).x
    x1 = x1[inside(x1 - torch.tensor([100.0, 0.0]), 10)]
    blind = track_points(first, second, x1, levels=3)
    led = track_points(first, second, x1, guess=x1 + torch.tensor([-97.0, 2.0]), levels=3)
    right = (led.x - x1 - torch.tensor([-100.0, 0.0])).norm(dim=1) < 0.1
    assert bool((led.valid & right).float().mean() > 0.9)
    assert float((blind.valid & ((blind.x - led.x).norm(dim=1) < 0.1)).float().mean()) < 0.2


def test_hidden_points_are_lost() -> None:
    canvas = texture(2)
    first = view(canvas, np.eye(2), np.array([-300.0, -300.0]))
    second = view(canvas, np.eye(2), np.array([-302.0, -300.0]))
    second[:, :, 160:] = view(texture(3), np.eye(2), np.array([-300.0, -300.0]))[:, :, 160:]
    x1 = detect_corners(first, 200).x
    tracked = track_points(first, second, x1)
    hidden = x1[:, 0] > 175
    assert float(tracked.valid[hidden].float().mean()) < 0.2
    assert float(tracked.valid[x1[:, 0] < 145].float().mean()) > 0.9


@pytest.mark.parametrize("shape", [(), (1,), (2, 3), (0,)])
def test_a_batch_is_its_elements(shape: tuple[int, ...]) -> None:
    canvas = texture(4)
    first = view(canvas, np.eye(2), np.array([-300.0, -300.0]))
    offsets = [np.array([-300.0 + k, -300.0 - 2 * k]) for k in range(math.prod(shape))]
    seconds = torch.stack([view(canvas, np.eye(2), b) for b in offsets]) if offsets else torch.zeros(0, 1, 240, 320)
    x1 = detect_corners(first, 20).x.double()
    tracked = track_points(first, seconds.reshape(*shape, 1, 240, 320), x1)
    assert tracked.x.shape == (*shape, 20, 2)
    assert tracked.x.dtype == torch.float64
    assert tracked.valid.shape == tracked.error.shape == (*shape, 20)
    for index in np.ndindex(*shape):
        alone = track_points(first, seconds.reshape(*shape, 1, 240, 320)[index], x1)
        for name in ("x", "valid", "error"):
            assert torch.equal(getattr(tracked, name)[index], getattr(alone, name))
    # Colour, and batch dimensions on the other side, as well.
    other = track_points(seconds.reshape(*shape, 1, 240, 320).expand(*shape, 3, 240, 320), first.expand(3, -1, -1), x1)
    assert other.x.shape == (*shape, 20, 2)


def test_senseless_points_are_not_valid_and_finite() -> None:
    canvas = texture(5)
    image = view(canvas, np.eye(2), np.array([-300.0, -300.0]))
    x1 = torch.tensor([[100.0, 100.0], [torch.nan, 5.0], [torch.inf, 5.0], [-3.0, 5.0], [500.0, 5.0], [200.0, 90.0]])
    tracked = track_points(image, image, x1)
    assert tracked.valid.tolist() == [True, False, False, False, False, True]
    assert bool(tracked.x.isfinite().all())
    assert bool(tracked.error.isfinite().all())
    assert float((tracked.x - x1)[tracked.valid].abs().max()) < 0.01
    assert track_points(image, image, x1[:0]).x.shape == (0, 2)
    flat = track_points(torch.zeros(1, 50, 50), torch.zeros(1, 50, 50), torch.tensor([[20.0, 20.0]]))
    assert not bool(flat.valid.any())


@pytest.mark.usefixtures("unchecked")
def test_errors_name_the_argument() -> None:
    image, x = torch.zeros(1, 50, 60), torch.zeros(3, 2)
    with pytest.raises(ValueError, match="image2"):
        track_points(image, torch.zeros(1, 60, 50), x)
    with pytest.raises(ValueError, match="x1"):
        track_points(image, image, torch.zeros(3, 3))
    with pytest.raises(ValueError, match="x1: wanted device"):
        track_points(image, image, x.to("meta"))
    with pytest.raises(ValueError, match="window"):
        track_points(image, image, x, window=2)
    with pytest.raises(ValueError, match="frame 1 has size"):
        track_sequence([image, torch.zeros(1, 60, 50)])


def move(k: int) -> tuple[np.ndarray, np.ndarray]:
    """Where frame k sees the canvas: turning, coming nearer and sliding, several pixels a frame."""
    A = turn(1.5 * k, 1.015**k)
    return A, np.array([160.0 + 2.3 * k, 120.0 - 1.7 * k]) - A @ [450.0, 450.0]


def drift(tracks: Tracks, poses: list[tuple[np.ndarray, np.ndarray]]) -> tuple[Tensor, Tensor]:
    """How far each sighting is from where the track's first one should have moved, and how many frames on."""
    A, b = (torch.from_numpy(np.stack(parts)) for parts in zip(*poses, strict=True))
    x = tracks.x.double()
    canvas = torch.linalg.solve(A[tracks.frame], (x - b[tracks.frame])[..., None])[..., 0]
    start = torch.ones(len(x), dtype=torch.bool)
    start[1:] = tracks.track[1:] != tracks.track[:-1]
    first = canvas[start][tracks.track]
    expected = (A[tracks.frame] @ first[..., None])[..., 0] + b[tracks.frame]
    return (x - expected).norm(dim=1), tracks.frame - tracks.frame[start][tracks.track]


def test_sequences_are_followed_without_drift() -> None:
    canvas = texture(6)
    poses = [move(k) for k in range(16)]
    done: list[int] = []
    tracks = track_sequence((view(canvas, A, b) for A, b in poses), max_points=150, progress=done.append)
    error, age = drift(tracks, poses)
    assert done == list(range(1, 17))
    assert len(tracks) > 100
    assert int((age >= 12).sum()) > 100
    assert float(error[age == 1].median()) < 0.05
    assert float(error[age >= 12].median()) < 0.15
    assert float((error < 1).float().mean()) > 0.98


def test_tracks_are_sorted_unique_and_spread() -> None:
    canvas = texture(7)
    poses = [move(k) for k in range(8)]
    frames = [Photograph(view(canvas, A, b), str(k)) for k, (A, b) in enumerate(poses)]
    tracks = track_sequence(frames, max_points=100, min_length=4)
    key = tracks.track * 100 + tracks.frame
    assert bool((key.diff() > 0).all())
    assert torch.equal(torch.unique(tracks.track), torch.arange(len(tracks)))
    assert int(torch.bincount(tracks.track).min()) >= 4
    assert bool((tracks.frame.diff()[tracks.track.diff() == 0] == 1).all())
    assert bool(inside(tracks.x, -1e-6).all())
    again = track_sequence(frames, max_points=100, min_length=4)
    assert torch.equal(again.x, tracks.x)
    # New points come up where the view opens onto new ground.
    assert int((tracks.frame == 7).sum()) > 0.5 * int((tracks.frame == 3).sum())
    for k in range(8):
        x = tracks.x[tracks.frame == k]
        assert float(torch.cdist(x, x).fill_diagonal_(torch.inf).min()) > 0.5


def test_changing_light_is_no_motion() -> None:
    canvas = texture(8)
    poses = [move(0.3 * k) for k in range(8)]
    frames = [view(canvas, A, b) * (0.9 - 0.06 * k) + 0.02 * k for k, (A, b) in enumerate(poses)]
    tracks = track_sequence(frames, max_points=100)
    error, age = drift(tracks, poses)
    assert int((age == 7).sum()) > 30
    assert float(error[age == 7].median()) < 0.1


def test_a_cut_ends_all_tracks() -> None:
    one, other = texture(9), texture(10)
    frames = [view(one, *move(k)) for k in range(4)] + [view(other, *move(k)) for k in range(4)]
    tracks = track_sequence(frames, max_points=100)
    before, after = (torch.unique(tracks.track[side]) for side in (tracks.frame < 4, tracks.frame >= 4))
    assert len(before) > 30
    assert len(after) > 30
    assert not set(before.tolist()) & set(after.tolist())


def test_frames_without_anything_to_follow() -> None:
    assert len(track_sequence([])) == 0
    empty = track_sequence([torch.zeros(1, 60, 80)] * 3)
    assert len(empty) == 0
    assert empty.x.shape == (0, 2)
    canvas = texture(11)
    frames = [view(canvas, *move(k)) for k in range(3)]
    lost = track_sequence([*frames, torch.zeros(1, 240, 320), torch.full((1, 240, 320), torch.nan), *frames], max_points=50)
    assert set(lost.frame.tolist()) == {0, 1, 2, 5, 6, 7}
    assert bool(lost.x.isfinite().all())


def test_a_real_turntable(data: Path) -> None:
    folder = data / "images" / "temple_ring"
    cameras = {}
    for line in (folder / "templeR_par.txt").read_text().splitlines()[1:]:
        name, *numbers = line.split()
        values = torch.tensor([float(n) for n in numbers], dtype=torch.float64)
        cameras[name] = values[:9].reshape(3, 3), values[9:18].reshape(3, 3), values[18:]
    names = [f"templeR{k:04d}.png" for k in range(14, 22)]
    tracks = track_sequence(read_image(folder / name, gray=True) for name in names)
    start = torch.ones(len(tracks.x), dtype=torch.bool)
    start[1:] = tracks.track[1:] != tracks.track[:-1]
    first, begun = tracks.x[start][tracks.track], tracks.frame[start][tracks.track]
    errors, ages = [], []
    for i in range(8):
        for j in range(i + 1, 8):
            rows = (begun == i) & (tracks.frame == j)
            (K1, R1, t1), (K2, R2, t2) = cameras[names[i]], cameras[names[j]]
            R = R2 @ R1.mT
            t = t2 - R @ t1
            cross = torch.tensor([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]], dtype=torch.float64)
            F = torch.linalg.inv(K2).mT @ cross @ R @ torch.linalg.inv(K1)
            x1, x2 = (torch.nn.functional.pad(x[rows].double(), (0, 1), value=1) for x in (first, tracks.x))
            l2, l1 = x1 @ F.mT, x2 @ F
            errors.append((x2 * l2).sum(1).abs() / (l1[:, :2].square().sum(1) + l2[:, :2].square().sum(1)).sqrt())
            ages.append(torch.full_like(errors[-1], j - i))
    error, age = torch.cat(errors), torch.cat(ages)
    assert len(tracks) > 400
    assert float(error[age == 1].median()) < 0.1
    assert float(error[age >= 3].median()) < 0.2
    assert float((error < 1).double().mean()) > 0.9
