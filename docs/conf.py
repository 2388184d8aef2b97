"""The docs as a site: the Markdown pages, README first, and the public names from their docstrings.

    make docs        build/site/index.html; warnings are errors, also for broken links

The sources are the repository's pages, which read the same in a checkout.
"""

from __future__ import annotations

import re
import shutil
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sphinx.application import Sphinx

ALIAS = re.compile(r"TypeAliasForwardRef\('(\w+)'\)")
ROOT = Path(__file__).resolve().parent.parent

project = "xplain"
author = "the xplain developers"
project_copyright = author
release = re.search(r'^version = "(.+)"', (ROOT / "pyproject.toml").read_text(), re.MULTILINE)[1]

root_doc = "README"
include_patterns = [
    "README.md",
    "CHANGELOG.md",
    "CONTRIBUTING.md",
    "docs/*.md",
    "docs/api.rst",
    "benchmarks/README.md",
    "benchmarks/results/*.md",
]
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
suppress_warnings = ["toc.not_included"]  # pages that others link, beside those of the sidebar

myst_heading_anchors = 4  # links to headings are checked

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True
autodoc_type_aliases = {name: name for name in ("ArrayLike", "LabelTable", "NDArray")}
napoleon_attr_annotations = False  # signatures have them
napoleon_use_ivar = True

html_theme = "furo"
html_title = "xplain"
html_copy_source = False
html_show_sourcelink = False

SIDEBAR = {
    "Start": [
        "docs/tour.md",
        "docs/gallery.md",
        "docs/glossary.md",
        "docs/method.md",
        "docs/choices.md",
        "docs/domains.md",
    ],
    "Use": [
        "docs/config.md",
        "docs/sweeps.md",
        "docs/reading-results.md",
        "docs/what-to-ask.md",
        "docs/study.md",
    ],
    "Embed and extend": [
        "docs/explainer.md",
        "docs/service.md",
        "docs/python.md",
        "docs/api.rst",
        "docs/your-own-domain.md",
        "docs/your-own-data.md",
        "docs/pddl.md",
        "docs/gymnasium.md",
    ],
    "Measured": [
        "docs/table1.md",
        "docs/asking.md",
        "docs/people-who-err.md",
        "docs/people-nobody-assumed.md",
        "benchmarks/README.md",
    ],
    "Project": ["CONTRIBUTING.md", "CHANGELOG.md"],
}


def _add_sidebar(app: Sphinx, name: str, source: list[str]) -> None:
    """Adds a table of contents to README for Sphinx; a checkout does not need one."""
    if name == root_doc:
        for caption, pages in SIDEBAR.items():
            lines = "\n".join(pages)
            source[0] += f"\n\n```{{toctree}}\n:hidden:\n:caption: {caption}\n\n{lines}\n```\n"


def _copy_index(app: Sphinx, error: Exception | None) -> None:
    """Copies the front page to index.html, the name that servers look for."""
    page = Path(app.outdir) / f"{root_doc}.html"
    if error is None and page.exists():
        shutil.copyfile(page, page.with_name("index.html"))


def _shorten_aliases(
    app: Sphinx, kind: str, name: str, what: object, options: object, given: str, returned: str
) -> tuple[str, str] | None:
    """Replaces aliases within unions by their names; None leaves a signature unchanged."""
    if "TypeAliasForwardRef" not in f"{given}{returned}":
        return None
    return ALIAS.sub(r"\1", given), ALIAS.sub(r"\1", returned or "")


def setup(app: Sphinx) -> None:
    """Connects the hooks above."""
    app.connect("source-read", _add_sidebar)
    app.connect("autodoc-process-signature", _shorten_aliases)
    app.connect("build-finished", _copy_index)
