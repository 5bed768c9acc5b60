"""libmv problems: against a writer of the layout, the real file, and damage."""

import re
import struct
from pathlib import Path

import numpy as np
import pytest
import torch
from chance import numpy_seeded, seeded
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from torchsfm.formats import read_libmv
from torchsfm.geometry import BrownConrady, random_rotation

QUICK = settings(deadline=None, max_examples=30, suppress_health_check=[HealthCheck.function_scoped_fixture])


def encode(order: str = "<", views: int = 3, points: int = 4, seed: int = 0) -> tuple[bytes, dict[str, np.ndarray]]:  # type: ignore[type-arg]
    """The bytes of a problem in which image and track numbers are not in order, and what should be read."""
    random = numpy_seeded(seed)
    g = seeded(seed)
    truth = {
        "intrinsics": random.normal(size=8).astype("f4"),
        "R": random_rotation(views, generator=g, dtype=torch.float32).numpy().reshape(-1, 3, 3),
        "t": random.normal(size=(views, 3)).astype("f4"),
        "X": random.normal(size=(points, 3)).astype("f4"),
        "image": random.permutation(50)[:views],
        "track": random.permutation(50)[:points],
    }
    pairs = [(i, j) for i in range(views) for j in range(points)]
    truth["pairs"] = random.permutation(pairs) if pairs else np.zeros((0, 2), int)
    truth["x"] = random.normal(size=(len(pairs), 2)).astype("f4")
    parts = [b"v" if order == "<" else b"V", b"P", truth["intrinsics"].astype(order + "f4").tobytes()]
    parts.append(struct.pack(order + "i", views))
    for image, R, t in zip(truth["image"], truth["R"], truth["t"], strict=True):
        parts.append(struct.pack(order + "i12f", image, *R.T.ravel(), *t))
    parts.append(struct.pack(order + "i", points))
    parts += [struct.pack(order + "i3f", track, *X) for track, X in zip(truth["track"], truth["X"], strict=True)]
    parts.append(struct.pack(order + "i", len(pairs) + 2))
    for (i, j), x in zip(truth["pairs"], truth["x"], strict=True):
        parts.append(struct.pack(order + "2i2f", truth["image"][i], truth["track"][j], *x))
    # Two markers of an image and a track that nobody knows.
    parts += [struct.pack(order + "2i2f", 77, 77, 0, 0), struct.pack(order + "2i2f", *truth["image"][:1], 99, 0, 0)]
    return b"".join(parts), truth


@QUICK
@given(order=st.sampled_from("<>"), views=st.integers(1, 5), points=st.integers(0, 5), seed=st.integers(0, 1000))
def test_layout(tmp_path: Path, order: str, views: int, points: int, seed: int) -> None:
    data, truth = encode(order, views, points, seed)
    (tmp_path / "problem.bin").write_bytes(data)
    problem = read_libmv(tmp_path / "problem.bin")
    f, cx, cy, k1, k2, k3, p1, p2 = truth["intrinsics"]
    np.testing.assert_array_equal(problem.cameras.K[0], np.array([[f, 0, cx], [0, f, cy], [0, 0, 1]], dtype=np.float64))
    assert isinstance(problem.cameras.distortion, BrownConrady)
    np.testing.assert_array_equal(problem.cameras.distortion.parameters()[0], np.array([k1, k2, p1, p2, k3], dtype=np.float64))
    np.testing.assert_array_equal(problem.poses.R, truth["R"])
    np.testing.assert_array_equal(problem.poses.t, truth["t"])
    np.testing.assert_array_equal(problem.X, truth["X"])
    np.testing.assert_array_equal(torch.stack((problem.view, problem.point), 1), truth["pairs"].reshape(-1, 2))
    np.testing.assert_array_equal(problem.x, truth["x"])


@QUICK
@given(cut=st.integers(0, 10_000))
def test_truncated_files(tmp_path: Path, cut: int) -> None:
    data, _ = encode()
    path = tmp_path / "cut.bin"
    path.write_bytes(data[: cut % len(data)])
    with pytest.raises(ValueError, match=re.escape(path.name)) as caught:
        read_libmv(path)
    assert "\n" not in str(caught.value)


@QUICK
@given(noise=st.binary(max_size=300), head=st.sampled_from([b"", b"v", b"vP", b"VN"]))
def test_noise_is_no_problem(tmp_path: Path, noise: bytes, head: bytes) -> None:
    (tmp_path / "noise.bin").write_bytes(head + noise + b"\xff")
    with pytest.raises(ValueError, match=r"noise\.bin"):
        read_libmv(tmp_path / "noise.bin")


def test_wrong_files(tmp_path: Path) -> None:
    data, _ = encode()
    path = tmp_path / "bad.bin"
    twice = bytearray(data)
    twice[34 + 4 + 52 : 34 + 4 + 56] = twice[34 + 4 : 34 + 8]
    negative = data[:34] + struct.pack("<i", -3) + data[38:]
    for wrong, words in (
        (data + b"\0", "too long"),
        (bytes(twice), "image numbers occur twice"),
        (negative, "negative"),
        (data[:2] + struct.pack("<f", float("nan")) + data[6:], "intrinsics are not finite"),
        (data[:42] + struct.pack("<f", float("inf")) + data[46:], "camera 0 is not finite"),
        (data[:42] + b"\x01\0\x80\x7f" + data[46:], "camera 0 is not finite"),
        (data[:42] + struct.pack("<f", 1e30) + data[46:], "its R no rotation"),
        (data[:1] + b"X" + data[2:], "not a libmv problem"),
        (b"", "not a libmv problem"),
    ):
        path.write_bytes(wrong)
        with pytest.raises(ValueError, match=words):
            read_libmv(path)
    with pytest.raises(FileNotFoundError):
        read_libmv(tmp_path / "none.bin")


def test_real_problem(data: Path) -> None:
    problem = read_libmv(data / "bal/libmv_problem_01.bin")
    assert (problem.poses.shape[0], problem.cameras.shape[0], len(problem.X), len(problem.x)) == (333, 1, 26, 5421)
    assert float(problem.residuals().square().mean().sqrt()) == pytest.approx(1.304, abs=5e-4)
    assert bool((problem.depths() > 0).all())


def test_markers_that_are_not_finite_are_kept(tmp_path: Path) -> None:
    """Also the NaN that makes noise when it is copied."""
    data, _ = encode()
    for number in (struct.pack("<f", float("inf")), b"\x01\0\x80\x7f"):
        (tmp_path / "a.bin").write_bytes(data[:-40] + number + data[-36:])
        problem = read_libmv(tmp_path / "a.bin")
        assert int((~problem.x.isfinite()).sum()) == 1
