"""Models in metres by GPS, upright and on the ground, and bent to control points."""

import math
import struct
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from command_line import assert_one_line, torchsfm
from test_align import control, make

from torchsfm.geometry import Camera, Pose, Similarity, geodetic_from_enu, random_rotation, rotation_from_rotvec
from torchsfm.images import parse_exif
from torchsfm.reconstruction import Reconstruction
from torchsfm.reconstruction.model.alignment import align_to_points, align_to_positions
from torchsfm.reconstruction.model.control import adjust_to_points
from torchsfm.reconstruction.model.gps import align_to_gps
from torchsfm.reconstruction.model.upright import align_to_ground, align_upright
from torchsfm.simulation import look_at

F64 = torch.float64
LUND = torch.tensor([55.7041, 13.1914, 52.0], dtype=F64)


def ring(v: int, generator: torch.Generator, *, squeeze: float = 1.0) -> Reconstruction:
    """Cameras around a scene, at heights of their own."""
    centre = torch.randn(v, 3, generator=generator, dtype=F64) * torch.tensor([1.0, squeeze, squeeze], dtype=F64)
    return make(centre + torch.tensor([0.0, -6.0, 1.0], dtype=F64))


def frame(generator: torch.Generator, scale: float = 20.0) -> Similarity:
    R = random_rotation(1, generator=generator, dtype=F64)[0]
    return Similarity(torch.tensor(scale, dtype=F64), R, torch.randn(3, generator=generator, dtype=F64))


def noise(like: torch.Tensor, size: float, generator: torch.Generator) -> torch.Tensor:
    return like + size * torch.randn(like.shape, generator=generator, dtype=F64)


@pytest.mark.parametrize("v", [3, 6, 7, 30])
def test_positions_with_noise_and_wrong_ones(v: int, generator: torch.Generator) -> None:
    model, s = ring(v, generator), frame(generator)
    exact = s.transform(model.poses.centre)
    found = align_to_positions(model, model.names, exact, generator=generator)
    torch.testing.assert_close(found.similarity.matrix(), s.matrix(), rtol=0, atol=1e-6)
    wrong = {3: 0, 6: 1, 7: 2, 30: 11}[v]
    measured = noise(exact, 0.05, generator)
    measured[:wrong] += 300 * torch.randn(wrong, 3, generator=generator, dtype=F64)
    found = align_to_positions(model, model.names, measured, generator=generator)
    assert not bool(found.used[:wrong].any())
    if v > 3:
        away = (found.similarity.transform(model.poses.centre) - exact).norm(dim=-1)
        assert float(away.max()) < 1.0
    assert found.known is not None
    # Strangers and unknown positions are passed over.
    names = (*model.names, "stranger")
    more = torch.cat((measured, torch.zeros(1, 3, dtype=F64)))
    again = align_to_positions(model, names, more)
    assert again.names == model.names


def test_certainty_is_what_trials_show(generator: torch.Generator) -> None:
    """The standard deviations of scale and turn are those of many trials."""
    model, s = ring(12, generator), frame(generator)
    exact = s.transform(model.poses.centre)
    scales, turns, said = [], [], []
    for _ in range(200):
        found = align_to_positions(model, model.names, noise(exact, 0.5, generator))
        assert found.known is not None
        scales.append(float(found.similarity.scale) / 20 - 1)
        turns.append(float((found.similarity.R @ s.R.mT - torch.eye(3, dtype=F64)).norm() / math.sqrt(2)))
        said.append([found.known.scale, found.known.turn, found.known.sigma])
    scale, turn, sigma = torch.tensor(said).mean(0).tolist()
    assert 0.8 < float(torch.tensor(scales).square().mean().sqrt()) / scale < 1.25
    assert 0.8 < sigma / 0.5 < 1.25
    # The angle has three parts, none larger than that of the worst axis.
    assert turn < float(torch.tensor(turns).square().mean().sqrt()) * 1.25
    assert float(torch.tensor(turns).square().mean().sqrt()) < 1.25 * math.sqrt(3) * turn


def test_positions_that_do_not_tell(generator: torch.Generator) -> None:
    line, s = ring(12, generator, squeeze=0.0), frame(generator)
    exact = s.transform(line.poses.centre)
    assert "on one line" in align_to_positions(line, line.names, exact).fault()
    assert "on one line" in align_to_positions(line, line.names, noise(exact, 0.5, generator)).fault()
    model = ring(12, generator)
    still = torch.zeros(12, 3, dtype=F64)
    assert align_to_positions(model, model.names, still).fault()
    assert "contradict" in align_to_positions(model, model.names, noise(still, 5.0, generator)).fault()
    assert "too few" in align_to_positions(model, model.names[:2], still[:2]).fault()
    with pytest.raises(ValueError, match="names: wanted 12"):
        align_to_positions(model, model.names[:2], still)


def rational(value: float, parts: int) -> bytes:
    """Degrees, minutes and seconds, or one number."""
    if parts == 1:
        return struct.pack("<2I", round(value * 1000), 1000)
    degrees, minutes = int(value), int(value % 1 * 60)
    seconds = (value - degrees - minutes / 60) * 3600
    return struct.pack("<6I", degrees, 1, minutes, 1, round(seconds * 1e6), 1000000)


def with_position(latitude: float, longitude: float, height: float | None) -> bytes:
    """The start of a JPEG that says where it was taken."""
    start = 8 + 18  # the first directory has one entry
    rows = [
        (1, 2, 2, (b"N" if latitude >= 0 else b"S") + b"\0\0\0"),
        (2, 5, 3, rational(abs(latitude), 3)),
        (3, 2, 2, (b"E" if longitude >= 0 else b"W") + b"\0\0\0"),
        (4, 5, 3, rational(abs(longitude), 3)),
    ]
    if height is not None:
        rows += [(5, 1, 1, bytes([height < 0]) + b"\0\0\0"), (6, 5, 1, rational(abs(height), 1))]
    body, extra, place = struct.pack("<H", len(rows)), b"", start + 2 + 12 * len(rows) + 4
    for tag, kind, count, raw in rows:
        body += struct.pack("<HHI", tag, kind, count)
        body += raw if len(raw) == 4 else struct.pack("<I", place + len(extra))
        extra += b"" if len(raw) == 4 else raw
    first = struct.pack("<HHHII", 1, 0x8825, 4, 1, start) + b"\0\0\0\0"
    block = b"Exif\0\0II*\0" + struct.pack("<I", 8) + first + body + b"\0\0\0\0" + extra
    return b"\xff\xd8\xff\xe1" + struct.pack(">H", len(block) + 2) + block + b"\xff\xd9"


def test_the_tags_of_a_position(generator: torch.Generator) -> None:
    for _ in range(50):
        u = 2 * torch.rand(3, generator=generator, dtype=F64) - 1
        latitude, longitude, height = (u * torch.tensor([90.0, 180.0, 400.0])).tolist()
        exif = parse_exif(with_position(latitude, longitude, height))
        assert (exif.latitude, exif.longitude) == (pytest.approx(latitude, abs=1e-9), pytest.approx(longitude, abs=1e-9))
        assert exif.altitude == pytest.approx(height, abs=1e-3)
    assert parse_exif(with_position(55.0, 13.0, None)).altitude is None
    # XMP beside it counts where it alone has a height.
    xmp = b"<rdf:RDF><a drone-dji:GpsLatitude='1' drone-dji:GpsLongitude='2' drone-dji:AbsoluteAltitude='3'/></rdf:RDF>"
    for height, wanted in ((7.0, (55.0, 13.0, 7.0)), (None, (1.0, 2.0, 3.0))):
        exif = parse_exif(with_position(55.0, 13.0, height) + xmp)
        assert (exif.latitude, exif.longitude, exif.altitude) == wanted
    # A receiver without a position writes zeros.
    assert parse_exif(with_position(0.0, 0.0, 0.0)).latitude is None
    beyond = with_position(89.0, 13.0, 5.0).replace(struct.pack("<2I", 89, 1), struct.pack("<2I", 95, 1))
    assert parse_exif(beyond).latitude is None
    assert parse_exif(beyond).longitude is None


def photographs(folder: Path, model: Reconstruction, metric: torch.Tensor) -> Path:
    """Files that say where they were taken."""
    folder.mkdir(exist_ok=True)
    for name, place in zip(model.names, geodetic_from_enu(metric, LUND).tolist(), strict=True):
        (folder / name).write_bytes(with_position(*place))
    return folder


def test_the_command_by_gps(tmp_path: Path, generator: torch.Generator) -> None:
    model, s = ring(9, generator), frame(generator)
    target = model.transform(s)
    exact = target.poses.centre
    model.save(tmp_path / "model.npz")
    folder = photographs(tmp_path / "images", model, exact)  # found without being named
    status, text, stderr = torchsfm("align", tmp_path / "model.npz", "--gps", "--out", tmp_path / "out.npz")
    assert status == 0, stderr
    assert "9 of 9 positions agree" in text
    assert "in height, scale 20" in text
    moved = Reconstruction.load(tmp_path / "out.npz")
    gaps = torch.pdist(moved.X) / torch.pdist(target.X) - 1
    assert float(gaps.abs().max()) < 1e-3  # heights are in millimetres
    # North is y, up is z: the model is where the earth has it, but for the origin.
    shift = (moved.poses.centre - exact).mean(0)
    torch.testing.assert_close(moved.poses.centre - shift, exact, rtol=0, atol=2e-2)
    found = align_to_gps(model, folder)
    torch.testing.assert_close(geodetic_from_enu(-shift, LUND), found.origin, rtol=0, atol=1e-3)
    for wrong, message in (
        (torch.zeros_like(exact), "at one place"),
        (exact[:1] + torch.arange(9, dtype=F64)[:, None] * torch.ones(3, dtype=F64), "positions"),
    ):
        photographs(folder, model, wrong)
        status, _, stderr = torchsfm("align", tmp_path / "model.npz", "--gps", "--out", tmp_path / "no.npz")
        assert status == 2
        assert_one_line(stderr, message)
    empty = tmp_path / "empty"
    empty.mkdir()
    for words, message in (
        (("--gps", "--images", empty), "0 of 0 photographs"),
        (("--gps", "--up"), "wanted one of"),
        (("--gps", "--bend", 1), "--bend"),
    ):
        status, _, stderr = torchsfm("align", tmp_path / "model.npz", *words, "--out", tmp_path / "no.npz")
        assert status == 2
        assert_one_line(stderr, message)
    assert not (tmp_path / "no.npz").exists()


def street(generator: torch.Generator, v: int = 14) -> Reconstruction:
    """Level cameras around a square: ground, facades and a few wrong points beneath; z points up."""
    angle = torch.linspace(0, 2 * math.pi, v + 1, dtype=F64)[:-1]
    centre = torch.stack((6 * angle.cos(), 6 * angle.sin(), 1.6 + 0.2 * angle.sin()), -1)
    model = make(centre, points=900)
    u = torch.rand(900, 3, generator=generator, dtype=F64)
    ground = torch.stack((8 * u[:, 0] - 4, 8 * u[:, 1] - 4, 0.02 * u[:, 2] - 0.01), -1)
    wall = torch.stack((8 * u[:, 0] - 4, torch.where(u[:, 1] > 0.5, 4.0, -4.0), 6 * u[:, 2]), -1)
    X = torch.cat((ground[:200], wall[200:880], ground[880:] - torch.tensor([0.0, 0.0, 2.0])))
    poses = look_at(centre, torch.tensor([0.0, 0.0, 1.5], dtype=F64))
    # Held by hand: rolled a little.
    roll = 0.03 * torch.randn(v, 1, generator=generator, dtype=F64) * torch.tensor([0.0, 0.0, 1.0], dtype=F64)
    R = rotation_from_rotvec(roll) @ poses.R
    poses = Pose(R, -(R @ centre[..., None])[..., 0])
    return replace(model, X=X, poses=poses)


def test_up_and_ground(generator: torch.Generator, tmp_path: Path) -> None:
    model, s = street(generator), frame(generator, 0.3)
    turned = model.transform(s)
    for align in (align_upright, align_to_ground):
        found = align(turned)
        assert not found.fault()
        up = found.similarity.R @ s.R @ torch.tensor([0.0, 0.0, 1.0], dtype=F64)
        limit = 4 * found.sigma if align is align_upright else math.radians(0.3)
        assert math.acos(min(1.0, float(up[2]))) < max(limit, 1e-6)
        assert float(found.similarity.scale) == 1
    assert found.ground is not None
    assert bool(found.ground[:200].all())
    assert not bool(found.ground[880:].any())
    level = turned.transform(found.similarity)
    assert float(level.X[:200, 2].abs().max()) < 0.3 * 0.05
    torch.testing.assert_close(level.poses.centre.mean(0)[:2], torch.zeros(2, dtype=F64), rtol=0, atol=1e-9)
    # Two cameras turned on their side change nothing but by what they no longer say.
    quarter = rotation_from_rotvec(torch.tensor([0.0, 0.0, math.pi / 2], dtype=F64))
    R = turned.poses.R.clone()
    R[:2] = quarter @ R[:2]
    sideways = align_upright(replace(turned, poses=Pose(R, turned.poses.t)))
    assert sideways.held.tolist() == [False] * 2 + [True] * 12
    turned.save(tmp_path / "model.npz")
    for option in ("--up", "--ground"):
        status, text, stderr = torchsfm("align", tmp_path / "model.npz", option, "--out", tmp_path / "out.npz")
        assert status == 0, stderr
        assert "z points up" in text
    moved = Reconstruction.load(tmp_path / "out.npz")
    assert float(moved.X[:200, 2].abs().max()) < 0.3 * 0.05


def test_what_does_not_tell_up(generator: torch.Generator, tmp_path: Path) -> None:
    model = street(generator)
    same = replace(model, poses=Pose(model.poses.R[:1].expand_as(model.poses.R), model.poses.t))
    assert "same way" in align_upright(same).fault()
    assert "same way" in align_to_ground(same).fault()
    any_way = random_rotation(len(model.names), generator=generator, dtype=F64)
    assert align_upright(replace(model, poses=Pose(any_way, model.poses.t))).fault()
    one = replace(model, registered=torch.arange(len(model.names)) == 0)
    assert "1 registered" in align_upright(one).fault()
    scattered = replace(model, X=noise(torch.zeros_like(model.X), 3.0, generator))
    assert "no level plane" in align_to_ground(scattered).fault()
    same.save(tmp_path / "model.npz")
    status, _, stderr = torchsfm("align", tmp_path / "model.npz", "--up", "--out", tmp_path / "no.npz")
    assert status == 2
    assert_one_line(stderr, "same way")
    assert not (tmp_path / "no.npz").exists()


def bent(generator: torch.Generator) -> tuple[Reconstruction, Reconstruction]:
    """A true model, and one of the same photographs with a wrong focal length, to which everything else was fitted."""
    from torchsfm.bundle import bundle_adjust_model

    centre = torch.randn(8, 3, generator=generator, dtype=F64) + torch.tensor([0.0, -6.0, 1.0], dtype=F64)
    truth = make(centre, points=60)
    truth = replace(truth, x=noise(truth.x, 0.05, generator))
    K = truth.cameras.K.clone()
    K[..., :2, :2] *= 1.03
    wrong = replace(truth, cameras=Camera(K, truth.cameras.distortion))
    return truth, bundle_adjust_model(wrong, free=()).model


def test_a_model_bends_to_control_points(generator: torch.Generator, tmp_path: Path) -> None:
    truth, model = bent(generator)
    s = frame(generator)
    target = truth.transform(s)
    known = control(truth, target.X, 8)
    stiff = align_to_points(model, known)
    found = adjust_to_points(model, known, sigma=0.01, image_sigma=0.05)
    assert not found.fault()
    assert found.model.num_points == model.num_points + 8
    rest = slice(8, model.num_points)
    before = (model.transform(stiff.similarity).X - target.X)[rest].norm(dim=-1).median()
    after = (found.model.X[: model.num_points] - target.X)[rest].norm(dim=-1).median()
    assert float(after) < 0.5 * float(before)
    assert abs(float(found.model.cameras.K[0, 0, 0]) / 900 - 1) < 0.01
    # What the covariance says of the other points is how far off they are.
    X = found.covariance().X[rest]
    apart = (found.model.X[: model.num_points] - target.X)[rest]
    whitened = (torch.linalg.solve(X, apart[..., None])[..., 0] * apart).sum(-1).mean() / 3
    assert 0.2 < float(whitened) < 5
    model.save(tmp_path / "model.npz")
    lines = [
        " ".join(map(str, [known.names[k], *known.X[k].tolist(), image, x, y]))
        for image, (x, y), k in zip(known.images, known.x.tolist(), known.point.tolist(), strict=True)
    ]
    (tmp_path / "points.txt").write_text("\n".join(lines))
    command = ("align", tmp_path / "model.npz", "--points", tmp_path / "points.txt", "--bend", 0.01, "--out")
    status, text, stderr = torchsfm(*command, tmp_path / "out.npz")
    assert status == 0, stderr
    assert "8 control points" in text
    assert Reconstruction.load(tmp_path / "out.npz").num_points == model.num_points + 8
    # One of them mistaken for another place.
    shifted = known.X.clone()
    shifted[3] += torch.tensor([5.0, 0.0, 0.0])
    wrong = adjust_to_points(model, replace(known, X=shifted), sigma=0.01, image_sigma=0.05)
    assert "control point p3 contradicts" in wrong.fault()
    (tmp_path / "points.txt").write_text("\n".join(lines).replace(str(known.X[3, 0].item()), str(shifted[3, 0].item())))
    status, _, stderr = torchsfm(*command, tmp_path / "no.npz")
    assert status == 2
    assert_one_line(stderr.strip().splitlines()[-1], "p3 contradicts")
    assert not (tmp_path / "no.npz").exists()


def test_control_points_that_do_not_tell(generator: torch.Generator) -> None:
    truth, model = bent(generator)
    few = adjust_to_points(model, control(truth, truth.X, 2))
    assert "too few" in few.fault()
    with pytest.raises(ValueError, match="adjusted model"):
        few.covariance()
    for bad in (0.0, -1.0, torch.ones(3, dtype=F64)):
        with pytest.raises(ValueError, match="sigma"):
            adjust_to_points(model, control(truth, truth.X, 5), sigma=bad)
