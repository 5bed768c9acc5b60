"""How the site is built: `python -m sphinx -W .site build/site`, with `-D plot_gallery=0` without running the examples.

What is not in docstrings, README.md, CHANGELOG.md, bench/RESULTS.md, bench/HISTORY.md, .github/CONTRIBUTING.md and examples/ is
on the pages beside this file. `building/` turns those sources into pages under `generated/`, which no one edits.
"""

import sys
import tomllib
from pathlib import Path

from sphinx_gallery.sorting import FileNameSortKey

SITE = Path(__file__).parent
ROOT = SITE.parent
sys.path[:0] = [str(SITE), str(ROOT)]

project = "torchsfm"
author = "The torchsfm developers"
project_copyright = author
release = version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
language = "en"

extensions = [
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "myst_parser",
    "sphinx_gallery.gen_gallery",
    "building.extension",
]
exclude_patterns = [
    "generated/examples/**",
    "generated/pages/parts/**",
    "generated/gallery/**/*.ipynb",
    "generated/gallery/**/*.py",
]
suppress_warnings = ["config.cache"]

# Docstrings write names and formulas between single backticks, as Markdown does.
default_role = "code"
autodoc_member_order = "bysource"
autodoc_default_options = {"members": True}
autodoc_typehints_format = "short"
python_maximum_signature_line_length = 96
autosummary_generate = False
napoleon_numpy_docstring = False
napoleon_use_ivar = False
napoleon_use_rtype = False

myst_enable_extensions = ["dollarmath", "colon_fence", "deflist"]
myst_heading_anchors = 3

sphinx_gallery_conf = {
    "examples_dirs": [str(SITE / "generated" / "examples")],
    "gallery_dirs": ["generated/gallery"],
    "backreferences_dir": "generated/backreferences",
    "doc_module": ("torchsfm",),
    "filename_pattern": r"\.py$",
    "within_subsection_order": FileNameSortKey,
    "reset_modules": ("matplotlib", "building.examples.forget"),
    "default_thumb_file": str(ROOT / "examples" / "fountain.png"),
    "download_all_examples": False,
    "remove_config_comments": True,
    "min_reported_time": 1e9,
    "show_memory": False,
    "show_signature": False,
    "write_computation_times": False,
    "abort_on_example_error": True,
    "capture_repr": (),  # what is printed is shown, and not what a cell's last line returns
    "matplotlib_animations": False,
}

html_math_renderer = "mathml"
html_theme = "furo"
html_title = f"torchsfm {release}"
html_static_path = ["static"]
html_favicon = "static/favicon.svg"
html_css_files = ["site.css"]
html_show_sphinx = False
html_copy_source = False
