"""Code that is the name of something public becomes a link to its page, in docstrings, tables and text."""

from typing import Any

from docutils import nodes
from sphinx.transforms.post_transforms import SphinxPostTransform
from sphinx.util.nodes import make_refnode

from building.names import find


class LinkNames(SphinxPostTransform):
    """Wrap inline literals that name something public in references."""

    default_priority = 200

    def run(self, **_: Any) -> None:
        """Find them and wrap them, but for those in links, in headings, and on the page of the name itself."""
        for literal in list(self.document.findall(nodes.literal)):
            name = find(literal.astext())
            page = name and f"generated/api/{name.full}"
            if name is None or page == self.env.docname or self._stands_in(literal, (nodes.reference, nodes.title)):
                continue
            target = make_refnode(self.app.builder, self.env.docname, str(page), name.full, [literal.deepcopy()], name.full)
            literal.replace_self(target)

    @staticmethod
    def _stands_in(node: nodes.Node, kinds: tuple[type[nodes.Node], ...]) -> bool:
        while node.parent is not None:
            node = node.parent
            if isinstance(node, kinds):
                return True
        return False
