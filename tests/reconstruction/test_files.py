"""Files that are there whole or not at all, and archives from which nothing is taken on trust."""

import io
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from full_disk import full_disk
from small_model import make

from torchsfm.reconstruction import Reconstruction
from torchsfm.reconstruction.matching.stages import Stages
from torchsfm.reconstruction.model.files import load_arrays, whole_file, write_whole_files


def saved(path: Path, **changes: np.ndarray) -> Path:
    """A saved model with some of its arrays replaced."""
    make().save(path)
    arrays = dict(load_arrays(path)) | changes
    with path.open("wb") as file:
        np.savez(file, allow_pickle=True, **arrays)
    return path


def test_a_file_appears_only_when_it_is_whole(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    with whole_file(path) as file:
        file.write(b"first")
        assert not path.exists()

    def fail(error: type[BaseException]) -> None:
        with whole_file(path) as file:
            file.write(b"second")
            raise error

    for error in (ValueError, KeyboardInterrupt):
        with pytest.raises(error):
            fail(error)
    assert path.read_bytes() == b"first"
    assert [entry.name for entry in tmp_path.iterdir()] == ["a.txt"]


def test_a_link_is_followed_and_a_device_not_replaced(tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(tmp_path / "target")
    with whole_file(tmp_path / "link") as file:
        file.write(b"here")
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "target").read_bytes() == b"here"
    with whole_file("/dev/null") as file:
        file.write(b"away")
    assert Path("/dev/null").is_char_device()


def test_a_full_disk_leaves_the_old_files_and_nothing_else(tmp_path: Path) -> None:
    old = {tmp_path / name: b"old" for name in ("a", "b", "c")}
    write_whole_files(old)
    new = {path: bytes(5000 if path.name == "b" else 10) for path in old}
    with full_disk(1000), pytest.raises(OSError, match="File too large") as caught:
        write_whole_files(new)
    assert caught.value.filename == str(tmp_path / "b")
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == old
    write_whole_files(new)
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == new


def test_a_model_or_stage_on_a_full_disk_leaves_the_old_one(tmp_path: Path) -> None:
    model = make()
    model.save(tmp_path / "model.npz")
    Stages(tmp_path, False, "x").run("a", lambda: {"values": torch.zeros(3)})
    before = {path: path.read_bytes() for path in tmp_path.rglob("*.npz")}
    larger = replace(model, X=torch.rand(30, 3, dtype=torch.float64))
    with full_disk(1000):
        with pytest.raises(OSError, match="File too large") as caught:
            larger.save(tmp_path / "model.npz")
        assert caught.value.filename == str(tmp_path / "model.npz")
        with pytest.raises(OSError, match="File too large"):
            Stages(tmp_path, False, "x").run("a", lambda: {"values": torch.rand(3000)})
    assert {path: path.read_bytes() for path in tmp_path.rglob("*.*") if path.is_file()} == before


def test_arrays_come_back_as_they_were(tmp_path: Path) -> None:
    arrays = {
        "one": np.arange(6.0).reshape(2, 3),
        "columns": np.asfortranarray(np.arange(6).reshape(2, 3)),
        "swapped": np.arange(3).astype(">i4"),
        "text": np.array(["ä", "caf\udce9.jpg", ""]),
        "none": np.zeros((0, 3), np.float32),
        "single": np.array(True),
    }
    for save in (np.savez, np.savez_compressed):
        save(tmp_path / "a.npz", **arrays)
        found = load_arrays(tmp_path / "a.npz")
        assert set(found) == set(arrays)
        for name, array in arrays.items():
            np.testing.assert_array_equal(found[name], array, strict=name != "swapped")
            assert found[name].dtype.isnative
            assert found[name].flags.writeable


def npy(header: str, data: bytes = b"") -> bytes:
    """An array file with this header."""
    return b"\x93NUMPY\1\0" + len(header).to_bytes(2, "little") + header.encode() + data


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (npy("{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000,), }"), "not an array"),
        (npy("{'descr': '<f8', 'fortran_order': False, 'shape': (-1,), }", bytes(8)), "not an array"),
        (npy("{'descr': '|O', 'fortran_order': False, 'shape': (1,), }", b"cos\nsystem\n(S'true'\ntR."), "not an array"),
        (npy("{'descr': '<M8[s]', 'fortran_order': False, 'shape': (1,), }", bytes(8)), "not an array"),
        (npy("((" * 2000), "not an array"),
        (npy("{'descr': '<f8', 'fortran_order': False, 'shape': (3,), }", bytes(16)), "not an array"),
        (b"", "not an array"),
        (bytes(2**26), "fill the memory"),
    ],
)
def test_members_that_are_no_arrays(content: bytes, words: str, tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "a.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("x.npy", content)
    with pytest.raises(ValueError, match=words) as caught:
        load_arrays(tmp_path / "a.npz")
    assert "\n" not in str(caught.value)


def test_other_files_are_no_archives(tmp_path: Path) -> None:
    import pickle

    single = io.BytesIO()
    np.save(single, np.zeros(3))
    for content in (single.getvalue(), pickle.dumps([1, 2]), b"", b"PK", b"PK\3\4", b"PK\5\6" + bytes(18), b"PK\3\4" * 50):
        (tmp_path / "model.npz").write_bytes(content)
        with pytest.raises(ValueError, match=r"model.npz is not a saved reconstruction") as caught:
            Reconstruction.load(tmp_path / "model.npz")
        assert "\n" not in str(caught.value)


WRONG: dict[str, tuple[dict[str, np.ndarray], str]] = {
    "views": ({"view": np.full(90, 4)}, "view: there is no number 4 among 4"),
    "points": ({"point": np.full(90, -1)}, "point: there is no number -1 among 30"),
    "cameras": ({"camera_index": np.array([0, 1, 0, 0])}, "camera_index: there is no number 1 among 1"),
    "names": ({"names": np.array(["a"])}, r"image_size: wanted shape \(v 2\)"),
    "shape": ({"X": np.zeros((30, 4))}, r"X: wanted shape \(n 3\)"),
    "length": ({"color": np.zeros((29, 3))}, r"color: wanted shape \(n 3\)"),
    "single": ({"x": np.array(1.0)}, r"x: wanted shape \(m 2\)"),
    "type": ({"view": np.zeros(90)}, "view: wanted integers, got float64"),
    "precision": ({"X": np.zeros((30, 3), np.float32)}, "X: wanted float64"),
    "complex": ({"X": np.zeros((30, 3), complex)}, r"a damaged archive \('X.npy' is not an array"),
    "objects": ({"names": np.array([[], 1, None, 2], object)}, r"a damaged archive \('names.npy' is not an array"),
    "model": ({"camera_model": np.array("cat")}, "camera_model: there is no 'cat'"),
    "parameters": ({"camera_model": np.array("opencv")}, "camera_model: there is no 'opencv' with 2 parameters"),
    "K": ({"camera_K": np.full((1, 3, 3), np.nan)}, "camera_K: not finite"),
    "pose": ({"pose_R": np.full((4, 3, 3), np.inf)}, "pose_R: not finite"),
}


@pytest.mark.parametrize("name", WRONG)
def test_arrays_that_make_no_model(name: str, tmp_path: Path) -> None:
    changes, words = WRONG[name]
    with pytest.raises(ValueError, match=rf"model.npz is not a saved reconstruction \({words}"):
        Reconstruction.load(saved(tmp_path / "model.npz", **changes))


def test_a_missing_array_is_named(tmp_path: Path) -> None:
    np.savez(tmp_path / "model.npz", X=np.zeros((3, 3)))
    with pytest.raises(ValueError, match="it has no array 'names'"):
        Reconstruction.load(tmp_path / "model.npz")


def test_names_that_are_not_utf_8_come_back(tmp_path: Path) -> None:
    model = replace(make(), names=("a\udce9.jpg", "b|<i>.jpg", "c\n.jpg", "d.jpg"))
    model.save(tmp_path / "model.npz")
    assert Reconstruction.load(tmp_path / "model.npz").names == model.names


def test_a_model_without_images_comes_back(tmp_path: Path) -> None:
    model = make()
    none = replace(
        model,
        **{name: getattr(model, name)[:0] for name in ("names", "image_size", "camera_index", "registered", "X", "color")},
        **{name: getattr(model, name)[:0] for name in ("x", "view", "point", "poses", "cameras")},
    )
    none.save(tmp_path / "model.npz")
    assert Reconstruction.load(tmp_path / "model.npz").num_points == 0
