"""Formats of other programs: back as they were, and projecting as their documentation says, written out here anew."""

import json
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import small_model
import torch
from command_line import torchsfm
from full_disk import full_disk

from torchsfm.formats import (
    read_bundler,
    read_model,
    read_nvm,
    read_openmvg,
    read_opensfm,
    undistorted_model,
    write_bundler,
    write_gltf,
    write_kitti,
    write_model,
    write_nvm,
    write_openmvg,
    write_opensfm,
    write_ply,
    write_tum,
)
from torchsfm.formats.registry import FORMATS
from torchsfm.geometry import Camera
from torchsfm.images import save_image
from torchsfm.reconstruction import Reconstruction


def pinholes() -> Reconstruction:
    """Two cameras of two sizes, the principal point centred; no image without a pose."""
    model = undistorted_model(small_model.make("radial"), centred=True)
    K = model.cameras.K.repeat(2, 1, 1)
    K[1, :2, :2] *= 1.1
    K[1, :2, 2] = torch.tensor([300.5, 250.0])
    size = model.image_size.clone()
    size[1] = torch.tensor([602, 501])
    new = replace(model, cameras=Camera(K), camera_index=torch.tensor([0, 1, 0]), image_size=size)
    return replace(new, x=new.projections() + (model.x - model.projections()))


def oblong(lens: str) -> Reconstruction:
    """Pixels that are not square, and a principal point off the centre."""
    model = small_model.make(lens)
    K = model.cameras.K.clone()
    K[:, 1, 1] *= 1.1
    K[:, 0, 2] += 5
    return replace(model, cameras=Camera(K, model.cameras.distortion))


def off_centre(lens: str) -> Reconstruction:
    model = small_model.make(lens)
    K = model.cameras.K.clone()
    K[:, :2, 2] += torch.tensor([3.0, -4.0])
    return replace(model, cameras=Camera(K, model.cameras.distortion))


Pixels = Callable[[Path, Reconstruction], list[list[float]]]


def distorted(x: float, y: float, k: dict[str, float]) -> tuple[float, float]:
    s = x * x + y * y
    radial = 1 + k.get("k1", 0) * s + k.get("k2", 0) * s**2 + k.get("k3", 0) * s**3
    p1, p2 = k.get("p1", 0), k.get("p2", 0)
    return x * radial + 2 * p1 * x * y + p2 * (s + 2 * x * x), y * radial + 2 * p2 * x * y + p1 * (s + 2 * y * y)


def fisheye(x: float, y: float, k: list[float]) -> tuple[float, float]:
    r = math.hypot(x, y)
    theta = math.atan(r)
    scale = theta * (1 + sum(c * theta ** (2 * i + 2) for i, c in enumerate(k))) / r
    return x * scale, y * scale


def bundler_pixels(path: Path, model: Reconstruction) -> list[list[float]]:
    lines = path.read_text().splitlines()
    assert lines[0] == "# Bundle file v0.3"
    v, n = map(int, lines[1].split())
    cameras = [[[float(w) for w in line.split()] for line in lines[2 + 5 * i : 7 + 5 * i]] for i in range(v)]
    found = []
    for k in range(n):
        X = np.array([float(w) for w in lines[2 + 5 * v + 3 * k].split()])
        words = lines[2 + 5 * v + 3 * k + 2].split()
        for i in [int(w) for w in words[1::4]]:
            (f, k1, k2), *R, t = cameras[i]
            P = np.array(R) @ X + t
            p = -P[:2] / P[2]
            p = f * (1 + k1 * p @ p + k2 * (p @ p) ** 2) * p
            width, height = model.image_size[i].tolist()
            found.append([p[0] + (width - 1) / 2, (height - 1) / 2 - p[1]])
    return found


def nvm_pixels(path: Path, model: Reconstruction) -> list[list[float]]:
    lines = [line.split() for line in path.read_text().splitlines() if line]
    assert lines[0] == ["NVM_V3"]
    v = int(lines[1][0])
    assert [words[0].replace('"', " ") for words in lines[2 : 2 + v]] == list(model.names)
    cameras = np.array([[float(w) for w in words[1:]] for words in lines[2 : 2 + v]])
    assert not cameras[:, -2:].any()
    found = []
    for words in lines[3 + v : 3 + v + int(lines[2 + v][0])]:
        for i in [int(w) for w in words[7::4]]:
            f, w, a, b, c = cameras[i, :5]
            R = np.array([
                [1 - 2 * (b * b + c * c), 2 * (a * b - w * c), 2 * (a * c + w * b)],
                [2 * (a * b + w * c), 1 - 2 * (a * a + c * c), 2 * (b * c - w * a)],
                [2 * (a * c - w * b), 2 * (b * c + w * a), 1 - 2 * (a * a + b * b)],
            ])  # fmt: skip
            P = R @ (np.array([float(word) for word in words[:3]]) - cameras[i, 5:8])
            width, height = model.image_size[i].tolist()
            found.append([f * P[0] / P[2] + (width - 1) / 2, f * P[1] / P[2] + (height - 1) / 2])
    return found


def openmvg_pixels(path: Path, model: Reconstruction) -> list[list[float]]:
    content = json.loads(path.read_text())
    intrinsics = {e["key"]: e["value"]["ptr_wrapper"]["data"] for e in content["intrinsics"]}
    views = {e["key"]: e["value"]["ptr_wrapper"]["data"] for e in content["views"]}
    poses = {e["key"]: e["value"] for e in content["extrinsics"]}
    # The archive's own rule: a type is named once, where its number has the highest bit.
    heads = [e["value"] for e in content["intrinsics"]]
    assert all(("polymorphic_name" in head) == (head["polymorphic_id"] >= 2**31) for head in heads)
    objects = [e["value"]["ptr_wrapper"]["id"] for e in content["intrinsics"] + content["views"]]
    assert len(set(objects)) == len(objects)
    found = []
    for point in content["structure"]:
        for o in point["value"]["observations"]:
            view = views[o["key"]]
            pose, data = poses[view["id_pose"]], intrinsics[view["id_intrinsic"]]
            P = np.array(pose["rotation"]) @ (np.array(point["value"]["X"]) - pose["center"])
            x, y = P[0] / P[2], P[1] / P[2]
            plain = data.get("value0", data)
            if "fisheye" in data:
                x, y = fisheye(x, y, data["fisheye"])
            elif "disto_t2" in data:
                x, y = distorted(x, y, dict(zip(("k1", "k2", "k3", "p1", "p2"), data["disto_t2"], strict=True)))
            elif "disto_k3" in data:
                x, y = distorted(x, y, dict(zip(("k1", "k2", "k3"), data["disto_k3"], strict=True)))
            f, (cx, cy) = plain["focal_length"], plain["principal_point"]
            found.append([f * x + cx, f * y + cy])
    return found


def opensfm_pixels(path: Path, model: Reconstruction) -> list[list[float]]:
    cv2 = pytest.importorskip("cv2")
    (content,) = json.loads(path.read_text())
    lines = path.with_name("tracks.csv").read_text().splitlines()
    assert lines[0] == "OPENSFM_TRACKS_VERSION_v2"
    found = []
    for line in lines[1:]:
        name, track, *_ = line.split("\t")
        shot = content["shots"][name]
        camera = content["cameras"][shot["camera"]]
        P = cv2.Rodrigues(np.array(shot["rotation"]))[0] @ content["points"][track]["coordinates"] + shot["translation"]
        x, y = P[0] / P[2], P[1] / P[2]
        if camera["projection_type"] == "fisheye_opencv":
            x, y = fisheye(x, y, [camera[f"k{i}"] for i in range(1, 5)])
        else:
            x, y = distorted(x, y, camera)
        if camera["projection_type"] == "perspective":
            x, y = camera["focal"] * x, camera["focal"] * y
        else:
            x, y = camera["focal_x"] * x + camera["c_x"], camera["focal_y"] * y + camera["c_y"]
        size = max(camera["width"], camera["height"])
        found.append([x * size + camera["width"] / 2 - 0.5, y * size + camera["height"] / 2 - 0.5])
    return found


@dataclass(frozen=True)
class Case:
    name: str
    write: Callable[[Reconstruction, Path], None]
    read: Callable[[Path], Reconstruction]
    pixels: Pixels
    models: tuple[Callable[[], Reconstruction], ...]
    keeps_unposed: bool = True


def make(lens: str) -> Callable[[], Reconstruction]:
    return lambda: small_model.make(lens)


CASES = {
    case.name: case
    for case in (
        Case("bundle.out", write_bundler, read_bundler, bundler_pixels, (make("radial"), make("pinhole"), pinholes)),
        Case("model.nvm", write_nvm, read_nvm, nvm_pixels, (pinholes,), keeps_unposed=False),
        Case("sfm_data.json", write_openmvg, read_openmvg, openmvg_pixels,
             (make("pinhole"), make("simple_radial"), make("radial"), make("opencv"), make("fisheye"),
              lambda: off_centre("opencv"), pinholes)),
        Case("reconstruction.json", write_opensfm, read_opensfm, opensfm_pixels,
             (make("pinhole"), make("radial"), make("opencv"), make("fisheye"), lambda: oblong("radial"),
              lambda: oblong("fisheye"), lambda: off_centre("radial"), pinholes), keeps_unposed=False),
    )
}  # fmt: skip
MODELS = [(case, k) for case in CASES for k in range(len(CASES[case].models))]


@pytest.mark.parametrize(("case", "k"), MODELS)
def test_the_file_projects_as_its_documentation_says(case: str, k: int, tmp_path: Path) -> None:
    kind = CASES[case]
    model = kind.models[k]()
    kind.write(model, tmp_path / case)
    found = torch.tensor(kind.pixels(tmp_path / case, model))
    torch.testing.assert_close(found, model.projections(), rtol=0, atol=1e-6, check_dtype=False)


@pytest.mark.parametrize(("case", "k"), MODELS)
def test_a_model_comes_back(case: str, k: int, tmp_path: Path) -> None:
    kind = CASES[case]
    model = kind.models[k]()
    # Their formats do not tell the sizes of images: the files do.
    for name, (width, height) in zip(model.names, model.image_size.tolist(), strict=True):
        save_image(tmp_path / name, torch.zeros(height, width))
    kind.write(model, tmp_path / case)
    again = kind.read(tmp_path / case)
    kept = model.registered if not kind.keeps_unposed else torch.ones_like(model.registered)
    assert again.names == tuple(name for name, there in zip(model.names, kept.tolist(), strict=True) if there)
    assert again.image_size.equal(model.image_size[kept])
    assert again.registered.equal(model.registered[kept])
    for name in ("X", "x", "view", "point"):
        torch.testing.assert_close(getattr(again, name), getattr(model, name), rtol=0, atol=1e-9)
    posed = model.registered[kept]
    torch.testing.assert_close(again.poses.matrix()[posed], model.poses.matrix()[kept][posed], rtol=0, atol=1e-9)
    torch.testing.assert_close(again.projections(), model.projections(), rtol=0, atol=1e-9)
    if case != "sfm_data.json":
        torch.testing.assert_close(again.color, model.color, rtol=0, atol=0.5 / 255 + 1e-9)
    assert read_model(tmp_path / case).names == again.names
    assert read_model(tmp_path).X.equal(again.X)


def test_sizes_of_images_that_are_not_there_hold_the_observations(tmp_path: Path) -> None:
    model = pinholes()
    for write, name in ((write_bundler, "bundle.out"), (write_nvm, "model.nvm")):
        write(model, tmp_path / name)
        again = read_model(tmp_path / name)
        assert bool(((again.x >= -0.5) & (again.x <= again.image_size[again.view] - 0.5)).all())
        torch.testing.assert_close(again.residuals(), model.residuals(), rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("write", "model", "words"),
    [
        (write_bundler, lambda: oblong("radial"), "not square"),
        (write_bundler, lambda: off_centre("radial"), "principal point at the centre"),
        (write_bundler, lambda: small_model.make("opencv"), "Bundler holds k1, k2, not BrownConrady"),
        (write_nvm, lambda: small_model.make("radial"), "NVM holds no distortion, not Radial"),
        (write_openmvg, lambda: oblong("radial"), "not square"),
        (write_gltf, lambda: small_model.make("radial"), "no Radial distortion"),
        (write_gltf, lambda: off_centre("pinhole"), "principal point at the centre"),
        (write_bundler, lambda: replace(small_model.make("radial"), names=("a\nb", "b", "c", "d")), "cannot hold the name"),
        (write_nvm, lambda: replace(pinholes(), names=("a\tb", "b", "c")), "cannot hold the name"),
        (write_opensfm, lambda: replace(pinholes(), names=("a\tb", "b", "c")), "cannot hold the name"),
    ],
)
def test_what_a_format_cannot_hold_is_not_written(
    write: Callable[[Reconstruction, Path], None], model: Callable[[], Reconstruction], words: str, tmp_path: Path
) -> None:
    with pytest.raises(ValueError, match=words):
        write(model(), tmp_path / "out")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("name", "lens", "zero"),
    [
        ("model.nvm", "radial", ("k1", "k2")),
        ("model.glb", "opencv", ("k1", "k2", "k3", "p1", "p2")),
        ("bundle.out", "opencv", ("k3", "p1", "p2")),
        ("model.txt", "opencv", ("k3", "p1", "p2")),
    ],
)
def test_distortion_of_zero_is_none(name: str, lens: str, zero: tuple[str, ...], tmp_path: Path) -> None:
    """A format holds a lens whose other numbers are 0, and none where one of them is not."""
    model = small_model.make(lens)
    numbers = {key: getattr(model.cameras.distortion, key) for key in model.cameras.distortion.parameter_names}
    idle = replace(model.cameras.distortion, **{key: torch.zeros_like(numbers[key]) for key in zero})
    model = replace(model, cameras=Camera(model.cameras.K, idle))
    write_model(model, tmp_path / name)
    if name != "model.glb":
        again = read_model(tmp_path / name).residuals()
        torch.testing.assert_close(again.sort().values, model.residuals().sort().values, rtol=0, atol=1e-8)
    for key in zero:
        bent = replace(model, cameras=Camera(model.cameras.K, replace(idle, **{key: numbers[key]})))
        with pytest.raises(ValueError, match=r"distortion|holds"):
            write_model(bent, tmp_path / "new" / name)


@pytest.mark.parametrize("case", CASES)
def test_what_is_no_such_file(case: str, tmp_path: Path) -> None:
    kind = CASES[case]
    kind.write(kind.models[0](), tmp_path / case)
    good = (tmp_path / case).read_bytes()
    texts = (b"", b"words", b"{}", b"[]", b"[[]]", b"[" * 100_000, b'{"frames": 3}', b"NVM_V3\n1\n", good[: len(good) // 2])
    changes = (good.replace(b"0", b"x"), good.replace(b".", b"e999"), good[:-300], good.replace(b"1", b"\xff"))
    for data in (*texts, *changes):
        (tmp_path / case).write_bytes(data)
        with pytest.raises(ValueError) as caught:  # noqa: PT011
            kind.read(tmp_path / case)
        assert str(tmp_path / case) in str(caught.value)
        assert "\n" not in str(caught.value)


def test_no_room_is_made_for_points_that_are_not_there(tmp_path: Path) -> None:
    path = tmp_path / "bundle.out"
    write_bundler(pinholes(), path)
    head, counts, rest = path.read_bytes().split(b"\n", 2)
    path.write_bytes(b"\n".join((head, counts.split()[0] + b" 1099511627775", rest)))
    with pytest.raises(ValueError, match="ends too early"):
        read_bundler(path)


def test_nvm_with_distortion_is_refused(tmp_path: Path) -> None:
    write_nvm(pinholes(), tmp_path / "a.nvm")
    text = (tmp_path / "a.nvm").read_text()
    (tmp_path / "a.nvm").write_text(text.replace(" 0 0\n", " -0.1 0\n", 1))
    with pytest.raises(ValueError, match="radial distortion"):
        read_nvm(tmp_path / "a.nvm")
    (tmp_path / "a.nvm").write_text(text.replace("NVM_V3", "NVM_V3 FixedK 500 320 500 240 0", 1))
    with pytest.raises(ValueError, match="first line"):
        read_nvm(tmp_path / "a.nvm")


@pytest.mark.parametrize("case", CASES)
def test_a_full_disk_leaves_the_file_before(case: str, tmp_path: Path) -> None:
    kind = CASES[case]
    model = kind.models[0]()
    kind.write(model, tmp_path / case)
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    with full_disk(200), pytest.raises(OSError, match="File too large"):
        kind.write(model, tmp_path / case)
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before


@pytest.mark.reference
def test_evo_reads_the_trajectories(tmp_path: Path) -> None:
    file_interface = pytest.importorskip("evo.tools.file_interface")
    model = replace(small_model.make("radial"), registered=torch.tensor([True, False, True, True]))
    write_tum(model, tmp_path / "a.tum")
    write_kitti(model, tmp_path / "a.kitti")
    tum = file_interface.read_tum_trajectory_file(str(tmp_path / "a.tum"))
    kitti = file_interface.read_kitti_poses_file(str(tmp_path / "a.kitti"))
    posed = model.poses[model.registered]
    wanted = np.tile(np.eye(4), (3, 1, 1))
    wanted[:, :3] = torch.cat([posed.R.mT, posed.centre[..., None]], -1).numpy()
    assert tum.timestamps.tolist() == [0, 2, 3]
    for poses in (tum.poses_se3, kitti.poses_se3):
        assert np.abs(np.array(poses) - wanted).max() < 1e-9


@pytest.mark.reference
def test_gltf_is_read_by_others(tmp_path: Path) -> None:
    pygltflib, trimesh = pytest.importorskip("pygltflib"), pytest.importorskip("trimesh")
    model = pinholes()
    write_gltf(model, tmp_path / "a.glb")
    scene = pygltflib.GLTF2().load(str(tmp_path / "a.glb"))
    nodes = {node.name: node for node in scene.nodes}
    projections = model.projections()
    for row, (i, k) in enumerate(zip(model.view.tolist(), model.point.tolist(), strict=True)):
        node = nodes[model.names[i]]
        P = np.linalg.inv(np.array(node.matrix).reshape(4, 4).T) @ [*model.X[k].tolist(), 1]
        view = scene.cameras[node.camera].perspective
        width, height = model.image_size[i].tolist()
        scale = 1 / math.tan(view.yfov / 2)
        # Normalised device coordinates: -1 and 1 are the borders of the picture.
        x, y = scale / view.aspectRatio * P[0] / -P[2], scale * P[1] / -P[2]
        pixel = torch.tensor([(x + 1) * width / 2 - 0.5, (1 - y) * height / 2 - 0.5])
        torch.testing.assert_close(pixel, projections[row], rtol=0, atol=1e-6, check_dtype=False)
    (cloud,) = trimesh.load(tmp_path / "a.glb").geometry.values()
    assert np.array_equal(cloud.vertices, model.X.float().numpy())
    assert np.abs(cloud.colors[:, :3] / 255 - model.color.numpy()).max() < 0.5 / 255 + 1e-6
    empty = replace(model, X=model.X[:0], color=model.color[:0], x=model.x[:0], view=model.view[:0], point=model.point[:0])
    write_gltf(empty, tmp_path / "b.glb")
    assert len(pygltflib.GLTF2().load(str(tmp_path / "b.glb")).cameras) == 3


@pytest.mark.reference
def test_plyfile_reads_the_points(tmp_path: Path) -> None:
    plyfile = pytest.importorskip("plyfile")
    model = small_model.make("radial")
    write_ply(model, tmp_path / "a.ply")
    vertex = plyfile.PlyData.read(str(tmp_path / "a.ply"))["vertex"]
    assert np.array_equal(np.stack([vertex[axis] for axis in "xyz"], 1), model.X.numpy())
    assert np.abs(vertex["green"] / 255 - model.color[:, 1].numpy()).max() < 0.5 / 255 + 1e-6


@pytest.mark.parametrize("kind", [kind for kind in FORMATS if kind.write], ids=lambda kind: kind.name)
def test_every_format_is_known_by_its_content(kind: object, tmp_path: Path) -> None:
    """Whatever the name says: a file that is renamed is read all the same."""
    assert isinstance(kind, type(FORMATS[0]))
    name = kind.files[0] if kind.files and not kind.files[0].startswith(".") else "model" + "".join(kind.files[:1])
    write_model(pinholes(), tmp_path / name, kind.name)
    written = tmp_path / name
    if kind.marks is not None:
        written = written.rename(tmp_path / "model.xyz")
        head = written.read_bytes()
        assert next(other.name for other in FORMATS if other.marks and other.marks.match(head)) == kind.name
        assert read_model(written).num_points == 30
    if kind.read is None and kind.name != "colmap-text":
        status, _, stderr = torchsfm("info", written)
        assert status == 2
        assert "not a model of a known kind" in stderr


def test_opensfm_reads_its_own_example(data: Path) -> None:
    """A reconstruction by that program, whose tracks fit it."""
    folder = data / "images" / "opensfm_berlin"
    (folder / "reconstruction_example.json").stat()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("torchsfm.formats.opensfm.TRACKS", "tracks_example.csv")
        model = read_opensfm(folder / "reconstruction_example.json")
    assert model.num_registered == 3
    assert model.num_observations > 100
    assert float(model.residuals().median()) < 1.5
