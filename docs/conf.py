"""The documentation site: ``make docs`` builds it into build/docs. Its Markdown pages are those that GitHub shows."""

from __future__ import annotations

import sys
from pathlib import Path

from hudepth import __version__

sys.path.insert(0, str(Path(__file__).parent / "_site"))

project = "hudepth"
author = "The hudepth authors"
project_copyright = author
release = version = __version__

extensions = [
    "myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx_copybutton", "option_tables",
    "link_check", "repository_links", "signatures",
]  # fmt: skip
exclude_patterns = ["README.md", "_site"]
nitpicky = True
# the inventories of other projects are on the network; every other name must be found
EXTERNAL = r"(abc|collections|jaxtyping|lightning|numpy|pathlib|PIL|re|torch|torchmetrics)\..*|Figure|Tensor|ndarray"
nitpick_ignore_regex = [("py:.*", EXTERNAL)]

# Markdown
myst_heading_anchors = 3

# Notebooks
nb_execution_mode = "force"
nb_execution_show_tb = True  # a failure is a warning with its traceback; make docs makes it an error
nb_execution_timeout = 600  # of a cell [s]: machines that build it may be busy
nb_output_stderr = "remove"
nb_merge_streams = True

# Docstrings
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
napoleon_google_docstring, napoleon_numpy_docstring = True, False
python_maximum_signature_line_length = 88
add_module_names = False
toc_object_entries_show_parents = "hide"

# Pages
highlight_language = "none"
html_theme = "pydata_sphinx_theme"
html_title = "hudepth"
html_static_path = ["_site/static"]
templates_path = ["_site/templates"]
html_css_files = ["site.css"]
html_copy_source = False
html_show_sourcelink = False
html_context = {"default_mode": "auto"}
html_sidebars = {"**": ["all-pages"]}
html_theme_options = {
    "navbar_center": [],
    "navbar_align": "left",
    "secondary_sidebar_items": ["page-toc"],
    "footer_start": ["copyright"],
    "footer_end": [],
    "show_prev_next": True,
    "show_toc_level": 2,
}
