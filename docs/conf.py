"""How Sphinx makes the site: `make docs`."""

import pathlib
import re
import sys

sys.path.insert(0, str(pathlib.Path(__file__).resolve().parent.parent))

import biotac_mj  # noqa: E402

project, author = "biotac_mj", "The biotac_mj authors"
version = release = biotac_mj.__version__
copyright = author
extensions = ["myst_parser", "sphinx_copybutton"]
exclude_patterns = ["_build"]
html_theme = "furo"
html_title = "biotac_mj"
html_static_path = ["static"]
html_css_files = ["site.css"]
myst_enable_extensions = ["dollarmath", "colon_fence"]
myst_heading_anchors = 3


def menu(text: str) -> dict[str, list[str]]:
    """Pages of the site's menu by caption: links in an index page's tables, which a Git host shows too."""
    found = {}
    for first, second in re.findall(r"^\|([^|\n]*)\|(.*)\|$", text, re.MULTILINE):
        caption = "" if "](" in first else first.strip()
        found.setdefault(caption, []).extend(re.findall(r"\]\(([\w/]+)\.md\)", first + second))
    return {caption: pages for caption, pages in found.items() if pages}


def _add_menu(app, name, source):
    if name in ("index", "lab/index"):
        for caption, pages in menu(source[0]).items():
            lines = ":hidden:", *([f":caption: {caption}"] if caption else []), "", *pages
            source[0] += "\n```{toctree}\n" + "\n".join(lines) + "\n```\n"


def setup(app):
    """Sphinx calls this."""
    app.connect("source-read", _add_menu)
