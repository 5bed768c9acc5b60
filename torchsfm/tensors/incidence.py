"""What corresponding points and lines satisfy: the incidence relations of three and four views (HZ tables 15.1, 16.1 and 17.2).

Names list what is given in each view, p a point, l a line. Points are (n, 2) in pixels, lines homogeneous (n, 3). Residuals are
algebraic, linear in the tensor and in each point and line as it is given. A line given beside points is any line through the
image of the point; lines given alone are images of one line in space, but for `quadrifocal_llll`, where they are any lines
through the images of one point. For another order of what is given reorder the tensor: `reordered_trifocal`, or Q's indices.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm._types import check_tensors
from torchsfm.geometry.homogeneous import to_homogeneous
from torchsfm.geometry.rotations import cross_matrix


def trifocal_ppp(
    T: Float[Tensor, "*#batch 3 3 3"],
    x1: Float[Tensor, "*#batch n 2"],
    x2: Float[Tensor, "*#batch n 2"],
    x3: Float[Tensor, "*#batch n 2"],
) -> Float[Tensor, "*batch n 3 3"]:
    """Point, point, point: [x2]x (x1^i T_i) [x3]x = 0, nine equations of which four are independent as equations for T.

    Args:
        T: The trifocal tensor of the views.
        x1: Image points in the first view.
        x2: Image points in the second view.
        x3: Image points in the third view.

    Example:
        >>> import torch, torchsfm
        >>> P = torchsfm.random_poses(3, generator=torch.Generator().manual_seed(0)).matrix()
        >>> x = torchsfm.project_points(P, torch.zeros(1, 3, dtype=P.dtype))
        >>> T = torchsfm.tensors.trifocal_from_cameras(*P)
        >>> bool(torchsfm.tensors.trifocal_ppp(T, *x).abs().max() < 1e-9)
        True
    """
    check_tensors(T=(T, "3 3 3"), x1=(x1, "n 2"), x2=(x2, "n 2"), x3=(x3, "n 2"))
    return _cross(x2) @ torch.einsum("...ijk,...ni->...njk", T, to_homogeneous(x1)) @ _cross(x3)


def trifocal_ppl(
    T: Float[Tensor, "*#batch 3 3 3"],
    x1: Float[Tensor, "*#batch n 2"],
    x2: Float[Tensor, "*#batch n 2"],
    l3: Float[Tensor, "*#batch n 3"],
) -> Float[Tensor, "*batch n 3"]:
    """Point, point, line: [x2]x (x1^i T_i) l3 = 0.

    Args:
        T: The trifocal tensor of the views.
        x1: Image points in the first view.
        x2: Image points in the second view.
        l3: Homogeneous image lines in the third view.

    Example:
        >>> import torch, torchsfm
        >>> P = torchsfm.random_poses(3, generator=torch.Generator().manual_seed(0)).matrix()
        >>> x = torchsfm.project_points(P, torch.zeros(1, 3, dtype=P.dtype))
        >>> l3 = torchsfm.geometry.line_from_points(x[2], x[2] + torch.tensor([1, 2]))  # any line through the image
        >>> T = torchsfm.tensors.trifocal_from_cameras(*P)
        >>> bool(torchsfm.tensors.trifocal_ppl(T, x[0], x[1], l3).abs().max() < 1e-9)
        True
    """
    check_tensors(T=(T, "3 3 3"), x1=(x1, "n 2"), x2=(x2, "n 2"), l3=(l3, "n 3"))
    y = torch.einsum("...ijk,...ni,...nk->...nj", T, to_homogeneous(x1), l3)
    return (_cross(x2) @ y[..., None])[..., 0]


def trifocal_plp(
    T: Float[Tensor, "*#batch 3 3 3"],
    x1: Float[Tensor, "*#batch n 2"],
    l2: Float[Tensor, "*#batch n 3"],
    x3: Float[Tensor, "*#batch n 2"],
) -> Float[Tensor, "*batch n 3"]:
    """Point, line, point: l2' (x1^i T_i) [x3]x = 0.

    Args:
        T: The trifocal tensor of the views.
        x1: Image points in the first view.
        l2: Homogeneous image lines in the second view.
        x3: Image points in the third view.

    Example:
        >>> import torch, torchsfm
        >>> P = torchsfm.random_poses(3, generator=torch.Generator().manual_seed(0)).matrix()
        >>> x = torchsfm.project_points(P, torch.zeros(1, 3, dtype=P.dtype))
        >>> l2 = torchsfm.geometry.line_from_points(x[1], x[1] + torch.tensor([1, 2]))  # any line through the image
        >>> T = torchsfm.tensors.trifocal_from_cameras(*P)
        >>> bool(torchsfm.tensors.trifocal_plp(T, x[0], l2, x[2]).abs().max() < 1e-9)
        True
    """
    check_tensors(T=(T, "3 3 3"), x1=(x1, "n 2"), l2=(l2, "n 3"), x3=(x3, "n 2"))
    y = torch.einsum("...ijk,...ni,...nj->...nk", T, to_homogeneous(x1), l2)
    return (y[..., None, :] @ _cross(x3))[..., 0, :]


def trifocal_pll(
    T: Float[Tensor, "*#batch 3 3 3"],
    x1: Float[Tensor, "*#batch n 2"],
    l2: Float[Tensor, "*#batch n 3"],
    l3: Float[Tensor, "*#batch n 3"],
) -> Float[Tensor, "*batch n"]:
    """Point, line, line: l2' (x1^i T_i) l3 = 0. Also for a point x1 on the first image of a line with images l2 and l3.

    Args:
        T: The trifocal tensor of the views.
        x1: Image points in the first view.
        l2: Homogeneous image lines in the second view.
        l3: Homogeneous image lines in the third view.

    Example:
        >>> import torch, torchsfm
        >>> P = torchsfm.random_poses(3, generator=torch.Generator().manual_seed(0)).matrix()
        >>> x = torchsfm.project_points(P, torch.zeros(1, 3, dtype=P.dtype))
        >>> l = torchsfm.geometry.line_from_points(x, x + torch.tensor([1, 2]))  # any lines through the images
        >>> T = torchsfm.tensors.trifocal_from_cameras(*P)
        >>> bool(torchsfm.tensors.trifocal_pll(T, x[0], l[1], l[2]).abs().max() < 1e-9)
        True
    """
    check_tensors(T=(T, "3 3 3"), x1=(x1, "n 2"), l2=(l2, "n 3"), l3=(l3, "n 3"))
    return torch.einsum("...ijk,...ni,...nj,...nk->...n", T, to_homogeneous(x1), l2, l3)


def trifocal_lll(
    T: Float[Tensor, "*#batch 3 3 3"],
    l1: Float[Tensor, "*#batch n 3"],
    l2: Float[Tensor, "*#batch n 3"],
    l3: Float[Tensor, "*#batch n 3"],
) -> Float[Tensor, "*batch n 3"]:
    """Line, line, line: (l2_j l3_k T_i^jk) x l1 = 0, three equations of which two are independent.

    Args:
        T: The trifocal tensor of the views.
        l1: Homogeneous image lines in the first view.
        l2: Homogeneous image lines in the second view.
        l3: Homogeneous image lines in the third view.

    Example:
        >>> import torch, torchsfm
        >>> P = torchsfm.random_poses(3, generator=torch.Generator().manual_seed(0)).matrix()
        >>> l = torchsfm.geometry.project_lines(P, torch.tensor([[1.0, 0.0, 0.0, 0.0, 0.5, 0.0]], dtype=P.dtype))
        >>> T = torchsfm.tensors.trifocal_from_cameras(*P)
        >>> bool(torchsfm.tensors.trifocal_lll(T, *l).abs().max() < 1e-9)
        True
    """
    check_tensors(T=(T, "3 3 3"), l1=(l1, "n 3"), l2=(l2, "n 3"), l3=(l3, "n 3"))
    y = torch.einsum("...ijk,...nj,...nk->...ni", T, l2, l3)
    return -(cross_matrix(l1) @ y[..., None])[..., 0]


def quadrifocal_pppp(
    Q: Float[Tensor, "*#batch 3 3 3 3"],
    x1: Float[Tensor, "*#batch n 2"],
    x2: Float[Tensor, "*#batch n 2"],
    x3: Float[Tensor, "*#batch n 2"],
    x4: Float[Tensor, "*#batch n 2"],
) -> Float[Tensor, "*batch n 3 3 3 3"]:
    """Four points: [x1]x [x2]x [x3]x [x4]x applied to the indices of Q is 0; 81 equations, 16 of them independent for Q.

    Args:
        Q: The quadrifocal tensor of the views.
        x1: Image points in the first view.
        x2: Image points in the second view.
        x3: Image points in the third view.
        x4: Image points in the fourth view.

    Example:
        >>> import torch, torchsfm
        >>> P = torchsfm.random_poses(4, generator=torch.Generator().manual_seed(0)).matrix()
        >>> x = torchsfm.project_points(P, torch.zeros(1, 3, dtype=P.dtype))
        >>> Q = torchsfm.tensors.quadrifocal_from_cameras(*P)
        >>> residuals = torchsfm.tensors.quadrifocal_pppp(Q, *x)
        >>> residuals.shape, bool(residuals.abs().max() < 1e-9)
        (torch.Size([1, 3, 3, 3, 3]), True)
    """
    check_tensors(Q=(Q, "3 3 3 3"), x1=(x1, "n 2"), x2=(x2, "n 2"), x3=(x3, "n 2"), x4=(x4, "n 2"))
    A, B, C, D = (_cross(x) for x in (x1, x2, x3, x4))
    return torch.einsum("...pqrs,...nwp,...nxq,...nyr,...nzs->...nwxyz", Q, A, B, C, D)


def quadrifocal_pppl(
    Q: Float[Tensor, "*#batch 3 3 3 3"],
    x1: Float[Tensor, "*#batch n 2"],
    x2: Float[Tensor, "*#batch n 2"],
    x3: Float[Tensor, "*#batch n 2"],
    l4: Float[Tensor, "*#batch n 3"],
) -> Float[Tensor, "*batch n 3 3 3"]:
    """Three points and a line through the fourth.

    Args:
        Q: The quadrifocal tensor of the views.
        x1: Image points in the first view.
        x2: Image points in the second view.
        x3: Image points in the third view.
        l4: Homogeneous image lines in the fourth view.

    Example:
        >>> import torch, torchsfm
        >>> P = torchsfm.random_poses(4, generator=torch.Generator().manual_seed(0)).matrix()
        >>> x = torchsfm.project_points(P, torch.zeros(1, 3, dtype=P.dtype))
        >>> l4 = torchsfm.geometry.line_from_points(x[3], x[3] + torch.tensor([1, 2]))  # any line through the image
        >>> Q = torchsfm.tensors.quadrifocal_from_cameras(*P)
        >>> bool(torchsfm.tensors.quadrifocal_pppl(Q, x[0], x[1], x[2], l4).abs().max() < 1e-9)
        True
    """
    check_tensors(Q=(Q, "3 3 3 3"), x1=(x1, "n 2"), x2=(x2, "n 2"), x3=(x3, "n 2"), l4=(l4, "n 3"))
    A, B, C = (_cross(x) for x in (x1, x2, x3))
    return torch.einsum("...pqrs,...nwp,...nxq,...nyr,...ns->...nwxy", Q, A, B, C, l4)


def quadrifocal_ppll(
    Q: Float[Tensor, "*#batch 3 3 3 3"],
    x1: Float[Tensor, "*#batch n 2"],
    x2: Float[Tensor, "*#batch n 2"],
    l3: Float[Tensor, "*#batch n 3"],
    l4: Float[Tensor, "*#batch n 3"],
) -> Float[Tensor, "*batch n 3 3"]:
    """Two points and lines through the other two.

    Args:
        Q: The quadrifocal tensor of the views.
        x1: Image points in the first view.
        x2: Image points in the second view.
        l3: Homogeneous image lines in the third view.
        l4: Homogeneous image lines in the fourth view.

    Example:
        >>> import torch, torchsfm
        >>> P = torchsfm.random_poses(4, generator=torch.Generator().manual_seed(0)).matrix()
        >>> x = torchsfm.project_points(P, torch.zeros(1, 3, dtype=P.dtype))
        >>> l = torchsfm.geometry.line_from_points(x, x + torch.tensor([1, 2]))  # any lines through the images
        >>> Q = torchsfm.tensors.quadrifocal_from_cameras(*P)
        >>> bool(torchsfm.tensors.quadrifocal_ppll(Q, x[0], x[1], l[2], l[3]).abs().max() < 1e-9)
        True
    """
    check_tensors(Q=(Q, "3 3 3 3"), x1=(x1, "n 2"), x2=(x2, "n 2"), l3=(l3, "n 3"), l4=(l4, "n 3"))
    A, B = _cross(x1), _cross(x2)
    return torch.einsum("...pqrs,...nwp,...nxq,...nr,...ns->...nwx", Q, A, B, l3, l4)


def quadrifocal_plll(
    Q: Float[Tensor, "*#batch 3 3 3 3"],
    x1: Float[Tensor, "*#batch n 2"],
    l2: Float[Tensor, "*#batch n 3"],
    l3: Float[Tensor, "*#batch n 3"],
    l4: Float[Tensor, "*#batch n 3"],
) -> Float[Tensor, "*batch n 3"]:
    """A point and lines through its other three images.

    Args:
        Q: The quadrifocal tensor of the views.
        x1: Image points in the first view.
        l2: Homogeneous image lines in the second view.
        l3: Homogeneous image lines in the third view.
        l4: Homogeneous image lines in the fourth view.

    Example:
        >>> import torch, torchsfm
        >>> P = torchsfm.random_poses(4, generator=torch.Generator().manual_seed(0)).matrix()
        >>> x = torchsfm.project_points(P, torch.zeros(1, 3, dtype=P.dtype))
        >>> l = torchsfm.geometry.line_from_points(x, x + torch.tensor([1, 2]))  # any lines through the images
        >>> Q = torchsfm.tensors.quadrifocal_from_cameras(*P)
        >>> bool(torchsfm.tensors.quadrifocal_plll(Q, x[0], l[1], l[2], l[3]).abs().max() < 1e-9)
        True
    """
    check_tensors(Q=(Q, "3 3 3 3"), x1=(x1, "n 2"), l2=(l2, "n 3"), l3=(l3, "n 3"), l4=(l4, "n 3"))
    return torch.einsum("...pqrs,...nwp,...nq,...nr,...ns->...nw", Q, _cross(x1), l2, l3, l4)


def quadrifocal_llll(
    Q: Float[Tensor, "*#batch 3 3 3 3"],
    l1: Float[Tensor, "*#batch n 3"],
    l2: Float[Tensor, "*#batch n 3"],
    l3: Float[Tensor, "*#batch n 3"],
    l4: Float[Tensor, "*#batch n 3"],
) -> Float[Tensor, "*batch n"]:
    """Four lines through the images of one point, one in each view: l1_p l2_q l3_r l4_s Q^pqrs = 0.

    Args:
        Q: The quadrifocal tensor of the views.
        l1: Homogeneous image lines in the first view.
        l2: Homogeneous image lines in the second view.
        l3: Homogeneous image lines in the third view.
        l4: Homogeneous image lines in the fourth view.

    Example:
        >>> import torch, torchsfm
        >>> P = torchsfm.random_poses(4, generator=torch.Generator().manual_seed(0)).matrix()
        >>> x = torchsfm.project_points(P, torch.zeros(1, 3, dtype=P.dtype))
        >>> l = torchsfm.geometry.line_from_points(x, x + torch.tensor([1, 2]))  # any lines through the images
        >>> Q = torchsfm.tensors.quadrifocal_from_cameras(*P)
        >>> bool(torchsfm.tensors.quadrifocal_llll(Q, *l).abs().max() < 1e-9)
        True
    """
    check_tensors(Q=(Q, "3 3 3 3"), l1=(l1, "n 3"), l2=(l2, "n 3"), l3=(l3, "n 3"), l4=(l4, "n 3"))
    return torch.einsum("...pqrs,...np,...nq,...nr,...ns->...n", Q, l1, l2, l3, l4)


def quadrifocal_lll(
    Q: Float[Tensor, "*#batch 3 3 3 3"],
    l1: Float[Tensor, "*#batch n 3"],
    l2: Float[Tensor, "*#batch n 3"],
    l3: Float[Tensor, "*#batch n 3"],
) -> Float[Tensor, "*batch n 3"]:
    """The images of one line in the first three views: l1_p l2_q l3_r Q^pqrs = 0 for each s.

    Args:
        Q: The quadrifocal tensor of the views.
        l1: Homogeneous image lines in the first view.
        l2: Homogeneous image lines in the second view.
        l3: Homogeneous image lines in the third view.

    Example:
        >>> import torch, torchsfm
        >>> P = torchsfm.random_poses(4, generator=torch.Generator().manual_seed(0)).matrix()
        >>> L = torch.tensor([[1.0, 0.0, 0.0, 0.0, 0.5, 0.0]], dtype=P.dtype)
        >>> l = torchsfm.geometry.project_lines(P, L)
        >>> Q = torchsfm.tensors.quadrifocal_from_cameras(*P)
        >>> bool(torchsfm.tensors.quadrifocal_lll(Q, l[0], l[1], l[2]).abs().max() < 1e-9)
        True
    """
    check_tensors(Q=(Q, "3 3 3 3"), l1=(l1, "n 3"), l2=(l2, "n 3"), l3=(l3, "n 3"))
    return torch.einsum("...pqrs,...np,...nq,...nr->...ns", Q, l1, l2, l3)


def _cross(x: Tensor) -> Tensor:
    return cross_matrix(to_homogeneous(x))
