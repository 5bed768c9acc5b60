"""Formulas as MathML, which browsers draw by themselves: pages need nothing from elsewhere, also offline."""

from typing import Any

from docutils import nodes
from docutils.utils.math import MathError, latex2mathml
from sphinx.util import logging

logger = logging.getLogger(__name__)


def inline(writer: Any, node: nodes.Element) -> None:
    """Write a formula in a line of text."""
    writer.body.append(_mathml(writer, node, block=False))
    raise nodes.SkipNode


def block(writer: Any, node: nodes.Element) -> None:
    """Write a formula on a line of its own."""
    writer.body.append(f'<div class="math">{_mathml(writer, node, block=True)}</div>')
    raise nodes.SkipNode


def _mathml(writer: Any, node: nodes.Element, *, block: bool) -> str:
    """The formula; as it was typed, and with a warning, where it uses a command that docutils does not know."""
    try:
        return str(latex2mathml.tex2mathml(node.astext(), as_block=block))
    except MathError as error:
        logger.warning("%s", error, location=node)
        return f"<code>{writer.encode(node.astext())}</code>"
