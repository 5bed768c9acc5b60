"""All of geometry under torch.func.vmap gives what a loop gives, and forward derivatives agree with backward ones."""

import pytest
import torch

from torchsfm.geometry import (
    DISTORTION_MODELS,
    Camera,
    Pose,
    camera_centre,
    cross_matrix,
    epipolar_distance,
    from_homogeneous,
    krt_from_camera,
    normalize_sphere,
    normalizing_similarity,
    point_depths,
    project_points,
    quaternion_wxyz_from_rotation,
    random_rotation,
    reprojection_distance,
    rotation_angle,
    rotation_from_euler,
    rotation_from_quaternion_wxyz,
    rotation_from_rotvec,
    rotvec_from_rotation,
    sampson_distance,
    similarity_from_points,
    to_homogeneous,
    transfer_distance,
    transform_points,
)


def fit(X, Y):
    found = similarity_from_points(X, Y)
    return found.scale, found.R, found.t, found.status


CASES = {
    "cross_matrix": (cross_matrix, [(3,)]),
    "to_homogeneous": (to_homogeneous, [(5, 2)]),
    "from_homogeneous": (from_homogeneous, [(5, 3)]),
    "normalize_sphere": (normalize_sphere, [(5, 3)]),
    "normalizing_similarity": (normalizing_similarity, [(5, 2)]),
    "transform_points": (transform_points, [(3, 3), (5, 2)]),
    "rotation_from_rotvec": (rotation_from_rotvec, [(3,)]),
    "rotvec_from_rotation": (rotvec_from_rotation, ["rotation"]),
    "quaternion_wxyz_from_rotation": (quaternion_wxyz_from_rotation, ["rotation"]),
    "rotation_from_quaternion_wxyz": (rotation_from_quaternion_wxyz, [(4,)]),
    "rotation_angle": (rotation_angle, ["rotation"]),
    "rotation_from_euler": (lambda angles: rotation_from_euler(angles, "xyz"), [(3,)]),
    "Pose": (
        lambda R, t, X, delta: (Pose(R, t) @ Pose(R, t).inverse()).retract(delta).transform(X),
        ["rotation", (3,), (5, 3), (6,)],
    ),
    "similarity_from_points": (fit, [(5, 3), (5, 3)]),
    "krt_from_camera": (krt_from_camera, [(3, 4)]),
    "camera_centre": (camera_centre, [(3, 4)]),
    "project_points": (project_points, [(3, 4), (5, 3)]),
    "point_depths": (point_depths, [(3, 4), (5, 3)]),
    "sampson_distance": (sampson_distance, [(3, 3), (5, 2), (5, 2)]),
    "epipolar_distance": (epipolar_distance, [(3, 3), (5, 2), (5, 2)]),
    "transfer_distance": (transfer_distance, [(3, 3), (5, 2), (5, 2)]),
    "reprojection_distance": (reprojection_distance, [(3, 4), (5, 3), (5, 2)]),
}


def draw(shape, generator):
    if shape == "rotation":
        return random_rotation(4, generator=generator, dtype=torch.float64)
    return torch.randn(4, *shape, generator=generator, dtype=torch.float64)


@pytest.mark.parametrize("name", CASES)
def test_vmap_equals_loop(name, generator):
    function, shapes = CASES[name]
    arguments = [draw(shape, generator) for shape in shapes]
    mapped = torch.func.vmap(function)(*arguments)
    looped = [function(*row) for row in zip(*arguments, strict=True)]
    if isinstance(mapped, torch.Tensor):
        mapped, looped = (mapped,), [(row,) for row in looped]
    for column, rows in zip(mapped, zip(*looped, strict=True), strict=True):
        torch.testing.assert_close(column, torch.stack(rows), rtol=1e-10, atol=1e-10)


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # torch's own, where its forward derivatives are first used
@pytest.mark.parametrize("name", [name for name in DISTORTION_MODELS if name != "pinhole"])
def test_cameras_under_vmap_and_forward_derivatives(name, generator):
    cls = DISTORTION_MODELS[name]
    p = 0.05 * torch.randn(4, cls.num_parameters, generator=generator, dtype=torch.float64)
    u = 0.3 * torch.randn(4, 5, 2, generator=generator, dtype=torch.float64)
    K = torch.eye(3, dtype=torch.float64)

    def unproject(p, u):
        return Camera(K, cls.from_parameters(p)).unproject(u)[0]

    mapped = torch.func.vmap(unproject)(p, u)
    torch.testing.assert_close(
        mapped, torch.stack([unproject(a, b) for a, b in zip(p, u, strict=True)]), rtol=1e-13, atol=1e-13
    )
    direction = (
        torch.randn(cls.num_parameters, generator=generator, dtype=torch.float64),
        torch.ones(5, 2, dtype=torch.float64),
    )
    _, forward = torch.func.jvp(unproject, (p[0], u[0]), direction)
    backward = torch.func.jacrev(unproject, (0, 1))(p[0], u[0])
    expected = backward[0] @ direction[0] + (backward[1] * direction[1]).sum((-2, -1))
    torch.testing.assert_close(forward, expected)
