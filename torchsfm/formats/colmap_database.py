"""`database.db` of COLMAP and hloc: keypoints and matches in SQLite, both ways.

COLMAP puts the centre of the top-left pixel at (0.5, 0.5), this library at (0, 0): the half pixel is added and taken away here.
Keypoints are in single precision there. A pair of images i < j has the number 2147483647 i + j.
"""

import os
import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchsfm.formats.colmap_model import MAX_SIZE, PARAMETERS
from torchsfm.formats.joining import reading
from torchsfm.linalg.devices import on_the_cpu
from torchsfm.reconstruction.matched import MatchedImages
from torchsfm.reconstruction.matching.known_features import KnownFeatures
from torchsfm.reconstruction.model.files import whole_file

HALF_PIXEL = 0.5
MAX_IMAGES = 2147483647
SIFT = 128
"""Numbers of a descriptor."""
MODELS = {parameters.number: parameters for parameters in PARAMETERS.values()}
DEFAULT_FOCAL = 1.2
"""Focal length over the longer side of the image that COLMAP, too, starts from where nothing tells it."""

SCHEMA = """
CREATE TABLE cameras (camera_id INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL, model INTEGER NOT NULL, width INTEGER NOT NULL,
    height INTEGER NOT NULL, params BLOB, prior_focal_length INTEGER NOT NULL);
CREATE TABLE images (image_id INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL, name TEXT NOT NULL UNIQUE, camera_id INTEGER NOT NULL,
    CONSTRAINT image_id_check CHECK(image_id >= 0 and image_id < 2147483647),
    FOREIGN KEY(camera_id) REFERENCES cameras(camera_id));
CREATE UNIQUE INDEX index_name ON images(name);
CREATE TABLE keypoints (image_id INTEGER PRIMARY KEY NOT NULL, rows INTEGER NOT NULL, cols INTEGER NOT NULL, data BLOB,
    FOREIGN KEY(image_id) REFERENCES images(image_id) ON DELETE CASCADE);
CREATE TABLE matches (pair_id INTEGER PRIMARY KEY NOT NULL, rows INTEGER NOT NULL, cols INTEGER NOT NULL, data BLOB);
"""
"""The tables that are filled; COLMAP makes the others when it opens the file."""


@on_the_cpu
def read_database(path: str | Path) -> MatchedImages:
    """Read keypoints and matches from COLMAP's database, for `reconstruct_matches`.

    Args:
        path: The file, which is not changed.

    Returns:
        Images in the order of COLMAP's numbers, with their cameras. A focal length is known where the database says that it was
        (COLMAP then read it from the Exif tags). Matches are those of the table `matches`, or where it is empty the verified
        ones of `two_view_geometries`.

    Raises:
        ValueError: The file is no such database, or a damaged one; one line that says why.
        OSError: It cannot be read.

    Example:
        >>> import torch, torchsfm
        >>> x, match = torch.rand(10, 2, generator=torch.Generator().manual_seed(0)), torch.arange(10)
        >>> pairs, matches = torch.tensor([[0, 1]]), (torch.stack((match, match), 1),)
        >>> size = torch.tensor([[640, 480], [640, 480]])
        >>> matched = torchsfm.MatchedImages(("a.jpg", "b.jpg"), size, (x, x), pairs, matches)
        >>> torchsfm.write_database(matched, "database.db")
        >>> found = torchsfm.read_database("database.db")
        >>> found.names, found.matches[0].shape
        (('a.jpg', 'b.jpg'), torch.Size([10, 2]))
    """
    path = Path(path)
    with path.open("rb"):
        pass
    with reading(path, "a COLMAP database"), _opened(path) as database:
        cameras = {}
        for camera_id, model, width, height, params, known in database.execute(
            "SELECT camera_id, model, width, height, params, prior_focal_length FROM cameras ORDER BY camera_id"
        ):
            if not (0 < width < MAX_SIZE and 0 < height < MAX_SIZE):
                raise ValueError(f"camera {camera_id} has images of {width} x {height} pixels")
            focals = np.frombuffer(params or b"", "<f8")[: MODELS[model].focals if model in MODELS else 1]
            told = known and len(focals) and bool((np.isfinite(focals) & (focals > 0)).all())
            cameras[camera_id] = (int(width), int(height)), float(focals.mean()) if told else None
        rows = database.execute("SELECT image_id, name, camera_id FROM images ORDER BY image_id").fetchall()
        image_of = {image_id: i for i, (image_id, _, _) in enumerate(rows)}
        number_of = {camera_id: k for k, camera_id in enumerate(sorted({camera_id for _, _, camera_id in rows}))}
        taken = [cameras[camera_id] for _, _, camera_id in rows]
        keypoints = [torch.zeros(0, 2)] * len(rows)
        for image_id, count, columns, data in database.execute("SELECT image_id, rows, cols, data FROM keypoints"):
            table = _table(data, count, columns, np.dtype("<f4"), 2)
            keypoints[image_of[image_id]] = torch.from_numpy(table[:, :2] - np.float32(HALF_PIXEL))
        pairs: list[list[int]] = []
        matches: list[Tensor] = []
        for source in ("matches", "two_view_geometries"):
            if matches or not _has_table(database, source):
                continue
            query = f"SELECT pair_id, rows, cols, data FROM {source} WHERE rows > 0 ORDER BY pair_id"
            for pair_id, count, columns, data in database.execute(query):
                table = _table(data, count, columns, np.dtype("<u4"), 2)[:, :2].astype(np.int64)
                pair = [image_of[image_id] for image_id in divmod(pair_id, MAX_IMAGES)]
                if pair[0] == pair[1] or (table >= [len(keypoints[i]) for i in pair]).any():
                    raise ValueError(f"the matches of pair {pair_id} are of keypoints that are not there")
                pairs.append(pair)
                matches.append(torch.from_numpy(table))
        return MatchedImages(
            names=tuple(str(name) for _, name, _ in rows),
            image_size=torch.tensor([size for size, _ in taken], dtype=torch.long).reshape(-1, 2),
            keypoints=tuple(keypoints),
            pairs=torch.tensor(pairs, dtype=torch.long).reshape(-1, 2),
            matches=tuple(matches),
            camera_index=torch.tensor([number_of[camera_id] for _, _, camera_id in rows], dtype=torch.long),
            focal=tuple(focal for _, focal in taken),
        )


@on_the_cpu
def read_features(path: str | Path) -> KnownFeatures:
    """Read keypoints with their descriptors from COLMAP's database, for `register_photographs`.

    COLMAP's descriptors are RootSIFT, times 512 as bytes, unless it was told otherwise; they become those of
    `detect_features`, times 256. Images without descriptors are left out.

    Args:
        path: The file, which is not changed.

    Raises:
        ValueError: The file is no such database, a damaged one, or holds no descriptors; one line that says why.
        OSError: It cannot be read.

    Example:
        >>> import sqlite3, torch, torchsfm
        >>> x, none = torch.rand(10, 2, generator=torch.Generator().manual_seed(0)), torch.zeros(0, 2, dtype=torch.int64)
        >>> size, pairs = torch.tensor([[640, 480], [640, 480]]), torch.tensor([[0, 1]])
        >>> torchsfm.write_database(torchsfm.MatchedImages(("a.jpg", "b.jpg"), size, (x, x), pairs, (none,)), "database.db")
        >>> database = sqlite3.connect("database.db")
        >>> table = database.execute("CREATE TABLE descriptors (image_id INTEGER PRIMARY KEY, rows INT, cols INT, data BLOB)")
        >>> rows = [(image, 10, 128, bytes([45]) * 1280) for image in (1, 2)]  # of both images
        >>> change = database.executemany("INSERT INTO descriptors VALUES (?, ?, ?, ?)", rows)
        >>> database.commit()
        >>> database.close()
        >>> known = torchsfm.formats.read_features("database.db")  # as register_photographs takes them
        >>> known.names, known.descriptors[0].shape
        (('a.jpg', 'b.jpg'), torch.Size([10, 128]))
    """
    path = Path(path)
    matched = read_database(path)
    with reading(path, "a COLMAP database"), _opened(path) as database:
        if not _has_table(database, "descriptors"):
            raise ValueError("it has no table descriptors")
        numbers = [image_id for (image_id,) in database.execute("SELECT image_id FROM images ORDER BY image_id")]
        place = {image_id: i for i, image_id in enumerate(numbers)}
        found: dict[int, Tensor] = {}
        for image_id, count, columns, data in database.execute("SELECT image_id, rows, cols, data FROM descriptors"):
            table = _table(data, count, columns, np.dtype("u1"), SIFT)
            i = place[image_id]
            if table.shape != (len(matched.keypoints[i]), SIFT):
                raise ValueError(f"the descriptors of image {image_id} are of shape {table.shape}")
            found[i] = torch.from_numpy(((table.astype(np.uint16) + 1) // 2).clip(max=127).astype(np.uint8))
        chosen = [i for i in sorted(found) if len(found[i])]
        if not chosen:
            raise ValueError("it holds no descriptors")
        return KnownFeatures(
            tuple(matched.names[i] for i in chosen),
            tuple(matched.keypoints[i] for i in chosen),
            tuple(found[i] for i in chosen),
            ("",) * len(chosen),
        )


@on_the_cpu
def write_database(matched: MatchedImages, path: str | Path) -> None:
    """Write keypoints and matches as a database that COLMAP opens, verifies (`colmap geometric_verifier`) and maps.

    Every camera is a SIMPLE_RADIAL with the known focal length, else with one to start from, and without distortion.

    Args:
        matched: Keypoints and matches; weights have no place in the database.
        path: The file to write; one that is there is replaced.

    Raises:
        ValueError: Two images have one name, or one camera has two sizes of images.
        OSError: The file cannot be written.

    Example:
        >>> import torch, torchsfm
        >>> x, match = torch.rand(10, 2, generator=torch.Generator().manual_seed(0)), torch.arange(10)
        >>> size = torch.tensor([[640, 480], [640, 480]])
        >>> pairs, matches = torch.tensor([[0, 1]]), (torch.stack((match, match), 1),)
        >>> torchsfm.write_database(torchsfm.MatchedImages(("a.jpg", "b.jpg"), size, (x, x), pairs, matches), "database.db")
        >>> import sqlite3
        >>> database = sqlite3.connect("database.db")
        >>> database.execute("SELECT name FROM images").fetchall()
        [('a.jpg',), ('b.jpg',)]
        >>> database.close()
    """
    if len(set(matched.names)) < len(matched.names):
        raise ValueError("matched: wanted a name for each image, got one twice")
    index = torch.arange(len(matched.names)) if matched.camera_index is None else matched.camera_index
    focal = matched.focal or (None,) * len(matched.names)
    with closing(sqlite3.connect(":memory:")) as database:
        database.executescript(SCHEMA)
        for k in torch.unique(index).tolist():
            members = (index == k).nonzero()[:, 0].tolist()
            sizes = torch.unique(matched.image_size[members], dim=0).tolist()
            if len(sizes) > 1:
                raise ValueError(f"matched: wanted one size of image a camera, got {sizes} of camera {k}")
            width, height = sizes[0]
            known = [f for f in (focal[i] for i in members) if f]
            f = float(np.median(known)) if known else DEFAULT_FOCAL * max(width, height)
            params = np.array([f, width / 2, height / 2, 0.0], "<f8").tobytes()
            model = PARAMETERS["SIMPLE_RADIAL"].number
            database.execute(
                "INSERT INTO cameras VALUES (?, ?, ?, ?, ?, ?)", (k + 1, model, width, height, params, bool(known))
            )
        for i, name in enumerate(matched.names):
            text = name.encode("utf-8", "surrogateescape")
            database.execute("INSERT INTO images VALUES (?, CAST(? AS TEXT), ?)", (i + 1, text, int(index[i]) + 1))
            x = (matched.keypoints[i].detach().cpu().double().numpy() + HALF_PIXEL).astype("<f4")
            database.execute("INSERT INTO keypoints VALUES (?, ?, 2, ?)", (i + 1, len(x), x.tobytes()))
        collected: dict[int, NDArray[np.uint32]] = {}
        for (i, j), m in zip(matched.pairs.tolist(), matched.matches, strict=True):
            rows = (m if i < j else m.flip(1)).cpu().numpy().astype("<u4")
            pair_id = MAX_IMAGES * (min(i, j) + 1) + max(i, j) + 1
            collected[pair_id] = np.concatenate([collected[pair_id], rows]) if pair_id in collected else rows
        for pair_id, rows in collected.items():
            database.execute("INSERT INTO matches VALUES (?, ?, 2, ?)", (pair_id, len(rows), rows.tobytes()))
        database.commit()
        content = database.serialize()
    with whole_file(path) as file:
        file.write(content)


@contextmanager
def _opened(path: Path) -> Iterator[sqlite3.Connection]:
    """The database, to be read only; its errors are those of a bad file."""
    try:
        with closing(sqlite3.connect(f"file:{quote(os.fsencode(path.absolute()))}?mode=ro&immutable=1", uri=True)) as database:
            database.text_factory = lambda data: data.decode("utf-8", "surrogateescape")
            if missing := [name for name in ("cameras", "images", "keypoints") if not _has_table(database, name)]:
                raise ValueError(f"it has no table {missing[0]}")
            yield database
    except sqlite3.Error as error:
        raise ValueError(str(error)) from None


def _has_table(database: sqlite3.Connection, name: str) -> bool:
    query = "SELECT count(*) FROM sqlite_master WHERE type = 'table' AND name = ?"
    return bool(database.execute(query, (name,)).fetchone()[0])


def _table(data: Any, rows: Any, columns: Any, kind: np.dtype, least: int) -> NDArray:  # type: ignore[type-arg]
    """A table of numbers as the database holds it, where a damaged one may hold anything."""
    data = b"" if data is None else data
    if not (isinstance(rows, int) and isinstance(columns, int) and isinstance(data, bytes)):
        raise ValueError(f"{str(rows)[:20]} x {str(columns)[:20]} is no size of a table of numbers")
    if rows and (columns < least or rows < 0 or len(data) != rows * columns * kind.itemsize):
        raise ValueError(f"{len(data)} bytes are no table of {rows} x {columns} numbers")
    return np.frombuffer(data, kind).reshape(rows, columns) if rows else np.empty((0, least), kind)
