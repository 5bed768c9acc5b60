"""What sphinx-gallery leaves to be mended in the pages that it writes: pictures that say what they show."""

from pathlib import Path
from typing import Any

from docutils import nodes
from sphinx.transforms.post_transforms import SphinxPostTransform
from sphinx_gallery.directives import visit_imgsg_html


class Thumbnails(SphinxPostTransform):
    """Give the picture on the card of an example a text, or take it away where the example draws none of its own."""

    default_priority = 500
    """After references are resolved: the card's link then carries the title of the example."""

    def run(self, **_: Any) -> None:
        """Find them by their names."""
        for image in list(self.document.findall(nodes.image)):
            path = Path(image["uri"])
            if not path.name.endswith("_thumb.png"):
                continue
            first_figure = path.name.replace("_thumb.png", "_001.png")
            if (Path(self.env.srcdir) / path.parent.parent / first_figure).exists():
                title = image.next_node(nodes.reference, ascend=True)
                image["alt"] = f"A figure of “{title.astext()}”" if title else ""
            else:
                image.parent.remove(image)


def figure(writer: Any, node: nodes.Element) -> None:
    """Write a figure of an example as a link to itself: on a phone, two panels side by side are too small to read."""
    start = len(writer.body)
    visit_imgsg_html(writer, node)
    picture = "".join(writer.body[start:])
    address = picture.partition('src="')[2].partition('"')[0]
    writer.body[start:] = [f'<a href="{address}">{picture}</a>']
