"""Frames of films: which are taken, that they are there all or none, and what is no film."""

from pathlib import Path

import numpy as np
import pytest
import torch
from chance import numpy_seeded

from torchsfm.images import ImageError, extract_frames, list_images, read_image

cv2 = pytest.importorskip("cv2")
WIDTH, HEIGHT, RATE = 160, 120, 10


def blurred(frames: int, sharp: set[int]) -> list[np.ndarray]:
    """Frames of noise with a mark of their number, all but some of them blurred."""
    random = numpy_seeded()
    pictures = []
    for number in range(frames):
        picture = random.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
        picture = picture if number in sharp else cv2.GaussianBlur(picture, (0, 0), 2.0)
        picture[:20] = 5 * number
        pictures.append(picture)
    return pictures


def film(path: Path, pictures: list[np.ndarray], code: str = "MJPG") -> Path:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*code), RATE, (WIDTH, HEIGHT))
    if not writer.isOpened():
        pytest.skip(f"this OpenCV writes no films of the kind {code}")
    for picture in pictures:
        writer.write(picture)
    writer.release()
    return path


@pytest.mark.parametrize(("name", "code"), [("a.avi", "MJPG"), ("a.mp4", "mp4v")])
def test_the_sharpest_frame_of_each_moment(name: str, code: str, tmp_path: Path) -> None:
    sharp = {1, 7, 14, 15, 22}  # one of every five frames: 2 a second of 10
    path = film(tmp_path / name, blurred(25, sharp), code)
    told: list[tuple[int, int]] = []
    frames = extract_frames(path, tmp_path / "frames", fps=2.0, progress=lambda done, total: told.append((done, total)))
    assert [frame.name for frame in frames] == [f"frame{number:06d}.jpg" for number in (1, 7, 14, 15, 22)]
    assert list_images(tmp_path / "frames") == frames
    assert told[0] == (1, 25)
    assert told[-1] == (25, 25)
    for frame, number in zip(frames, sorted(sharp), strict=True):
        pixels = read_image(frame).pixels
        assert pixels.shape == (3, HEIGHT, WIDTH)
        torch.testing.assert_close(pixels[:, :16].mean(), torch.tensor(5 * number / 255), rtol=0, atol=0.02)


def test_more_frames_than_there_are_keeps_all(tmp_path: Path) -> None:
    path = film(tmp_path / "a.avi", blurred(7, set()))
    for fps in (float(RATE), 1000.0):
        assert len(extract_frames(path, tmp_path / "frames", fps=fps)) == 7
    assert len(extract_frames(path, tmp_path / "frames", fps=0.01)) == 1


def test_frames_are_made_once_and_replaced_together(tmp_path: Path) -> None:
    path, folder = film(tmp_path / "a.avi", blurred(10, set())), tmp_path / "frames"
    frames = extract_frames(path, folder)
    times = [frame.stat().st_mtime_ns for frame in frames]
    assert extract_frames(path, folder) == frames
    assert [frame.stat().st_mtime_ns for frame in frames] == times
    frames[0].unlink()
    assert extract_frames(path, folder) == frames
    assert frames[0].stat().st_mtime_ns > times[0]
    assert len(extract_frames(path, folder, fps=5.0)) == 5
    assert len(list_images(folder)) == 5
    # What is not of an earlier film stays, and nothing is written beside it.
    (folder / "mine.jpg").touch()
    with pytest.raises(ValueError, match=r"holds mine\.jpg"):
        extract_frames(path, folder, fps=3.0)
    assert len(list_images(folder)) == 6
    assert {entry.name for entry in tmp_path.iterdir()} == {"a.avi", "frames"}


def test_what_is_no_film(tmp_path: Path) -> None:
    whole = film(tmp_path / "a.mp4", blurred(10, set()), "mp4v").read_bytes()
    (tmp_path / "cut.mp4").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "text.mp4").write_text("Dear Sir or Madam,\n")
    (tmp_path / "empty.mov").touch()
    (tmp_path / "folder.mov").mkdir()
    for name, words in (
        ("cut.mp4", "not a film that can be read"),
        ("text.mp4", "not a film that can be read"),
        ("empty.mov", "not a film that can be read"),
        ("folder.mov", "not a file"),
        ("gone.mov", "no such file"),
    ):
        with pytest.raises(ImageError) as caught:
            extract_frames(tmp_path / name, tmp_path / "frames")
        assert str(caught.value) == f"{tmp_path / name}: {words}"
    with pytest.raises(ImageError, match="160 x 120 are more than the 100 pixels"):
        extract_frames(tmp_path / "a.mp4", tmp_path / "frames", max_pixels=100)
    for fps in (0.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(ValueError, match="fps: wanted a positive number"):
            extract_frames(tmp_path / "a.mp4", tmp_path / "frames", fps=fps)
    assert not (tmp_path / "frames").exists()
    assert not list(tmp_path.glob(".*"))
