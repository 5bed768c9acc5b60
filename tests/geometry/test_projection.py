"""Projection and its written derivatives against automatic differentiation."""

import pytest
import torch
from torch import Tensor
from torch.func import jacrev, vmap

from torchsfm.geometry import DISTORTION_MODELS, Camera, Distortion, Pose
from torchsfm.geometry.intrinsic_parameters import (
    HEAD,
    INTRINSICS,
    camera_from_row,
    intrinsic_columns,
    intrinsic_labels,
    intrinsics_from_relative,
    intrinsics_slopes,
    move_intrinsics,
    relative_from_intrinsics,
    row_from_camera,
)
from torchsfm.geometry.projection import PixelProjection, camera_slopes, point_slopes, quotient_slope, turn_slopes
from torchsfm.geometry.radial import flatten

F64 = torch.float64


def make_rays(generator: torch.Generator, *shape: int, dtype: torch.dtype = F64) -> Tensor:
    """Points in the camera's frame, up to 45 degrees off the axis; the first on it."""
    across = 2 * torch.rand((2, *shape), generator=generator, dtype=F64) - 1
    across.flatten(1)[:, 0] = 0
    depth = 0.5 + 5 * torch.rand(shape, generator=generator, dtype=F64)
    return torch.cat((across * depth / 1.5, depth[None])).to(dtype)


def make_rows(generator: torch.Generator, model: type[Distortion], *shape: int, dtype: torch.dtype = F64) -> Tensor:
    """Cameras with skew, an aspect and some distortion."""
    p = model.num_parameters
    head = torch.tensor([700.0, 1.0, 0.0, 320.0, 240.0], dtype=F64)
    width = torch.tensor([50.0, 0.1, 5.0, 20.0, 20.0, *(0.03 / (i + 1) for i in range(p))], dtype=F64)
    start = torch.cat((head, torch.zeros(p, dtype=F64)))
    rows = start + width * torch.randn((*shape, HEAD + p), generator=generator, dtype=F64)
    return rows.movedim(-1, 0).to(dtype)


@pytest.mark.parametrize("dtype", [torch.float32, F64])
@pytest.mark.parametrize("name", DISTORTION_MODELS)
def test_lens_derivatives(name: str, dtype: torch.dtype, generator: torch.Generator) -> None:
    """By rays and by parameters, along rows of any shape that parameters broadcast against."""
    model = DISTORTION_MODELS[name]
    ray, k = make_rays(generator, 4, 50, dtype=dtype), make_rows(generator, model, 4, 1, dtype=dtype)[HEAD:]
    out = torch.full((2, 3, 4, 50), torch.nan, dtype=dtype)
    uv, by_parameter = model.linearize(ray, k, out)

    def image(ray: Tensor, k: Tensor) -> Tensor:
        return torch.stack(model.project_rows(*ray.unbind(0), *k.unbind(0)))

    wide = k.expand(-1, 4, 50)
    axes = {"in_dims": (-1, -1), "out_dims": -1}
    by_ray, by_k = vmap(vmap(jacrev(image, (0, 1)), **axes), **axes)(ray.double(), wide.double())
    limits = {"rtol": 1e-5, "atol": 1e-5} if dtype == torch.float32 else {"rtol": 1e-11, "atol": 1e-12}
    torch.testing.assert_close(uv.double(), image(ray.double(), wide.double()), **limits)
    torch.testing.assert_close(model.image(ray, k), uv, **limits)
    torch.testing.assert_close(out.double(), by_ray, **limits)
    assert len(by_parameter) == model.num_parameters
    for i, by in enumerate(by_parameter):
        torch.testing.assert_close(by.double(), by_k[:, i], **limits)


@pytest.mark.parametrize("relative", [False, True])
@pytest.mark.parametrize("name", DISTORTION_MODELS)
def test_pixel_derivatives(name: str, relative: bool, generator: torch.Generator) -> None:
    """By rays, turns and every number of the camera's row; what is not asked for changes nothing."""
    model = DISTORTION_MODELS[name]
    ray, row = make_rays(generator, 40), make_rows(generator, model, 40)
    free = tuple(torch.randperm(len(row), generator=generator).tolist())
    projection = PixelProjection(model, free, relative=relative)

    def pixels(delta: Tensor, ray: Tensor, row: Tensor) -> Tensor:
        turn, step = delta[:6], delta[6:]
        moved = ray + torch.linalg.cross(turn[:3], ray) + turn[3:]
        head, lens = row[:HEAD], row[HEAD:] + step[HEAD:]
        if relative:
            f = head[0] * step[0].exp()
            scales = (f, head[1] * step[1].exp(), (head[2] / head[0] + step[2]) * f)
            head = torch.cat((torch.stack(scales), head[3:] + step[3:HEAD]))
        else:
            head = head + step[:HEAD]
        K = torch.stack((head[0], head[2], head[3], 0 * f0(head), head[0] * head[1], head[4]))
        camera = Camera(torch.cat((K, torch.tensor([0.0, 0, 1], dtype=F64))).reshape(3, 3), model.from_parameters(lens))
        return camera.project(moved[None])[0]

    def f0(head: Tensor) -> Tensor:
        return head[0].detach()

    delta = torch.zeros(6 + len(row), dtype=F64)
    wanted = vmap(jacrev(pixels), in_dims=(None, -1, -1), out_dims=-1)(delta, ray, row)
    out = torch.full((2, 6 + len(row), 40), torch.nan, dtype=F64)
    found = projection.linearize(ray, row, out[:, 3:6], out[:, 6:])
    turn_slopes(ray, out[:, 3:6], out)
    value = vmap(pixels, in_dims=(None, -1, -1), out_dims=-1)(delta, ray, row)
    torch.testing.assert_close(found, value, rtol=1e-12, atol=1e-9)
    torch.testing.assert_close(projection.pixels(ray, row), value, rtol=1e-12, atol=1e-9)
    order = [0, 1, 2, 3, 4, 5, *(6 + column for column in free)]
    torch.testing.assert_close(out, wanted[:, order], rtol=1e-9, atol=1e-8)
    alone = torch.empty(2, 3, 40, dtype=F64)
    assert torch.equal(projection.linearize(ray, row, alone), found)
    assert torch.equal(alone, out[:, 3:6])


@pytest.mark.parametrize("name", DISTORTION_MODELS)
def test_every_finite_ray_has_finite_slopes(name: str, generator: torch.Generator) -> None:
    """In the focal plane, at the centre, behind, very near and very far."""
    model = DISTORTION_MODELS[name]
    number = torch.tensor([0.0, -0.0, 1.0, -1.0, 1e-12, -1e12, 1e-90], dtype=F64)
    ray = torch.cartesian_prod(number, number, number).mT
    row = make_rows(generator, model, ray.shape[1])
    out = torch.full((2, 3 + len(row), ray.shape[1]), torch.nan, dtype=F64)
    projection = PixelProjection(model, tuple(range(len(row))))
    assert projection.linearize(ray, row, out[:, :3], out[:, 3:]).isfinite().all()
    assert projection.pixels(ray, row).isfinite().all()
    assert out.isfinite().all()


@pytest.mark.parametrize("name", DISTORTION_MODELS)
def test_one_projection_for_cameras_and_rows(name: str, generator: torch.Generator) -> None:
    model = DISTORTION_MODELS[name]
    ray, row = make_rays(generator, 3, 20), make_rows(generator, model, 3, 1)
    K = torch.zeros(3, 3, 3, dtype=F64)
    f, aspect, skew, cx, cy = row[:HEAD, :, 0]
    K[:, 0, 0], K[:, 1, 1], K[:, 0, 1], K[:, 0, 2], K[:, 1, 2], K[:, 2, 2] = f, f * aspect, skew, cx, cy, 1
    camera = Camera(K, model.from_parameters(row[HEAD:, :, 0].mT))
    torch.testing.assert_close(row_from_camera(camera).mT, row[:, :, 0], rtol=1e-14, atol=0)
    pixels = PixelProjection(model).pixels(ray, row)
    torch.testing.assert_close(pixels.movedim(0, -1), camera.project(ray.movedim(0, -1)), rtol=1e-12, atol=1e-9)


@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_camera_and_point_derivatives(dtype: torch.dtype, generator: torch.Generator) -> None:
    """Of homogeneous points in cameras 3x4, by both; the two forms agree where the camera is a pose."""
    P = torch.randn((3, 4, 6, 1), generator=generator, dtype=dtype)
    X = torch.randn((4, 6, 30), generator=generator, dtype=dtype)

    def image(P: Tensor, X: Tensor) -> Tensor:
        y = P @ X
        return y[:2] / y[2]

    wide = P.expand(-1, -1, 6, 30)
    axes = {"in_dims": (-1, -1), "out_dims": -1}
    by_camera, by_point = vmap(vmap(jacrev(image, (0, 1)), **axes), **axes)(wide.double(), X.double())
    y = torch.einsum("ij...,j...->i...", wide, X)
    uv, inverse = flatten(y)
    limit = 1e-3 if dtype == torch.float32 else 1e-10
    for found, wanted in ((camera_slopes(X, uv, inverse), by_camera), (point_slopes(P, uv, inverse), by_point)):
        size = wanted.flatten(0, -3).abs().amax(0)
        assert ((found.double() - wanted).flatten(0, -3).abs().amax(0) / size <= limit * (1 + inverse.abs())).all()


def test_forms_agree(generator: torch.Generator) -> None:
    """A pinhole's derivative by the point is the same through P, and through pose and pixels."""
    model = DISTORTION_MODELS["pinhole"]
    row = make_rows(generator, model, 1)
    pose = Pose.identity(dtype=F64).retract(0.3 * torch.randn(6, generator=generator, dtype=F64))
    ray = make_rays(generator, 30)
    by_ray = torch.empty(2, 3, 30, dtype=F64)
    pixels = PixelProjection(model).linearize(ray, row, by_ray)
    f, aspect, skew, cx, cy = row[:, 0]
    K = torch.tensor([[f, skew, cx], [0, f * aspect, cy], [0, 0, 1]], dtype=F64)
    P = (K @ pose.R)[:, :, None]
    through_P = point_slopes(P, pixels, 1 / ray[2])
    torch.testing.assert_close(torch.einsum("cin,ij->cjn", by_ray, pose.R), through_P, rtol=1e-10, atol=1e-9)


def test_quotient_has_no_layout(generator: torch.Generator) -> None:
    """Coordinates may stand anywhere: the law is elementwise."""
    P = torch.randn((5, 3, 4), generator=generator, dtype=F64)
    X = torch.randn((5, 4), generator=generator, dtype=F64)
    y = (P @ X[..., None])[..., 0]
    last = quotient_slope(P[:, :2], P[:, 2:], (y[:, :2] / y[:, 2:])[..., None], 1 / y[:, 2, None, None])
    uv, inverse = flatten(y.mT)
    assert torch.allclose(last.movedim(0, -1), point_slopes(P.movedim(0, -1), uv, inverse), rtol=1e-12, atol=0)


@pytest.mark.parametrize("name", INTRINSICS)
def test_units_of_steps(name: str, generator: torch.Generator) -> None:
    """A relative step of one number moves K as the table says of its unit, and adds up with the next."""
    width = torch.tensor([0.3, 0.1, 0.02, 9.0, 9.0], dtype=F64)
    theta = width * torch.randn(4, HEAD, generator=generator, dtype=F64)
    theta[:, 0] += 6
    K = intrinsics_from_relative(theta)
    torch.testing.assert_close(relative_from_intrinsics(K), theta, rtol=1e-12, atol=1e-12)
    intrinsic = INTRINSICS[name]
    assert intrinsic_columns((name,)) == intrinsic.columns
    assert tuple(intrinsic_labels()[column] for column in intrinsic.columns) == intrinsic.labels
    camera = Camera(K)
    row = row_from_camera(camera)
    torch.testing.assert_close(camera_from_row(row, type(camera.distortion)).K, K, rtol=1e-14, atol=0)
    a, b = (0.1 * torch.randn(2, 4, generator=generator, dtype=F64)).unbind(0)
    for column in intrinsic.columns:
        twice = move_intrinsics(move_intrinsics(K, {column: a}), {column: b})
        torch.testing.assert_close(twice, move_intrinsics(K, {column: a + b}), rtol=1e-13, atol=1e-12)
        moved = row_from_camera(Camera(move_intrinsics(K, {column: a})))
        factor = {"logarithm": a.exp(), "focal lengths": 1.0, "pixels": 1.0}[intrinsic.relative]
        shift = {"logarithm": 0.0, "focal lengths": a * row[:, 0], "pixels": a}[intrinsic.relative]
        torch.testing.assert_close(moved[:, column], row[:, column] * factor + shift, rtol=1e-12, atol=1e-12)
        # Of the other numbers only a skew in focal lengths follows the focal length.
        rest = [i for i in range(HEAD) if i != column and not (column == 0 and i == 2)]
        torch.testing.assert_close(moved[:, rest], row[:, rest], rtol=1e-14, atol=0)
        slope = jacrev(lambda step, column=column: move_intrinsics(K[0], {column: step}))(torch.zeros((), dtype=F64))
        torch.testing.assert_close(intrinsics_slopes(K)[0, column], slope, rtol=1e-14, atol=0)
