"""Sphinx configuration of the documentation site: ``make docs`` writes docs/_build/html.

The pages are Markdown that also reads well on GitHub. Equations become MathML when the site is
built, so that a browser shows them without a script or the network.
"""

import re
from typing import Any

from docutils import nodes
from docutils.utils.math import MathError
from docutils.utils.math.latex2mathml import tex2mathml
from sphinx.util import logging

import sb3_guard

project = "sb3_guard"
author = "The sb3_guard developers"
copyright = f"{author}. MIT license"
version = release = sb3_guard.__version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.viewcode", "sphinx_copybutton"]
exclude_patterns = ["_build", "browser"]  # the page in a browser has its own script
needs_sphinx = "8.1"

myst_enable_extensions = ["dollarmath"]
myst_fence_as_directive = ["math"]  # GitHub's fence for an equation
myst_heading_anchors = 3

autodoc_member_order = "bysource"
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented"
autodoc_typehints_format = "short"
autodoc_class_signature = "mixed"
python_use_unqualified_type_names = True
toc_object_entries_show_parents = "hide"

html_theme = "furo"
html_title = f"sb3_guard {release}"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_math_renderer = "mathml"
html_show_sourcelink = False
copybutton_exclude = ".linenos, .gp, .go"

linkcheck_ignore = [r"https?://"]  # links of the site itself are checked; others need a network


def to_mathml(node: nodes.Element, display: bool) -> str:
    """The equation of a node as MathML; a warning if it uses what docutils does not know."""
    try:
        return tex2mathml(node.astext(), as_block=display)
    except MathError as error:
        logging.getLogger(__name__).warning(f"{node.astext()!r}: {error}", location=node)
        return node.astext()


def inline_math(writer: Any, node: nodes.math) -> None:
    writer.body.append(to_mathml(node, display=False))
    raise nodes.SkipNode


def display_math(writer: Any, node: nodes.math_block) -> None:
    writer.body.append(f'<div class="math">{to_mathml(node, display=True)}</div>')
    raise nodes.SkipNode


def name_lab(app: Any, page: str, source: list[str]) -> None:
    """Links to lab/, which is not part of the site, become the paths of its files."""
    source[0] = re.sub(r"\[([^]]*)\]\((?:\.\./)+(lab/\w+\.md)[^)]*\)", r"\1 (`\2`)", source[0])


def setup(app: Any) -> None:
    app.connect("source-read", name_lab)
    app.add_html_math_renderer("mathml", (inline_math, None), (display_math, None))
