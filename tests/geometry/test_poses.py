import pytest
import torch

from torchsfm._types import tensor_map
from torchsfm.geometry import Pose, random_rotation, rotation_from_rotvec


def make(*shape, generator):
    t = torch.randn(*shape, 3, generator=generator, dtype=torch.float64)
    return Pose(random_rotation(*shape, generator=generator, dtype=torch.float64), t)


@pytest.mark.parametrize("shape", [(), (1,), (2, 3), (0,)])
def test_laws_of_a_group(shape, generator):
    a, b, c = (make(*shape, generator=generator) for _ in range(3))
    X = torch.randn(*shape, 6, 3, generator=generator, dtype=torch.float64)
    torch.testing.assert_close((a @ b).transform(X), a.transform(b.transform(X)))
    torch.testing.assert_close(((a @ b) @ c).matrix(), (a @ (b @ c)).matrix())
    torch.testing.assert_close(a.inverse().transform(a.transform(X)), X)
    identity = Pose.identity(*shape, dtype=torch.float64)
    torch.testing.assert_close((a @ a.inverse()).matrix(), identity.matrix())
    assert (identity @ a).matrix().equal(a.matrix())
    assert a.shape == shape
    assert Pose.from_matrix(a.matrix()).t.equal(a.t)
    torch.testing.assert_close(a.transform(a.centre[..., None, :]), torch.zeros(*shape, 1, 3, dtype=torch.float64))


def test_batches_broadcast(generator):
    a, b = make(4, generator=generator), make(2, 1, generator=generator)
    c = a @ b
    assert c.shape == (2, 4)
    X = torch.randn(5, 3, generator=generator, dtype=torch.float64)
    torch.testing.assert_close(c[1, 2].transform(X), a[2].transform(b[1, 0].transform(X)))
    assert (make(generator=generator) @ a).shape == (4,)
    assert (a @ make(generator=generator)).shape == (4,)
    assert a.transform(X).shape == (4, 5, 3)


def test_indexing_reaches_the_batch_alone(generator):
    pose = make(2, 3, generator=generator)
    assert pose[1].shape == (3,)
    assert pose[..., 0].shape == (2,)
    assert pose[..., 0].t.equal(pose.t[:, 0])
    assert pose[:, 1:].shape == (2, 2)
    assert pose[torch.tensor([0, 0, 1])].shape == (3, 3)
    assert pose[torch.zeros(2, 3, dtype=torch.bool)].shape == (0,)
    assert pose[None].shape == (1, 2, 3)
    with pytest.raises(IndexError):
        pose[0, 0, 0]


def test_retract_is_the_left_perturbation(generator):
    pose = make(3, generator=generator)
    delta = torch.randn(3, 6, generator=generator, dtype=torch.float64)
    expected = Pose(rotation_from_rotvec(delta[:, :3]), delta[:, 3:]) @ pose
    torch.testing.assert_close(pose.retract(delta).matrix(), expected.matrix())
    assert pose.retract(torch.zeros(6, dtype=torch.float64)).matrix().equal(pose.matrix())
    assert make(generator=generator).retract(delta).shape == (3,)


def test_retract_has_the_derivative_it_should_at_zero(generator):
    pose = make(generator=generator)
    X = torch.randn(1, 3, generator=generator, dtype=torch.float64)
    J = torch.func.jacrev(lambda delta: pose.retract(delta).transform(X)[0])(torch.zeros(6, dtype=torch.float64))
    x, y, z = pose.transform(X)[0].tolist()
    expected = [[0, z, -y, 1, 0, 0], [-z, 0, x, 0, 1, 0], [y, -x, 0, 0, 0, 1]]
    torch.testing.assert_close(J, torch.tensor(expected, dtype=torch.float64))


@pytest.mark.parametrize("shape", [(), (2, 3), (0,)])
def test_stacks_are_indexed_apart_again(shape, generator):
    poses = [make(*shape, generator=generator) for _ in range(3)]
    stacked = Pose.stack(poses)
    assert stacked.shape == (3, *shape)
    for i, pose in enumerate(poses):
        assert stacked[i].matrix().equal(pose.matrix())
    assert stacked.to(dtype=torch.float32).matrix().equal(stacked.matrix().float())
    assert stacked.to(device="cpu").t is stacked.t
    with pytest.raises(ValueError, match=r"poses\[1\]: wanted batch dimensions \(3,"):
        Pose.stack([stacked, stacked[:1]])
    with pytest.raises(ValueError, match="poses: wanted at least one"):
        Pose.stack([])


def test_tensor_map_and_identity_options():
    pose = tensor_map(lambda tensor: tensor.double(), Pose.identity(2))
    assert pose.R.dtype == torch.float64
    assert Pose.identity(2, dtype=torch.float32).matrix().shape == (2, 3, 4)


@pytest.mark.usefixtures("unchecked")
def test_wrong_shapes_are_named():
    with pytest.raises(ValueError, match="R: wanted shape"):
        Pose(torch.eye(2), torch.zeros(3))
    with pytest.raises(ValueError, match="t: wanted shape"):
        Pose(torch.eye(3).expand(4, 3, 3), torch.zeros(3))
    with pytest.raises(ValueError, match="rows >= 3"):
        Pose.from_matrix(torch.zeros(2, 4))
