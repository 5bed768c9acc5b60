"""Figures of how well a model fits its images."""

from jaxtyping import Float
from torch import Tensor

from torchsfm.plot.axes import Axes, Figure, array, pyplot
from torchsfm.plot.flat import show_image
from torchsfm.reconstruction.model.reconstruction import Reconstruction


def plot_residuals(
    reconstruction: Reconstruction,
    image: int | str,
    *,
    pixels: Float[Tensor, "*channels h w"] | None = None,
    magnify: float | None = None,
    axes: tuple[Axes, Axes] | None = None,
) -> Figure:
    """Draw the residual of every observation in an image as a vector, and a histogram of their lengths.

    A vector starts at the observed point and points to where the model projects the point. Residuals should look random;
    vectors that agree with their neighbours tell of lens distortion, a wrong pose or a moving object.

    Args:
        reconstruction: The model.
        image: The image's number or name.
        pixels: The image itself, to be shown below the vectors.
        magnify: How many times longer than in the image the vectors are drawn; where not given, such that the median one is
            a fiftieth of the image's width.
        axes: Where to draw the image and the histogram; a new figure where not given.

    Returns:
        The figure.

    Raises:
        ValueError: There is no such image, or it has no pose.
        ImportError: matplotlib is not installed.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> torchsfm.write_model(torchsfm.random_bundle_problem(3, 20, 50, generator=g).problem, "model.npz")
        >>> figure = torchsfm.plot.plot_residuals(torchsfm.read_model("model.npz"), 0)
    """
    if isinstance(image, str):
        if image not in reconstruction.names:
            raise ValueError(f"image: there is no image named {image!r}")
        image = reconstruction.names.index(image)
    if not 0 <= image < len(reconstruction.names):
        raise ValueError(f"image: wanted a number in 0 ... {len(reconstruction.names) - 1}, got {image}")
    name = reconstruction.names[image]
    if not bool(reconstruction.registered[image]):
        raise ValueError(f"image: {name!r} is not registered, so it has no residuals")
    plt = pyplot()
    left, right = plt.subplots(1, 2, layout="constrained", figsize=(11, 4.5), width_ratios=(3, 2))[1] if axes is None else axes
    own = reconstruction.view == image
    x = reconstruction.x[own].detach().cpu()
    vector = (reconstruction.projections()[own].detach().cpu() - x).nan_to_num()
    length = vector.norm(dim=-1)
    width, height = reconstruction.image_size[image].tolist()
    typical = float(length.median()) if len(length) else 0.0
    if magnify is None:
        magnify = width / 50 / typical if typical > 0 else 1.0
    if pixels is not None:
        show_image(pixels, ax=left)
    left.quiver(
        *array(x.T), *array(vector.T), array(length), angles="xy", scale_units="xy", scale=1 / magnify, width=0.0015,
        cmap="plasma", clim=(0, max(2 * typical, 1e-9)),
    )  # fmt: skip
    left.set_xlim(-0.5, width - 0.5)
    left.set_ylim(height - 0.5, -0.5)
    left.set_aspect("equal")
    left.set_title(f"{name}: {len(x)} residuals, drawn {magnify:.3g} times longer")
    # The last bin holds everything beyond the 99th percentile too.
    limit = float(length.sort().values[int(0.99 * (len(length) - 1))]) if len(length) else 1.0
    limit = limit if limit > 0 else 1.0
    right.hist(array(length.clamp(max=limit)), bins=40, range=(0, limit), color="tab:blue")
    right.set_xlabel("residual [px], the last bin and beyond" if len(length) else "residual [px]")
    right.set_ylabel("observations")
    mean = float(length.mean()) if len(length) else 0.0
    right.set_title(
        f"mean {mean:.3g} px, median {typical:.3g} px, rms {float(length.square().mean().sqrt()) if len(x) else 0.0:.3g} px"
    )
    return left.figure
