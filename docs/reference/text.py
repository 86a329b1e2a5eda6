"""From docstrings and Markdown to HTML."""

from __future__ import annotations

import re
from pathlib import Path
from textwrap import dedent

import markdown2
import pdoc.docstrings
from markupsafe import Markup

#: Parts of Markdown in use here; `code-friendly` leaves underscores in names alone.
EXTRAS = {
    "code-friendly": None,
    "cuddled-lists": None,
    "fenced-code-blocks": {"cssclass": "pdoc-code codehilite"},
    "header-ids": {"mixed": True, "prefix": None, "reset-count": True},
    "tables": None,
    "toc": {"depth": 2},
}
EXAMPLE = re.compile(r"^Example:\n((?:\n|[ ]+.*(?:\n|$))+)", flags=re.MULTILINE)


def to_markdown(docstring: str) -> str:
    """Markdown of a docstring in Google's style; an example is a block of code."""
    fenced = EXAMPLE.sub(lambda m: f"###### Example:\n\n```pycon\n{dedent(m[1]).strip()}\n```\n", docstring)
    return pdoc.docstrings.convert(fenced, "google", None)


def to_html(markdown: str) -> markdown2.UnicodeWithAttrs:
    """HTML of Markdown in which a `<` is a `<`: docstrings hold no HTML."""
    return markdown2.markdown(markdown, extras=EXTRAS, safe_mode="escape")


class Formulas:
    """The page of formulas, and the anchor of each numbered section."""

    def __init__(self, path: Path) -> None:
        page = to_html(path.read_text(encoding="utf-8"))
        self.body, self.contents = Markup(page), Markup(page.toc_html)
        self.anchors = {
            number: anchor for anchor, number in re.findall(r'<h2 id="([^"]+)">(\d+) ', self.body)
        }
