"""How Sphinx makes the site: `make docs`."""

import importlib.util
import os
import pathlib
import re
import sys

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("MUJOCO_GL", "disable")
ROOT = pathlib.Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))
# the kernels that run the tutorials import the same source tree
os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))

import biotac_mj  # noqa: E402

project, author = "biotac_mj", "The biotac_mj authors"
version = release = biotac_mj.__version__
copyright = author
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx_copybutton"]
exclude_patterns = ["_build"]
html_theme = "furo"
html_title = "biotac_mj"
html_static_path = ["static"]
html_css_files = ["site.css"]
myst_enable_extensions = ["dollarmath", "colon_fence"]
myst_heading_anchors = 3
nb_execution_mode = "cache"
nb_execution_timeout = 600
nb_execution_raise_on_error = True
nb_merge_streams = True
nb_output_stderr = "remove"  # drivers that are missing
# docstrings have `code` in single backquotes
default_role = "code"
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented"
napoleon_use_ivar = True
autodoc_member_order = "bysource"
# what is not installed is not needed to read the signatures
autodoc_mock_imports = [
    name
    for name in (
        "dm_control",
        "dm_env",
        "gymnasium",
        "mujoco_warp",
        "torch",
        "safetensors",
        "viser",
        "pyarrow",
    )
    if importlib.util.find_spec(name) is None
]


def _as_rst(app, what, name, thing, options, lines):
    """Our docstrings are plain text: examples are indented, stars are stars, a heading may say more."""
    out, code = [], False
    for before, line in zip(["", *lines], lines):
        if line == "Returns:":  # not napoleon's: there what stands before a colon is a type
            continue
        if before == "Returns:":
            line = f":returns: {line.strip()}"
        if what == "class":  # two names of one line are no type and a name
            line = re.sub(r"^  (\w+(, \w+)+):", lambda names: names[0].replace(", ", "/"), line)
        if what == "property":
            line = line.replace(": ", " – ")
        line = re.sub(r"^(Args|Attributes) \(.*\):$", r"\1:", line)
        indent = len(line) - len(line.lstrip())
        if indent >= 4 and not before.strip() and not code:
            out += [".. code-block:: python", ""]
            code = True
        elif line and indent < 4:
            code = False
        if indent == 2 and re.match(r"\w.*,.*:$", before):
            out += ["", "Attributes:"]
        out.append(line if code else re.sub(r"\*+", lambda stars: "\\*" * len(stars[0]), line))
    lines[:] = out


def setup(app):
    app.connect("autodoc-process-docstring", _as_rst, priority=1)  # before napoleon
