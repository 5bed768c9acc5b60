"""What Sphinx loads: when which part of the site is made."""

from pathlib import Path
from typing import Any

from sphinx_gallery.directives import depart_imgsg_html, imgsgnode

from building import api, examples, figures, formulas, gallery, links, pages, plain, signatures

GENERATED = Path(__file__).parent.parent / "generated"
ROOT = GENERATED.parent.parent


def setup(app: Any) -> dict[str, bool]:
    """Tell Sphinx what to call; the pages are written before the gallery, which reads the examples written here, is."""
    app.connect("builder-inited", write, priority=100)
    app.connect("autodoc-process-signature", signatures.shorten)
    app.connect("autodoc-process-docstring", plain.process, priority=100)
    app.connect("autodoc-process-docstring", plain.types_beside_names, priority=900)
    app.add_html_math_renderer("mathml", (formulas.inline, None), (formulas.block, None))
    app.add_post_transform(links.LinkNames)
    app.add_post_transform(gallery.Thumbnails)
    app.add_node(imgsgnode, override=True, html=(gallery.figure, depart_imgsg_html))
    return {"parallel_read_safe": True, "parallel_write_safe": True}


def write(app: Any) -> None:
    """Write all pages that are made of something else."""
    api.write(GENERATED / "api")
    pages.write(ROOT, GENERATED / "pages")
    examples.write(ROOT / "examples", GENERATED / "examples", GENERATED / "gallery")
    figures.write(GENERATED / "figures")
