"""The interactive page: one HTML file with the model inside, to be turned with the mouse, without network or server."""

import base64
import html
import json
import tempfile
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from string import Template

from torchsfm.images import MAX_PIXELS, read_image, save_image
from torchsfm.linalg.devices import on_the_cpu
from torchsfm.plot.page_content import model_content, pairs_content
from torchsfm.reconstruction.model.files import whole_file
from torchsfm.reconstruction.model.reconstruction import Reconstruction
from torchsfm.reconstruction.report import Report

SCRIPTS = ("vectors", "shaders", "model", "view", "overlay", "picking", "details", "pairs", "moving", "panel")
"""The parts of the page's script, in the order in which they build on each other."""

SMALLEST = 48
"""A copy with fewer pixels along its longer side shows nothing."""


@on_the_cpu
def write_page(
    reconstruction: Reconstruction | Sequence[Reconstruction],
    path: str | Path,
    *,
    title: str = "Reconstruction",
    report: Report | None = None,
    images: str | Path | None = None,
    unit: str = "",
    thumbnail: int = 800,
    photo_bytes: int = 8_000_000,
    max_pixels: int = MAX_PIXELS,
) -> Path:
    """Write a self-contained interactive page of one model or of several.

    It shows the coloured points, lines and curves if there are any, and the cameras, upright, with axes and a scale bar;
    doubtful cameras are marked. Distances can be measured between two points; clicking a point shows how every image saw it,
    clicking a camera its image with the residuals; points can be coloured and filtered by track length and error; a table lists
    every image, a matrix every pair. Mouse, touch and keys do the same. It needs a browser with WebGL 2 and nothing else.
    Points, lines and cameras are stored as 32-bit floats, image points to 1/65535 of the image's size, residuals as 16-bit
    floats.

    Args:
        reconstruction: The model, or models to choose from, the most interesting first.
        path: The HTML file to write. Its folder is made if need be.
        title: Heading of the page.
        report: Tells why images were not registered, which pairs were compared, and of files that could not be read.
        images: Folder with the photographs under their names. If given, small copies are put into the page and shown at
            the cameras; photographs that cannot be read are left out.
        unit: Name of the models' unit of length, such as "m"; empty where their scale is arbitrary.
        thumbnail: Longer side of these copies in pixels, at most.
        photo_bytes: What all copies together may add to the page. Each may use an equal share and is made as small as that asks
            for; where it would show nothing any more, it is left out.
        max_pixels: Photographs that have more are left out too.

    Returns:
        The path written.

    Raises:
        ValueError: No model was given, or a size is not positive.
        OSError: The file cannot be written.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> torchsfm.write_model(torchsfm.random_bundle_problem(3, 20, 50, generator=g).truth, "model.npz")
        >>> torchsfm.write_page(torchsfm.read_model("model.npz"), "model.html").name
        'model.html'
    """
    models = [reconstruction] if isinstance(reconstruction, Reconstruction) else list(reconstruction)
    if not models:
        raise ValueError("reconstruction: wanted at least one model, got none")
    if thumbnail < 1:
        raise ValueError(f"thumbnail: wanted a size in pixels, got {thumbnail}")
    if photo_bytes < 0:
        raise ValueError(f"photo_bytes: wanted a number of bytes, got {photo_bytes}")
    photos: dict[str, str] = {}
    if images is not None:
        names = sorted({name for model in models for name in model.names})
        share = photo_bytes // max(len(names), 1)
        copies = {name: _thumbnail(Path(images) / name, thumbnail, share, max_pixels) for name in names}
        photos = {name: copy for name, copy in copies.items() if copy is not None}
    content = {
        "title": title,
        "unit": unit,
        "photos": photos,
        "pairs": None if report is None else pairs_content(report),
        "models": [model_content(model, number, report, len(models)) for number, model in enumerate(models)],
    }
    # Inside a script element only "<" could end the data early.
    text = json.dumps(content, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
    folder = files("torchsfm.plot") / "web"
    template, style, *scripts = (
        (folder / name).read_text(encoding="utf-8") for name in ("page.html", "page.css", *(f"{part}.js" for part in SCRIPTS))
    )
    page = Template(template).substitute(title=html.escape(title), style=style, data=text, script="\n".join(scripts))
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    with whole_file(path) as file:
        # A file name that is not UTF-8 has no characters of its own.
        file.write(page.encode("utf-8", "backslashreplace"))
    return path


def _thumbnail(path: Path, size: int, share: int, max_pixels: int) -> str | None:
    """A JPEG of a photograph as a data address of at most `share` characters; None where it cannot be read or made so small."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "thumbnail.jpg"
        while True:
            try:
                pixels = read_image(path, max_size=size, max_pixels=max_pixels).pixels
            except (OSError, ValueError):
                return None
            save_image(file, pixels, quality=80)
            address = "data:image/jpeg;base64," + base64.b64encode(file.read_bytes()).decode("ascii")
            if len(address) <= share:
                return address
            # The bytes of a JPEG go with its pixels, less its header.
            size = int(max(pixels.shape[-2:]) * min(0.9, 0.95 * (share / len(address)) ** 0.5))
            if size < SMALLEST:
                return None
