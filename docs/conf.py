"""How Sphinx makes the site: `make docs`."""

import pathlib
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
