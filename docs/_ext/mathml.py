"""Sphinx extension: equations as MathML, which browsers render without scripts, fonts or requests.

It uses the converter of the docutils HTML writer.
"""

from __future__ import annotations

import re

from docutils import nodes
from docutils.utils.math import MathError, latex2mathml
from sphinx.application import Sphinx
from sphinx.util import logging
from sphinx.writers.html5 import HTML5Translator

logger = logging.getLogger(__name__)

NO_BRACES = re.compile(r"\\[dt]?frac\s*\d\d")  # TeX reads one digit, docutils the complete number
FUNCTION = re.compile(r"<mo>&ApplyFunction;</mo>(?!\s*(?:<mo[^>]*>[(\[]|<mspace))")  # without parentheses or space
FACTOR = re.compile(r"</m(?:i|n|frac|sub|sup|subsup)>(?=\s*<mi[^>]*>\w+</mi>\s*<mo>&ApplyFunction;)")  # before it
SPACE = r'\g<0><mspace width="0.1667em"></mspace>'  # as in TeX
BELOW_ACCENT = re.compile(r'<munderover>(?:(?!</munderover>).)*<mo stretchy="false">', re.DOTALL)


def mathml(node: nodes.Node, block: bool) -> str:
    """Return an equation as MathML; unsupported LaTeX causes a warning, which fails the build.

    Browsers without a mathematical font drop the dot of an accent; the style sheet positions it.
    """
    try:
        result = latex2mathml.tex2mathml(node.astext(), as_block=block)
    except MathError as error:
        logger.warning("equation cannot be written as MathML: %s", error, location=node)
        return ""
    if NO_BRACES.search(node.astext()):
        logger.warning("a fraction without braces is misread by docutils: %s", node.astext(), location=node)
    if BELOW_ACCENT.search(result):
        logger.warning("a subscript after an accent lands below the letter: %s", node.astext(), location=node)
    result = FACTOR.sub(SPACE, FUNCTION.sub(SPACE, result))
    return result.replace('accent="true"', 'class="accent"')


def visit_math(translator: HTML5Translator, node: nodes.math) -> None:
    """Write an inline equation."""
    translator.body.append(mathml(node, block=False))
    raise nodes.SkipNode


def visit_math_block(translator: HTML5Translator, node: nodes.math_block) -> None:
    """Write a displayed equation, with a number and an anchor if it has a label."""
    translator.body.append(translator.starttag(node, "div", CLASS="equation"))
    translator.body.append(mathml(node, block=True))
    if node["number"]:
        translator.body.append(f'<span class="eqno">({node["number"]})')
        translator.add_permalink_ref(node, "Link to this equation")
        translator.body.append("</span>")
    translator.body.append("</div>")
    raise nodes.SkipNode


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the renderer for ``html_math_renderer = "mathml"``."""
    app.add_html_math_renderer("mathml", (visit_math, None), (visit_math_block, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
