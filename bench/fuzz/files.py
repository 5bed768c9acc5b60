"""Damaged files for every reader: a `ValueError` that names the file in one line, or something sound.

Each trial damages one file of a small good data set and reads the set. Nothing but `ValueError` or `OSError` may be raised;
what is read must be finite and must not point at what is not there; no file may take seconds or the memory of the machine.
"""

import bz2
import gzip
import io
import resource
import shutil
import sqlite3
import tempfile
import time
import zipfile
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from bench.fuzz.campaign import Target, Trial, main
from bench.fuzz.mutations import mend_png, mutate
from torchsfm.cli.align import read_points
from torchsfm.cli.inputs import read_intrinsics
from torchsfm.cli.job import UserError
from torchsfm.formats import (
    PointCloud,
    VggScene,
    read_bal,
    read_colmap,
    read_conics,
    read_database,
    read_features,
    read_hloc,
    read_libmv,
    read_lines,
    read_model,
    read_ply,
    read_vgg,
    write_bal,
    write_colmap,
    write_database,
    write_model,
    write_nerfstudio,
    write_ply,
)
from torchsfm.geometry import BundleProblem, Camera, Pose, Radial, intrinsics, random_rotation
from torchsfm.images import Photograph, extract_frames, parse_exif, read_image, save_image
from torchsfm.images.heif import heif_library
from torchsfm.reconstruction import ControlPoints, KnownFeatures, MatchedImages, Reconstruction
from torchsfm.reconstruction.matching.sources import Sources
from torchsfm.reconstruction.model.files import load_arrays

FILES_PER_TRIAL = 10
MAX_SECONDS = 5.0
MAX_MEGABYTES = 400
"""Of a file of a few kilobytes."""
MAX_PIXELS = 2**20
Files = dict[str, bytes]


@dataclass(frozen=True)
class Format:
    """A good data set and its reader."""

    name: str
    files: Files
    """By path within a folder."""
    read: Callable[[Path], Any]
    """Called with the only file, or with the folder."""
    repack: Callable[[bytes, Callable[[bytes], bytes]], bytes] | None = None
    """Damage what is packed in a file instead of the file."""


def load() -> list[Target]:
    """A target for each format."""
    formats = _formats()
    every = b"".join(data for kind in formats for data in kind.files.values())
    return [Target(kind.name, lambda seed, kind=kind: _attempt(kind, every, seed)) for kind in formats]


def _attempt(kind: Format, every: bytes, seed: int) -> Trial:
    random = np.random.default_rng([seed, *kind.name.encode()])
    broken: list[str] = []
    with tempfile.TemporaryDirectory(prefix="fuzz") as folder:
        for _ in range(FILES_PER_TRIAL):
            shutil.rmtree(folder)
            target = _write(Path(folder), _damaged(kind, every, random))
            start, before = time.perf_counter(), _megabytes()
            broken += [f"{what}: {words}" for what, words in _read(kind, target)]
            if time.perf_counter() - start > MAX_SECONDS:
                broken.append(f"slow: {time.perf_counter() - start:.1f} s")
            if _megabytes() - before > MAX_MEGABYTES:
                broken.append(f"memory: {_megabytes() - before:.0f} MB")
    return Trial(FILES_PER_TRIAL, tuple(broken))


def _damaged(kind: Format, every: bytes, random: np.random.Generator) -> Files:
    """The files with one of them damaged, or gone."""
    name = list(kind.files)[int(random.integers(len(kind.files)))]
    data = kind.files[name]
    first = int(random.integers(len(every)))
    other = every[first : first + 2000]
    if kind.repack is not None and random.random() < 0.5:
        return kind.files | {name: kind.repack(data, lambda inside: mutate(inside, random, other))}
    if len(kind.files) > 1 and random.random() < 0.02:
        return {path: content for path, content in kind.files.items() if path != name}
    return kind.files | {name: mutate(data, random, other)}


def _write(folder: Path, files: Files) -> Path:
    for path, data in files.items():
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        (folder / path).write_bytes(data)
    return folder if len(files) > 1 or not files else folder / next(iter(files))


def _read(kind: Format, target: Path) -> list[tuple[str, str]]:
    """What is wrong with what comes of it."""
    try:
        found = kind.read(target)
    except (ValueError, UserError) as error:
        text = str(error)
        if "nsufficient memory" in text or "Failed to allocate" in text:
            return [("memory", text)]
        return [] if str(target.parent) in text and "\n" not in text else [("message", repr(text[:160]))]
    except OSError as error:
        return [] if error.filename is not None else [("message", repr(error))]
    return [("unsound", what) for what in _faults(found)]


def _faults(found: Any) -> list[str]:
    """What a result may not be."""
    match found:
        case BundleProblem():
            lens = found.cameras.distortion.parameters()
            tensors = {"K": found.cameras.K, "lens": lens, "R": found.poses.R, "t": found.poses.t}
            faults = [f"{name} is not finite" for name, tensor in tensors.items() if not bool(tensor.isfinite().all())]
            limits = {"view": len(found.poses.R), "point": len(found.X), "camera_index": len(found.cameras.K)}
            for name, limit in limits.items():
                index = getattr(found, name)
                if len(index) and not (int(index.min()) >= 0 and int(index.max()) < limit):
                    faults.append(f"{name} is out of range")
            if len(found.residuals()) != len(found.x):
                faults.append("residuals")
            return faults
        case MatchedImages():
            faults = [] if len(found.pairs) == len(found.matches) else ["pairs"]
            faults += [] if all(bool(x.isfinite().all()) for x in found.keypoints) else ["keypoints are not finite"]
            for (i, j), rows in zip(found.pairs.tolist(), found.matches, strict=True):
                limit = torch.tensor([len(found.keypoints[i]), len(found.keypoints[j])])
                faults += [] if bool(((rows >= 0) & (rows < limit)).all()) else ["matches are out of range"]
            return faults
        case KnownFeatures():
            counts = zip(found.names, found.x, found.descriptors, found.labels, strict=True)
            return [f"{name} has other counts" for name, x, d, _ in counts if len(x) != len(d) or d.dtype != torch.uint8]
        case ControlPoints():
            good = bool(found.X.isfinite().all()) and bool(found.x.isfinite().all())
            return [] if good and bool((found.point < len(found.names)).all()) else ["places"]
        case VggScene():
            tensors = {"x": found.x, "P": found.P, "X": found.X, "segments": found.segments, "L": found.L}
            return [f"{name} is not finite" for name, tensor in tensors.items() if not bool(tensor.isfinite().all())]
        case list():
            return [fault for one in found for fault in _faults(one)]
        case PointCloud():
            return [] if found.X.ndim == 2 and found.X.shape[1] == 3 else [f"shape {tuple(found.X.shape)}"]
        case Photograph():
            good = bool(((found.pixels >= 0) & (found.pixels <= 1)).all()) and min(*found.pixels.shape, *found.size) > 0
            focal = found.focal is None or (np.isfinite(found.focal) and found.focal > 0)
            return [] if good and focal else ["pixels or focal length"]
    return []


def _megabytes() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def _describe(path: Path, counts: list[int]) -> None:
    """Add descriptors to a database, so many of each image."""
    with closing(sqlite3.connect(path)) as database:
        columns = "image_id INTEGER PRIMARY KEY NOT NULL, rows INTEGER NOT NULL, cols INTEGER NOT NULL, data BLOB"
        database.execute(f"CREATE TABLE descriptors ({columns})")
        for i, count in enumerate(counts):
            database.execute("INSERT INTO descriptors VALUES (?, ?, 128, ?)", (i + 1, count, bytes(range(128)) * count))
        database.commit()


def _load(path: Path) -> dict[str, Any]:
    """The arrays of an archive, in an error that names the file as all callers do."""
    try:
        return load_arrays(path)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def _photograph(path: Path) -> Photograph:
    parse_exif(path.read_bytes())
    read_image(path, max_size=16, max_pixels=MAX_PIXELS)
    return read_image(path, max_pixels=MAX_PIXELS)


def _listed(folder: Path) -> Sources:
    return Sources.of(folder / "list.txt")


def _frames(path: Path) -> list[Photograph]:
    """The frames that a film gives."""
    return [read_image(frame) for frame in extract_frames(path, path.with_name("frames"), max_pixels=MAX_PIXELS)]


def _film(path: Path) -> bytes:
    """A few frames; none where OpenCV writes no films."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 2.0, (32, 24))
    for level in range(3):
        writer.write(np.full((24, 32, 3), 80 * level, np.uint8))
    writer.release()
    return path.read_bytes() if path.exists() else b""


def _in_zip(data: bytes, damage: Callable[[bytes], bytes]) -> bytes:
    """An archive with one of its members damaged."""
    target = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(data)) as old, zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED) as new:
        names = old.namelist()
        chosen = names[len(damage(data)) % len(names)]
        for name in names:
            new.writestr(name, damage(old.read(name)) if name == chosen else old.read(name))
    return target.getvalue()


def _formats() -> list[Format]:
    """Everything that is read, as small as it can be."""
    g = torch.Generator().manual_seed(0)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        problem, model = _problem(g)
        formats = []
        for suffix in (".txt", ".txt.gz", ".txt.bz2"):
            write_bal(problem, folder / f"a{suffix}")
            packer: Any = {".txt.gz": gzip, ".txt.bz2": bz2}.get(suffix)
            repack = None if packer is None else lambda data, damage, p=packer: p.compress(damage(p.decompress(data)))
            formats.append(Format(f"bal{suffix}", _files(folder, f"a{suffix}"), read_bal, repack))
        formats.append(Format("libmv", {"a.bin": _libmv(problem)}, read_libmv))
        formats.append(Format("vgg", _vgg(), read_vgg))
        write_ply(model, folder / "a.ply")
        formats.append(Format("ply.binary", _files(folder, "a.ply"), read_ply))
        formats += [Format(f"ply.{kind}", {"a.ply": data}, read_ply) for kind, data in _ply().items()]
        write_colmap(model, folder / "colmap")
        formats.append(Format("colmap.binary", _files(folder, "colmap"), read_colmap))
        formats.append(Format("colmap.text", _colmap_text(), read_colmap))
        write_nerfstudio(model, folder / "transforms.json")
        nerfstudio = _files(folder, "transforms.json") | _files(folder, "points.ply")
        formats.append(Format("nerfstudio", nerfstudio, read_model))
        if heif_library() is not None:
            heic = io.BytesIO()
            heif_library().encode("RGB", (24, 20), bytes(range(240)) * 6, heic)
            formats.append(Format("image.heic", {"a.heic": heic.getvalue()}, _photograph))
        (folder / "photos").mkdir()
        for name in ("a.jpg", "b c.jpg"):
            (folder / "photos" / name).touch()
        formats.append(Format("list of images", _files(folder, "photos") | {"list.txt": b"# both\na.jpg\nb c.jpg\n"}, _listed))
        film = _film(folder / "a.avi")
        formats += [Format("film", {"a.avi": film}, _frames)] if film else []
        K = model.cameras.K.clone()
        K[:, :2, 2] -= 0.5
        middle = replace(model, cameras=Camera(K, model.cameras.distortion))
        straight = replace(model, cameras=Camera(K))
        for name, stem, one in (
            ("bundler", "bundle.out", middle),
            ("nvm", "model.nvm", straight),
            ("openmvg", "sfm_data.json", middle),
            ("opensfm", "reconstruction.json", middle),
            ("kapture", "", replace(middle, names=("a.jpg", "b c.jpg", "d/e.jpg", "f.jpg"))),
        ):
            (folder / name).mkdir()
            write_model(one, folder / name / stem, name)
            formats.append(Format(name, _files(folder, name), read_model))
        keypoints = tuple(x.float() for x in torch.split(model.x, [6, 6, 6]))
        pairs, rows = torch.tensor([[0, 1], [1, 2]]), torch.arange(6)[:, None].expand(6, 2)
        matched = MatchedImages(model.names[:3], model.image_size[:3], keypoints, pairs, (rows, rows))
        write_database(matched, folder / "database.db")
        formats.append(Format("database", _files(folder, "database.db"), read_database))
        hloc = _hloc(replace(matched, names=("a.jpg", "b/c.jpg", "d.jpg")))
        formats += [Format("hloc", hloc, lambda place: read_hloc(place / "features.h5", place / "matches.h5"))] if hloc else []
        _describe(folder / "database.db", [len(x) for x in keypoints])
        formats.append(Format("database of features", _files(folder, "database.db"), read_features))
        formats.append(
            Format("control points", {"points.txt": b"p 1 2 3 a b.jpg 4 5\n# more\nq 0 2 1 c.jpg 7 5\n"}, read_points)
        )
        model.save(folder / "model.npz")
        formats.append(Format("model", _files(folder, "model.npz"), Reconstruction.load, _in_zip))
        np.savez(folder / "stage.npz", a=np.arange(5), b=np.array("text"))
        formats.append(Format("arrays", _files(folder, "stage.npz"), _load, _in_zip))
        formats.append(Format("intrinsics", {"K.txt": b"500 0 320\n0 500 240\n0 0 1\n"}, read_intrinsics))
        formats.append(Format("lines", {"lines.txt": b"0 0 1 1 0 1 .5 .5 .5 2 0 10 10 50 12 4 3 11 9 52 13 4\n"}, read_lines))
        ellipse = b"0 0 1 1 0 0 0 .5 0 .5 .5 .5 1 0 10 10 8 5 .3 1 0 0 0 0 1 0 0 0 1 0 0 1 0 .1\n"
        formats.append(Format("conics", {"conics.txt": ellipse}, read_conics))
        for suffix in (".png", ".jpg", ".bmp", ".tif", ".webp", ".ppm", ".pgm"):
            save_image(folder / f"a{suffix}", torch.rand(1 if suffix == ".pgm" else 3, 20, 24, generator=g))
            fix = (lambda data, damage: mend_png(damage(data))) if suffix == ".png" else None
            formats.append(Format(f"image{suffix}", _files(folder, f"a{suffix}"), _photograph, fix))
        exif = b"\xff\xe1\x00\x48Exif\0\0II*\0\x08\0\0\0\x02\0\x12\x01\x03\0\x01\0\0\0\x06\0\0\0"
        exif += b"\x0f\x01\x02\0\x05\0\0\0\x26\0\0\0"
        jpeg = (folder / "a.jpg").read_bytes()
        formats.append(Format("image.exif", {"a.jpg": jpeg[:2] + exif + b"\0\0\0\0Acme\0" + bytes(23) + jpeg[2:]}, _photograph))
        formats.append(Format("image.plain", {"a.ppm": b"P3\n# words\n2 2\n255\n" + b"1 20 255 " * 4}, _photograph))
        formats.append(Format("image.bits", {"a.pbm": b"P1\n4 2\n1 0 1 0\n1111\n"}, _photograph))
    return formats


def _files(folder: Path, name: str) -> Files:
    """A file, or all files of a folder."""
    path = folder / name
    if not path.is_dir():
        return {path.name: path.read_bytes()}
    return {entry.relative_to(path).as_posix(): entry.read_bytes() for entry in sorted(path.rglob("*")) if entry.is_file()}


def _problem(g: torch.Generator) -> tuple[BundleProblem, Reconstruction]:
    """Three views of six points, and a model in which one more image has no pose."""
    f64 = torch.float64
    R = torch.cat([random_rotation(3, generator=g, dtype=f64), torch.eye(3, dtype=f64)[None]])
    poses = Pose(R, torch.tensor([0.0, 0, 5]).to(f64).repeat(4, 1))
    K = intrinsics(torch.tensor([500.0, 600.0], dtype=f64), torch.tensor([[320.0, 240.0]], dtype=f64).repeat(2, 1))
    cameras = Camera(K, Radial(torch.zeros(2, dtype=f64), torch.zeros(2, dtype=f64)))
    X, color = torch.randn(6, 3, generator=g, dtype=f64), torch.rand(6, 3, generator=g, dtype=f64)
    view, point = torch.arange(3).repeat(6), torch.arange(6).repeat_interleave(3)
    x = 100 * torch.rand(18, 2, generator=g, dtype=f64)
    index = torch.tensor([0, 1, 0, 1])
    problem = BundleProblem(poses[:3], cameras, index[:3], X, x, view, point)
    names = ("a.jpg", "b c.jpg", "caf\udce9.jpg", "d.jpg")
    registered = torch.tensor([True, True, True, False])
    size = torch.tensor([[640, 480]]).repeat(4, 1)
    model = Reconstruction(
        names=names, image_size=size, cameras=cameras, camera_index=index, poses=poses, registered=registered,
        X=X, color=color, x=x, view=view, point=point,
    )  # fmt: skip
    return problem, model


def _hloc(matched: MatchedImages) -> Files:
    """Features and matches, packed and not; none where h5py is not installed."""
    try:
        import h5py
    except ImportError:
        return {}
    features, matches = io.BytesIO(), io.BytesIO()
    with h5py.File(features, "w") as file:
        for name, x, size in zip(matched.names, matched.keypoints, matched.image_size, strict=True):
            file[f"{name}/keypoints"], file[f"{name}/image_size"] = x.numpy(), size.numpy()
    with h5py.File(matches, "w") as file:
        for (i, j), rows in zip(matched.pairs.tolist(), matched.matches, strict=True):
            pair = "/".join(matched.names[k].replace("/", "-") for k in (i, j))
            match = rows[:, 1].numpy().astype(np.int16)
            file.create_dataset(f"{pair}/matches0", data=match, compression="gzip")
            file[f"{pair}/matching_scores0"] = np.ones(len(match), np.float16)
    return {"features.h5": features.getvalue(), "matches.h5": matches.getvalue()}


def _libmv(problem: BundleProblem) -> bytes:
    cameras = np.zeros(3, [("image", "<i4"), ("R", "<f4", (3, 3)), ("t", "<f4", 3)])
    cameras["image"], cameras["R"], cameras["t"] = range(3), problem.poses.R.mT.numpy(), problem.poses.t.numpy()
    points = np.zeros(6, [("track", "<i4"), ("X", "<f4", 3)])
    points["track"], points["X"] = range(6), problem.X.numpy()
    markers = np.zeros(18, [("image", "<i4"), ("track", "<i4"), ("x", "<f4", 2)])
    markers["image"], markers["track"], markers["x"] = problem.view.numpy(), problem.point.numpy(), problem.x.numpy()
    tables = b"".join(np.int32(len(table)).tobytes() + table.tobytes() for table in (cameras, points, markers))
    return b"vP" + np.array([500, 320, 240, 0.1, 0, 0, 0, 0], "<f4").tobytes() + tables


def _vgg() -> Files:
    views = {f"3D/a.{i}.P": b"1 0 0 0\n0 1 0 0\n0 0 1 %d\n" % i for i in range(2)}
    corners = {f"2D/a.{i}.corners": b"1 2\n3.5 4\n" for i in range(2)}
    lines = {f"2D/a.{i}.lines": b"1 2 3 4\n" for i in range(2)}
    tables = {"2D/a.nview-corners": b"0 1\n1 *\n", "2D/a.nview-lines": b"0 0\n"}
    return views | corners | lines | tables | {"3D/a.p3d": b"0 0 1\n1 2 3\n", "3D/a.l3d": b"0 0 1 1 2 3\n"}


def _ply() -> Files:
    """Text, and big-endian numbers, with lists before the points."""
    head = (
        "ply\nformat {} 1.0\ncomment x\nelement face 2\nproperty list uchar int i\nelement vertex 2\nproperty float x\n"
        "property float y\nproperty double z\nproperty uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n"
    )
    faces = b"".join(b"\x03" + np.array([0, 1, 0], ">i4").tobytes() for _ in range(2))
    point = np.array([(1, 2, 3, 4, 5, 6)] * 2, ">f4,>f4,>f8,u1,u1,u1").tobytes()
    text = b"3 0 1 0\n3 1 0 1\n1 2 3 4 5 6\n7 8 9.5 1 2 255\n"
    return {"text": head.format("ascii").encode() + text, "big": head.format("binary_big_endian").encode() + faces + point}


def _colmap_text() -> Files:
    return {
        "cameras.txt": b"# comment\n3 PINHOLE 640 480 500 510 320 240\n1 SIMPLE_RADIAL 640 480 500 320 240 0.1\n",
        "images.txt": b"4 1 0 0 0 0 0 5 3 a b.png\n1.5 2.5 7 3 4 -1 5 6 9\n2 0 0 0 2 1 2 3 1 c.png\n8 9 7\n",
        "points3D.txt": b"7 1 2 3 255 0 51 0.5 4 0 2 0\n9 4 5 6 1 2 3 0.5 4 2\n",
        "rigs.txt": b"1 2 CAMERA 1 CAMERA 3 1 1 0 0 0 0 0 1\n",
        "frames.txt": b"1 1 1 0 0 0 0 0 4 1 CAMERA 3 4\n2 1 0 0 0 1 1 2 3 1 CAMERA 1 2\n",
        "unregistered.txt": b"11 3 d e.png\n",
    }


if __name__ == "__main__":
    main(["bench.fuzz.files"], __doc__)
