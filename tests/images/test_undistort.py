"""Pictures without distortion: what they show, where, and the same as OpenCV makes of them."""

import pytest
import torch
from chance import seeded

from torchsfm.geometry import DISTORTION_MODELS, BrownConrady, Camera, NoDistortion, Radial, intrinsics
from torchsfm.images import undistort_images, undistorted_cameras

F64 = torch.float64
WIDTH, HEIGHT = 160, 120
LENSES = {
    "simple_radial": [-0.2],
    "radial": [0.15, -0.03],
    "opencv": [-0.25, 0.06, 0.004, -0.003, -0.01],
    "fisheye": [-0.03, 0.01, 0.0, 0.0],
}


def camera(model: str, *, f: float = 130.0, c: tuple[float, float] = (84.0, 55.0)) -> Camera:
    kind = DISTORTION_MODELS[model]
    numbers = torch.tensor(LENSES.get(model, []), dtype=F64)
    return Camera(intrinsics(torch.tensor(f, dtype=F64), torch.tensor(c, dtype=F64), aspect=1.1), kind.from_parameters(numbers))


def size(width: int = WIDTH, height: int = HEIGHT) -> torch.Tensor:
    return torch.tensor([width, height])


def picture(x: torch.Tensor) -> torch.Tensor:
    """A smooth function of the place in space, as two channels."""
    return torch.stack([0.5 + 0.4 * torch.sin(9 * x[..., 0] + 2), 0.5 + 0.4 * torch.cos(7 * x[..., 1] - 5 * x[..., 0])])


def pixels(width: int, height: int) -> torch.Tensor:
    return torch.stack(torch.meshgrid(torch.arange(width), torch.arange(height), indexing="xy"), -1).to(F64)


def photograph(camera: Camera, width: int = WIDTH, height: int = HEIGHT) -> torch.Tensor:
    """What a camera sees of the plane z = 1."""
    d, _ = camera.unproject(pixels(width, height).reshape(-1, 2))
    return picture(d[..., :2]).reshape(2, height, width)


@pytest.mark.parametrize("centred", [False, True])
@pytest.mark.parametrize("alpha", [0.0, 0.4, 1.0])
@pytest.mark.parametrize("model", LENSES)
def test_the_new_picture_is_that_of_the_pinhole(model: str, alpha: float, centred: bool) -> None:
    lens = camera(model)
    pinhole, target = undistorted_cameras(lens, size(), alpha=alpha, centred=centred)
    width, height = target.tolist()
    assert isinstance(pinhole.distortion, NoDistortion)
    torch.testing.assert_close(pinhole.K.diagonal(), lens.K.diagonal())
    if centred:
        assert pinhole.K[:2, 2].tolist() == [(width - 1) / 2, (height - 1) / 2]
    found = undistort_images(photograph(lens), lens, pinhole, (width, height))
    wanted = photograph(pinhole, width, height)
    d, _ = pinhole.unproject(pixels(width, height).reshape(-1, 2))
    x = lens.project(d).reshape(height, width, 2)
    inside = ((x >= 0) & (x <= torch.tensor([WIDTH - 1, HEIGHT - 1]))).all(-1)
    outside = ((x < -0.5) | (x > torch.tensor([WIDTH - 0.5, HEIGHT - 0.5]))).any(-1)
    # Bilinear interpolation of a function with second derivatives below 0.4 * 130 / 130^2 ... a few thousandths.
    torch.testing.assert_close(found[:, inside], wanted[:, inside], rtol=0, atol=4e-3)
    assert not bool(found[:, outside].any())
    if alpha == 0:
        assert bool((x > -0.01).all())
        assert bool((x < torch.tensor([WIDTH, HEIGHT]) - 0.99).all())


@pytest.mark.parametrize("centred", [False, True])
@pytest.mark.parametrize("model", LENSES)
def test_crop_is_the_largest_and_alpha_1_keeps_all(model: str, centred: bool) -> None:
    lens = camera(model)
    border = torch.tensor([[x, y] for x in range(WIDTH) for y in range(HEIGHT) if x in (0, WIDTH - 1) or y in (0, HEIGHT - 1)])
    d, valid = lens.unproject(border.to(F64))
    assert bool(valid.all())
    pinhole, target = undistorted_cameras(lens, size(), alpha=1.0, centred=centred)
    x = pinhole.project(d)
    assert bool(((x > -1) & (x < target)).all())
    pinhole, target = undistorted_cameras(lens, size(), centred=centred)
    x = pinhole.project(d)
    # The border of the old picture comes within a pixel of the frame: no larger one would be full.
    gaps = [x[border[:, 0] == 0, 0].abs(), (x[border[:, 0] == WIDTH - 1, 0] - target[0] + 1).abs()]
    gaps += [x[border[:, 1] == 0, 1].abs(), (x[border[:, 1] == HEIGHT - 1, 1] - target[1] + 1).abs()]
    nearest = [float(gap.min()) for gap in gaps]
    assert min(nearest[:2]) <= 1.01
    assert min(nearest[2:]) <= 1.01
    assert centred or max(nearest) <= 1.01


def test_a_pinhole_keeps_its_picture() -> None:
    lens = camera("pinhole")
    pinhole, target = undistorted_cameras(lens, size())
    assert target.tolist() == [WIDTH, HEIGHT]
    torch.testing.assert_close(pinhole.K, lens.K, rtol=1e-13, atol=1e-13)
    image = torch.rand(3, HEIGHT, WIDTH, generator=seeded(), dtype=F64)
    torch.testing.assert_close(undistort_images(image, lens, pinhole, (WIDTH, HEIGHT)), image, rtol=0, atol=1e-9)


def test_batches_are_what_each_picture_is_alone() -> None:
    lenses = [camera("radial", f=f) for f in (120.0, 150.0)]
    both = Camera(
        torch.stack([lens.K for lens in lenses]),
        Radial(*torch.stack([lens.distortion.parameters() for lens in lenses]).unbind(-1)),
    )
    pinholes, sizes = undistorted_cameras(both, size().expand(2, 2))
    images = torch.rand(3, 2, 1, HEIGHT, WIDTH, generator=seeded(), dtype=torch.float32)
    together = undistort_images(images, both, pinholes, (100, 90))
    for i, lens in enumerate(lenses):
        alone, alone_size = undistorted_cameras(lens, size())
        assert alone_size.equal(sizes[i])
        torch.testing.assert_close(alone.K, pinholes.K[i], rtol=1e-14, atol=1e-12)
        torch.testing.assert_close(together[:, i], undistort_images(images[:, i], lens, alone, (100, 90)))
    empty = undistort_images(images[:0], both, pinholes, (100, 90))
    assert empty.shape == (0, 2, 1, 90, 100)


def test_lenses_that_are_none_give_a_picture_all_the_same() -> None:
    folded = Camera(camera("pinhole").K, Radial(torch.tensor(-9.0, dtype=F64), torch.tensor(0.0, dtype=F64)))
    absent = Camera(torch.full((3, 3), torch.nan, dtype=F64))
    for lens in (folded, absent):
        for alpha in (0.0, 1.0):
            pinhole, target = undistorted_cameras(lens, size(), alpha=alpha)
            assert bool((target >= 1).all())
            assert bool((target <= 2 * size()).all())
            found = undistort_images(torch.ones(1, HEIGHT, WIDTH), lens, pinhole, tuple(target.tolist()))
            assert bool(((found >= 0) & (found <= 1)).all())


@pytest.mark.usefixtures("unchecked")
def test_wrong_arguments_are_named() -> None:
    lens = camera("radial")
    with pytest.raises(ValueError, match=r"size: wanted shape \(2,\), one for each camera"):
        undistorted_cameras(lens, size().expand(2, 2))
    with pytest.raises(ValueError, match="alpha: wanted"):
        undistorted_cameras(lens, size(), alpha=2.0)
    with pytest.raises(ValueError, match="size: wanted"):
        undistort_images(torch.ones(1, 4, 4), lens, lens, (0, 3))
    with pytest.raises(ValueError, match="images: wanted"):
        undistort_images(torch.ones(2, 0, 4, 4), Camera(lens.K.expand(2, 3, 3)), lens, (4, 3))
    with pytest.raises(ValueError, match="cameras: wanted batch"):
        undistort_images(torch.ones(1, 4, 4), Camera(lens.K.expand(2, 3, 3)), lens, (4, 3))


@pytest.mark.reference
@pytest.mark.parametrize("model", ["opencv", "fisheye"])
def test_the_same_as_opencv_within_one_grey_level(model: str) -> None:
    cv2 = pytest.importorskip("cv2")
    lens = camera(model)
    image = (255 * photograph(lens)[0]).round()
    pinhole, target = undistorted_cameras(lens, size(), alpha=0.5)
    width, height = target.tolist()
    mine = undistort_images(image[None] / 255, lens, pinhole, (width, height))[0]
    K, K2, numbers = lens.K.numpy(), pinhole.K.numpy(), lens.distortion.parameters().numpy()
    build = cv2.initUndistortRectifyMap if isinstance(lens.distortion, BrownConrady) else cv2.fisheye.initUndistortRectifyMap
    maps = build(K, numbers, torch.eye(3, dtype=F64).numpy(), K2, (width, height), cv2.CV_32FC1)
    theirs = torch.from_numpy(cv2.remap(image.to(torch.uint8).numpy(), *maps, cv2.INTER_LINEAR))
    x = torch.stack([torch.from_numpy(m) for m in maps], -1)
    inside = ((x > 0.01) & (x < torch.tensor([WIDTH, HEIGHT]) - 1.01)).all(-1)
    assert int(inside.sum()) > 0.7 * WIDTH * HEIGHT
    assert int(((255 * mine).round() - theirs.double()).abs()[inside].max()) <= 1
