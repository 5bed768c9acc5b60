import dataclasses
import math
import sys

import pytest
import torch
from full_disk import full_disk

from torchsfm.formats import read_colmap, write_colmap
from torchsfm.geometry import (
    DISTORTION_MODELS,
    BrownConrady,
    Camera,
    KannalaBrandt,
    NoDistortion,
    Pose,
    Radial,
    SimpleRadial,
    random_rotation,
)
from torchsfm.reconstruction.model.reconstruction import Reconstruction

F64 = torch.float64
KINDS = {
    "SIMPLE_PINHOLE": (1.0, "pinhole", []),
    "PINHOLE": (1.1, "pinhole", []),
    "SIMPLE_RADIAL": (1.0, "simple_radial", [-0.1]),
    "RADIAL": (1.0, "radial", [-0.1, 0.03]),
    "OPENCV": (1.1, "opencv", [-0.1, 0.03, 0.001, -0.002, 0.0]),
    "FULL_OPENCV": (1.0, "opencv", [-0.1, 0.03, 0.001, -0.002, 0.01]),
    "OPENCV_FISHEYE": (1.05, "fisheye", [-0.02, 0.01, -0.003, 0.001]),
}


@pytest.fixture
def pycolmap():
    return pytest.importorskip("pycolmap")


def make(kind="RADIAL", *, generator, cameras=2, views=5, points=30, unregistered=(3,), dtype=F64):
    """A model with exact observations, sorted as they should be, in which some images have no pose."""
    aspect, model, parameters = KINDS[kind]
    f = torch.linspace(500, 600, cameras, dtype=F64)
    K = torch.zeros(cameras, 3, 3, dtype=F64)
    K[:, 0, 0], K[:, 1, 1], K[:, 0, 2], K[:, 1, 2], K[:, 2, 2] = f, f * aspect, 319.5, 241.25, 1
    p = torch.tensor(parameters, dtype=F64) * torch.linspace(1, 0.5, cameras, dtype=F64)[:, None]
    camera = Camera(K, DISTORTION_MODELS[model].from_parameters(p))
    R = random_rotation(views, generator=generator, dtype=F64)
    poses = Pose(R, torch.tensor([0.0, 0.0, 8.0], dtype=F64).expand(views, 3).clone())
    registered = torch.ones(views, dtype=torch.bool)
    registered[list(unregistered)] = False
    poses.R[~registered], poses.t[~registered] = torch.eye(3, dtype=F64), 0
    X = torch.randn(points, 3, generator=generator, dtype=F64)
    seen = (torch.rand(points, views, generator=generator) < 0.7) & registered
    seen[:, 0] = True
    point, view = seen.nonzero(as_tuple=True)
    index = torch.arange(views) % cameras
    x = camera[index[view]].project(poses[view].transform(X[point, None]))[:, 0]
    reconstruction = Reconstruction(
        names=tuple(f"folder/image {i}.jpg" for i in range(views)),
        image_size=torch.tensor([640, 480]).repeat(views, 1),
        cameras=camera,
        camera_index=index,
        poses=poses,
        registered=registered,
        X=X,
        color=torch.randint(0, 256, (points, 3), generator=generator).to(F64) / 255,
        x=x + 0.3 * torch.randn(*x.shape, generator=generator, dtype=F64),
        view=view,
        point=point,
    )
    return reconstruction.to(dtype)


def assert_same(a, b):
    assert a.names == b.names
    for name in ("image_size", "camera_index", "registered", "view", "point"):
        assert getattr(a, name).equal(getattr(b, name)), name
    for name in ("X", "color", "x"):
        torch.testing.assert_close(getattr(a, name), getattr(b, name), rtol=1e-14, atol=1e-12)
    torch.testing.assert_close(a.poses.matrix(), b.poses.matrix(), rtol=1e-13, atol=1e-13)
    torch.testing.assert_close(a.cameras.K, b.cameras.K, rtol=1e-14, atol=1e-12)
    assert type(a.cameras.distortion) is type(b.cameras.distortion)
    assert a.cameras.distortion.parameters().equal(b.cameras.distortion.parameters())


@pytest.mark.parametrize("kind", KINDS)
def test_round_trip(kind, tmp_path, generator, pycolmap):
    model = make(kind, generator=generator)
    write_colmap(model, tmp_path / "a" / "b")
    assert_same(read_colmap(tmp_path / "a" / "b"), model)
    written = pycolmap.Reconstruction(tmp_path / "a" / "b")
    assert {camera.model.name for camera in written.cameras.values()} == {kind}


@pytest.mark.reference
@pytest.mark.parametrize("kind", KINDS)
def test_colmap_sees_the_same_geometry(kind, tmp_path, generator, pycolmap):
    """COLMAP's own projection of the written model gives this library's residuals: half pixels, poses, distortion."""
    model = make(kind, generator=generator)
    write_colmap(model, tmp_path)
    colmap = pycolmap.Reconstruction(tmp_path)
    assert colmap.num_images() == colmap.num_reg_images() == colmap.num_frames() == 4
    assert colmap.num_rigs() == colmap.num_cameras() == 2
    assert colmap.num_points3D() == 30
    residuals = model.residuals()
    total = 0
    for k in range(30):
        mine = model.point == k
        element = colmap.points3D[k + 1].track.elements
        assert sorted(e.image_id for e in element) == (model.view[mine] + 1).tolist()
        assert colmap.points3D[k + 1].error == pytest.approx(residuals[mine].mean().item(), abs=1e-9)
        for e in element:
            image = colmap.images[e.image_id]
            observed = image.points2D[e.point2D_idx]
            assert observed.point3D_id == k + 1
            projected = image.project_point(colmap.points3D[k + 1].xyz)
            row = int((mine & (model.view == e.image_id - 1)).nonzero())
            assert torch.from_numpy(observed.xy - 0.5).allclose(model.x[row], atol=1e-12)
            assert math.dist(projected, observed.xy) == pytest.approx(residuals[row].item(), abs=1e-9)
            total += 1
    assert total == model.num_observations


def test_single_precision_and_rotations_far_from_exact(tmp_path, generator):
    model = make(generator=generator, dtype=torch.float32)
    write_colmap(model, tmp_path)
    again = read_colmap(tmp_path)
    assert again.X.dtype == F64
    torch.testing.assert_close(again.poses.R @ again.poses.R.mT, torch.eye(3, dtype=F64).expand(5, 3, 3), atol=1e-14, rtol=0)
    torch.testing.assert_close(again.residuals(), model.residuals().double(), atol=1e-2, rtol=0)


def test_unequal_focal_lengths_need_a_larger_model(tmp_path, generator):
    for kind in ("SIMPLE_RADIAL", "RADIAL"):
        model = make(kind, generator=generator)
        K = model.cameras.K.clone()
        K[:, 1, 1] *= 1.2
        model = dataclasses.replace(model, cameras=Camera(K, model.cameras.distortion))
        write_colmap(model, tmp_path / kind)
        again = read_colmap(tmp_path / kind)
        assert isinstance(again.cameras.distortion, BrownConrady)
        torch.testing.assert_close(again.residuals(), model.residuals(), rtol=1e-9, atol=1e-9)


def test_skew_is_refused(tmp_path, generator):
    model = make(generator=generator)
    model.cameras.K[1, 0, 1] = 0.5
    with pytest.raises(ValueError, match="camera 1 has skew"):
        write_colmap(model, tmp_path)


def test_cameras_of_several_sizes_are_split_and_unused_ones_left_out(tmp_path, generator):
    model = make(generator=generator, cameras=3, views=4, unregistered=())
    size = model.image_size.clone()
    size[2] = torch.tensor([800, 600])
    model = dataclasses.replace(model, camera_index=torch.tensor([2, 0, 0, 2]), image_size=size)
    write_colmap(model, tmp_path)
    again = read_colmap(tmp_path)
    assert again.image_size.equal(size)
    assert len(again.cameras.K) == 3
    assert again.camera_index[0] == again.camera_index[3]
    assert again.camera_index[1] != again.camera_index[2]
    torch.testing.assert_close(again.cameras[again.camera_index].K, model.cameras[model.camera_index].K)


def test_observations_of_images_without_pose_and_points_without_observations(tmp_path, generator):
    model = make(generator=generator, unregistered=())
    registered = torch.tensor([True, True, False, True, False])
    X = torch.cat([model.X, torch.ones(1, 3, dtype=F64)])
    model = dataclasses.replace(model, registered=registered, X=X, color=torch.cat([model.color, model.color[:1]]))
    write_colmap(model, tmp_path)
    again = read_colmap(tmp_path)
    kept = registered[model.view]
    assert again.X.equal(X)
    assert again.view.equal(model.view[kept])
    assert again.point.equal(model.point[kept])
    assert again.registered.equal(registered)


def test_a_second_model_replaces_the_first(tmp_path, generator):
    write_colmap(make(generator=generator), tmp_path)
    assert (tmp_path / "unregistered.txt").read_text().split(" ", 2) == ["4", "2", "folder/image 3.jpg\n"]
    full = make(generator=generator, views=3, unregistered=())
    write_colmap(full, tmp_path)
    assert not (tmp_path / "unregistered.txt").exists()
    assert_same(read_colmap(tmp_path), full)


def test_nothing_registered(tmp_path, generator):
    model = make(generator=generator)
    none = torch.zeros(5, dtype=torch.bool)
    write_colmap(dataclasses.replace(model, registered=none), tmp_path)
    again = read_colmap(tmp_path)
    assert again.names == model.names
    assert again.num_registered == 0
    assert again.num_observations == 0


NAMES = ("caf\udce9.jpg", "a b\\n.jpg", "line\nbreak\r.jpg", "\u2028.jpg", "<b>|.jpg")


def test_any_file_name_comes_back(tmp_path, generator):
    for unregistered in ((), (0, 1, 2, 3, 4)):
        model = dataclasses.replace(make(generator=generator, unregistered=unregistered[1:]), names=NAMES)
        model = dataclasses.replace(model, registered=torch.tensor([i not in unregistered for i in range(5)]))
        write_colmap(model, tmp_path)
        assert read_colmap(tmp_path).names == NAMES


def test_a_full_disk_leaves_the_model_before(tmp_path, generator):
    model = make(generator=generator)
    write_colmap(model, tmp_path)
    with full_disk(2000), pytest.raises(OSError, match="File too large"):
        write_colmap(make(generator=generator, points=500, unregistered=()), tmp_path)
    assert_same(read_colmap(tmp_path), model)
    assert len(list(tmp_path.iterdir())) == 6


def test_models_of_colmap_itself(tmp_path, pycolmap):
    """Different models in one folder, text files, image points without 3D point, numbers with gaps."""
    colmap = pycolmap.Reconstruction()
    cameras = {7: ("SIMPLE_PINHOLE", [500, 320, 240]), 2: ("OPENCV", [500, 510, 320, 240, 0.1, 0.2, 0.3, 0.4])}
    for i, (name, parameters) in cameras.items():
        camera = pycolmap.Camera(camera_id=i, model=name, width=640, height=480, params=parameters)
        colmap.add_camera(camera)
        rig = pycolmap.Rig(rig_id=i)
        rig.add_ref_sensor(camera.sensor_id)
        colmap.add_rig(rig)
    for image_id, camera_id in ((9, 7), (4, 2)):
        image = pycolmap.Image(name=f"{image_id}.png", camera_id=camera_id, image_id=image_id, keypoints=[[1.5, 2.5], [3, 4]])
        frame = pycolmap.Frame(frame_id=image_id, rig_id=camera_id)
        frame.add_data_id(image.data_id)
        frame.rig_from_world = pycolmap.Rigid3d(pycolmap.Rotation3d([0, 0, 1, 0]), [1, 2, 3])
        colmap.add_frame(frame)
        image.frame_id = image_id
        colmap.add_image(image)
        colmap.register_frame(image_id)
    track = pycolmap.Track()
    track.add_element(4, 1)
    track.add_element(9, 0)
    colmap.add_point3D([1, 2, 3], track, [255, 0, 51])
    colmap.write_text(tmp_path)
    model = read_colmap(tmp_path)
    assert model.names == ("4.png", "9.png")
    assert isinstance(model.cameras.distortion, BrownConrady)
    torch.testing.assert_close(
        model.cameras.distortion.parameters(), torch.tensor([[0.1, 0.2, 0.3, 0.4, 0], [0] * 5], dtype=F64)
    )
    assert model.cameras.K[0].tolist() == [[500, 0, 319.5], [0, 510, 239.5], [0, 0, 1]]
    assert model.x.tolist() == [[2.5, 3.5], [1, 2]]
    assert model.view.tolist() == [0, 1]
    assert model.poses.R[1].diagonal().tolist() == [-1, -1, 1]
    assert model.color.tolist() == [[1, 0, 0.2]]


@pytest.mark.parametrize(
    ("name", "parameters"), [("FOV", [1, 1, 0, 0, 0.5]), ("FULL_OPENCV", [1, 1, 0, 0, 0, 0, 0, 0, 0, 0.1, 0, 0])]
)
def test_cameras_without_equal_are_named(name, parameters, tmp_path, pycolmap):
    colmap = pycolmap.Reconstruction()
    camera = pycolmap.Camera(camera_id=3, model=name, width=64, height=48, params=parameters)
    colmap.add_camera(camera)
    rig = pycolmap.Rig(rig_id=3)
    rig.add_ref_sensor(camera.sensor_id)
    colmap.add_rig(rig)
    colmap.write_binary(tmp_path)
    with pytest.raises(ValueError, match=f"camera 3 .*{name}"):
        read_colmap(tmp_path)


@pytest.mark.parametrize(
    ("special", "general"),
    [(NoDistortion, SimpleRadial), (SimpleRadial, Radial), (Radial, BrownConrady), (KannalaBrandt, KannalaBrandt)],
)
def test_fisheye_does_not_mix_and_others_do(special, general, tmp_path, generator, pycolmap):
    colmap = pycolmap.Reconstruction()
    named = {
        NoDistortion: ("PINHOLE", [500, 500, 320, 240]),
        SimpleRadial: ("SIMPLE_RADIAL", [500, 320, 240, 0.1]),
        Radial: ("RADIAL", [500, 320, 240, 0.1, 0.2]),
        BrownConrady: ("OPENCV", [500, 500, 320, 240, 0.1, 0.2, 0.3, 0.4]),
        KannalaBrandt: ("RADIAL_FISHEYE", [500, 320, 240, 0.1, 0.2]),
    }
    for i, kind in enumerate((special, general), start=1):
        name, parameters = named[kind]
        camera = pycolmap.Camera(camera_id=i, model=name, width=640, height=480, params=parameters)
        colmap.add_camera(camera)
        rig = pycolmap.Rig(rig_id=i)
        rig.add_ref_sensor(camera.sensor_id)
        colmap.add_rig(rig)
    colmap.write_binary(tmp_path)
    model = read_colmap(tmp_path)
    assert isinstance(model.cameras.distortion, general)
    camera = pycolmap.Camera(
        camera_id=9, model="OPENCV_FISHEYE", width=640, height=480, params=[500, 500, 320, 240, 0, 0, 0, 0]
    )
    if special is KannalaBrandt:
        camera = pycolmap.Camera(camera_id=9, model="SIMPLE_PINHOLE", width=640, height=480, params=[500, 320, 240])
    colmap.add_camera(camera)
    rig = pycolmap.Rig(rig_id=9)
    rig.add_ref_sensor(camera.sensor_id)
    colmap.add_rig(rig)
    colmap.write_binary(tmp_path)
    with pytest.raises(ValueError, match=r"mixes .*KannalaBrandt"):
        read_colmap(tmp_path)


def test_bad_folders(tmp_path, generator):
    with pytest.raises(FileNotFoundError, match="not a folder"):
        read_colmap(tmp_path / "none")
    with pytest.raises(ValueError, match="does not hold a COLMAP model"):
        read_colmap(tmp_path)
    write_colmap(make(generator=generator), tmp_path)
    (tmp_path / "unregistered.txt").write_text("4 x\n")
    with pytest.raises(ValueError, match="line 1: wanted"):
        read_colmap(tmp_path)
    (tmp_path / "unregistered.txt").write_text("4 77 name\n")
    with pytest.raises(ValueError, match="no camera 77"):
        read_colmap(tmp_path)


def test_pycolmap_is_not_needed(tmp_path, generator, monkeypatch):
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    model = make(generator=generator)
    write_colmap(model, tmp_path)
    assert_same(read_colmap(tmp_path), model)
