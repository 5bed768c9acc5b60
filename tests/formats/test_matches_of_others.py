"""Databases of COLMAP and files of hloc: written and read by those who made the formats, and damaged."""

import sqlite3
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from chance import seeded
from command_line import torchsfm
from full_disk import full_disk

from torchsfm.formats import read_database, read_hloc, write_database
from torchsfm.geometry import Camera, Radial, intrinsics
from torchsfm.reconstruction import MatchedImages, Reconstruction
from torchsfm.simulation import orbit_poses, random_points, simulate_images


def make(images: int = 4, points: int = 60) -> MatchedImages:
    g = seeded()
    keypoints = tuple(600 * torch.rand(points + i, 2, generator=g, dtype=torch.float32) for i in range(images))
    pairs = torch.combinations(torch.arange(images))
    matches = tuple(torch.stack([torch.randperm(points, generator=g)[:30] for _ in range(2)], 1) for _ in pairs)
    return MatchedImages(
        names=tuple(f"dir {i % 2}/image é{i}.jpg" for i in range(images)),
        image_size=torch.tensor([[640, 480]] * images),
        keypoints=keypoints,
        pairs=pairs,
        matches=matches,
        camera_index=torch.arange(images) // 2,
        focal=tuple(700.0 if i < 2 else None for i in range(images)),
    )


def assert_same(a: MatchedImages, b: MatchedImages) -> None:
    assert a.names == b.names
    assert a.image_size.equal(b.image_size)
    assert a.pairs.equal(b.pairs)
    for first, second in zip(a.matches, b.matches, strict=True):
        assert first.equal(second)
    for x, y in zip(a.keypoints, b.keypoints, strict=True):
        torch.testing.assert_close(x, y, rtol=0, atol=1e-4)  # what adding half a pixel leaves of single precision


def test_a_database_comes_back(tmp_path: Path) -> None:
    m = make()
    write_database(m, tmp_path / "a b?.db")
    again = read_database(tmp_path / "a b?.db")
    assert_same(again, m)
    assert again.camera_index.equal(m.camera_index)
    assert again.focal == m.focal
    odd = replace(m, names=("caf\udce9.jpg", "b", "c", "d"))
    write_database(odd, tmp_path / "odd.db")
    assert read_database(tmp_path / "odd.db").names == odd.names


@pytest.mark.reference
def test_colmap_opens_what_is_written(tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    m = make()
    write_database(m, tmp_path / "database.db")
    with pycolmap.Database.open(tmp_path / "database.db") as database:
        images = database.read_all_images()
        assert tuple(image.name for image in images) == m.names
        assert len({image.camera_id for image in images}) == 2
        camera = database.read_camera(images[0].camera_id)
        assert (camera.width, camera.height, camera.focal_length, camera.has_prior_focal_length) == (640, 480, 700, True)
        assert not database.read_camera(images[3].camera_id).has_prior_focal_length
        for image, x in zip(images, m.keypoints, strict=True):
            assert np.abs(database.read_keypoints(image.image_id)[:, :2] - 0.5 - x.numpy()).max() < 1e-4
        for (i, j), rows in zip(m.pairs.tolist(), m.matches, strict=True):
            assert np.array_equal(database.read_matches(images[i].image_id, images[j].image_id), rows.numpy())


@pytest.mark.reference
def test_what_colmap_wrote_is_read(tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    m = make()
    with pycolmap.Database.open(tmp_path / "database.db") as database:
        camera = pycolmap.Camera(model="OPENCV", width=640, height=480, params=[500, 520, 320, 240, 0, 0, 0, 0])
        camera.has_prior_focal_length = True
        camera_id = database.write_camera(camera)
        ids = [database.write_image(pycolmap.Image(name=name, camera_id=camera_id)) for name in m.names]
        for image_id, x in zip(ids, m.keypoints, strict=True):
            # With scale and orientation, as features come.
            database.write_keypoints(image_id, np.hstack([x.numpy() + 0.5, np.ones((len(x), 2))]).astype(np.float32))
        for (i, j), rows in zip(m.pairs.tolist(), m.matches, strict=True):
            database.write_matches(ids[i], ids[j], rows.numpy().astype(np.uint32))
    again = read_database(tmp_path / "database.db")
    assert_same(again, m)
    assert again.focal == (510.0,) * 4
    assert again.camera_index.tolist() == [0] * 4


def test_hloc(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    m = make()
    g = seeded(1)
    with h5py.File(tmp_path / "features.h5", "w") as file:
        for name, x, size in zip(m.names, m.keypoints, m.image_size, strict=True):
            file[f"{name}/keypoints"], file[f"{name}/image_size"] = x.numpy().astype(np.float16), size.numpy()
            file[f"{name}/descriptors"] = np.zeros((8, len(x)))
    scores = []
    with h5py.File(tmp_path / "matches.h5", "w") as file:
        for (i, j), rows in zip(m.pairs.tolist(), m.matches, strict=True):
            match, score = np.full(len(m.keypoints[i]), -1), torch.rand(len(m.keypoints[i]), generator=g)
            match[rows[:, 0]] = rows[:, 1]
            pair = "/".join(m.names[k].replace("/", "-") for k in (i, j))
            file[f"{pair}/matches0"], file[f"{pair}/matching_scores0"] = match, score.numpy()
            scores.append(score)
    again = read_hloc(tmp_path / "features.h5", tmp_path / "matches.h5")
    order = sorted(range(4), key=lambda i: m.names[i])
    assert again.names == tuple(m.names[i] for i in order)
    assert again.weights is not None
    for k, (a, b) in enumerate(again.pairs.tolist()):
        i, j = order[a], order[b]
        row = int((m.pairs == torch.tensor([i, j])).all(1).nonzero())
        assert sorted(again.matches[k].tolist()) == sorted(m.matches[row].tolist())
        torch.testing.assert_close(again.weights[k].float(), scores[row][again.matches[k][:, 0]])
    torch.testing.assert_close(again.keypoints[0], m.keypoints[order[0]], rtol=1e-3, atol=1e-3)
    with h5py.File(tmp_path / "features.h5", "a") as file:
        del file[f"{m.names[0]}/image_size"]
    with pytest.raises(ValueError, match="does not tell the size of"):
        read_hloc(tmp_path / "features.h5", tmp_path / "matches.h5")


def test_damaged_files_of_hloc_are_told(tmp_path: Path) -> None:
    """Also where HDF5 opens them and finds the damage later, or would make room for what a file cannot hold."""
    h5py = pytest.importorskip("h5py")
    features, matches = tmp_path / "features.h5", tmp_path / "matches.h5"
    with h5py.File(features, "w") as file:
        for name in ("a.jpg", "b.jpg"):
            file[f"{name}/keypoints"], file[f"{name}/image_size"] = np.ones((50, 2)), [640, 480]
    with h5py.File(matches, "w") as file:
        file["a.jpg/b.jpg/matches0"] = np.arange(50)
    assert len(read_hloc(features, matches).matches[0]) == 50
    for path in (features, matches):
        good = path.read_bytes()
        # The tables of groups lose their marks, which is not seen as the file is opened; files that end too early.
        for data in (*(good.replace(mark, b"xxxx") for mark in (b"TREE", b"SNOD", b"HEAP")), good[:2000], good[:100], b""):
            path.write_bytes(data)
            with pytest.raises(ValueError, match="not a file of hloc's") as caught:
                read_hloc(features, matches)
            assert str(path) in str(caught.value)
            assert "\n" not in str(caught.value)
        path.write_bytes(good)
    with h5py.File(matches, "w") as file:
        file.create_dataset("a.jpg/b.jpg/matches0", (10**13,), "i8", chunks=(1000,))
    with pytest.raises(ValueError, match="says that it holds 80000000000000 bytes"):
        read_hloc(features, matches)


def test_what_is_no_database(tmp_path: Path) -> None:
    path = tmp_path / "database.db"
    write_database(make(), path)
    good = path.read_bytes()
    for data, words in (
        (b"", "it has no table"),
        (b"words", "not a database"),
        (good[:5000], "malformed|not a COLMAP database"),
        (good[:16] + bytes(100) + good[116:], "not a COLMAP database"),
    ):
        path.write_bytes(data)
        with pytest.raises(ValueError, match=words) as caught:
            read_database(path)
        assert "\n" not in str(caught.value)
        assert str(path) in str(caught.value)
    with pytest.raises(FileNotFoundError):
        read_database(tmp_path / "none.db")
    changes = (
        "UPDATE matches SET data = zeroblob(5)",
        "UPDATE matches SET pair_id = -7 WHERE pair_id = (SELECT min(pair_id) FROM matches)",
        "UPDATE keypoints SET rows = rows + 1000000000000",
        "UPDATE keypoints SET data = NULL",
        "UPDATE keypoints SET cols = 1, data = zeroblob(4 * rows)",
        "UPDATE images SET camera_id = 99",
        "UPDATE cameras SET width = -1",
        "UPDATE cameras SET width = 'wide'",
        "DELETE FROM keypoints WHERE image_id = 2",
        "DELETE FROM images WHERE image_id = 2",
        "DROP TABLE images",
    )
    for change in changes:
        path.write_bytes(good)
        with sqlite3.connect(path) as database:
            database.execute(change)
        database.close()
        with pytest.raises(ValueError, match="not a COLMAP database") as caught:
            read_database(path)
        assert "\n" not in str(caught.value)


def test_a_full_disk_leaves_the_database_before(tmp_path: Path) -> None:
    m = make()
    write_database(m, tmp_path / "a.db")
    with full_disk(5000), pytest.raises(OSError, match="File too large"):
        write_database(make(8, 100), tmp_path / "a.db")
    assert_same(read_database(tmp_path / "a.db"), m)
    with pytest.raises(ValueError, match="name for each image"):
        write_database(replace(m, names=("a",) * 4), tmp_path / "a.db")
    with pytest.raises(ValueError, match="one size of image a camera"):
        write_database(replace(m, image_size=torch.tensor([[640, 480], [480, 640]] * 2)), tmp_path / "a.db")


def test_the_command_maps_a_database(tmp_path: Path) -> None:
    g = seeded()
    poses = orbit_poses(4, radius=5.0, sweep=1.0)
    k = torch.zeros(4, dtype=torch.float64)
    K = intrinsics(torch.tensor(900.0).double(), torch.tensor([399.5, 299.5]).double()).expand(4, 3, 3)
    X = random_points(150, generator=g)
    seen = simulate_images(X, poses, Camera(K, Radial(k, k)), image_size=(800, 600), noise=0.3, generator=g)
    keypoints = tuple(seen.x[i, seen.visible[i]].float() for i in range(4))
    number = seen.visible.cumsum(1) - 1
    pairs = torch.combinations(torch.arange(4))
    both = [(seen.visible[i] & seen.visible[j]).nonzero()[:, 0] for i, j in pairs.tolist()]
    matches = tuple(torch.stack([number[i][b], number[j][b]], 1) for (i, j), b in zip(pairs.tolist(), both, strict=True))
    names = tuple(f"{i}.jpg" for i in range(4))
    write_database(MatchedImages(names, torch.tensor([[800, 600]] * 4), keypoints, pairs, matches), tmp_path / "database.db")
    status, text, stderr = torchsfm("reconstruct", tmp_path / "database.db", "--out", tmp_path / "out")
    assert status == 0, stderr
    assert "4 of 4 images registered" in text
    model = Reconstruction.load(tmp_path / "out" / "model.npz")
    assert model.names == names
    assert float(model.residuals().mean()) < 0.5
    (tmp_path / "bad.db").write_bytes((tmp_path / "database.db").read_bytes()[:5000])
    status, _, stderr = torchsfm("reconstruct", tmp_path / "bad.db", "--out", tmp_path / "out")
    assert status == 2
    assert "not a COLMAP database" in stderr
