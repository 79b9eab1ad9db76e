"""How Sphinx builds the documentation: `make docs`, offline, every example executed."""

import os
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

from elsewhere import write_inventories

import clresample

project = "clresample"
author = "The clresample developers"
version = release = clresample.__version__
copyright = author

extensions = [
    *("myst_nb", "sphinx.ext.autodoc", "sphinx.ext.intersphinx", "sphinx-mathjax-offline"),
    "docstrings",
]
intersphinx_mapping = write_inventories(Path(__file__).parent / "_build" / "inventories")
exclude_patterns = ["_build"]
myst_enable_extensions = ["dollarmath", "deflist", "colon_fence"]
myst_heading_anchors = 3
default_role = "py:obj"
add_module_names = False
autodoc_member_order = "bysource"
autodoc_typehints = "none"
autodoc_class_signature = "mixed"
toc_object_entries = False

# Examples run when the pages are built; an error in one is an error of the build.
nb_execution_mode = "force"
nb_execution_raise_on_error = True
nb_execution_timeout = 300  # [s] for one cell; the slowest compiles kernels
nb_execution_in_temp = True  # examples write files
nb_execution_show_tb = True
nb_merge_streams = True
os.environ["PATH"] = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"

html_theme = "furo"
html_title = f"clresample {release}"
html_static_path = ["_static"]
html_css_files = ["clresample.css"]
html_theme_options = {
    "light_css_variables": {"color-brand-primary": "#0b5c8a", "color-brand-content": "#0b5c8a"},
    "dark_css_variables": {"color-brand-primary": "#7fc8f0", "color-brand-content": "#7fc8f0"},
}
