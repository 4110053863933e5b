"""Sphinx configuration of mavsitl's documentation."""

from __future__ import annotations

import sys
from pathlib import Path

import mavsitl

sys.path.insert(0, str(Path(__file__).parent / "_ext"))

project = "mavsitl"
author = "the mavsitl developers"
copyright = "the mavsitl developers, Apache-2.0"  # noqa: A001 (Sphinx's own name)
version = release = mavsitl.__version__

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "docstrings",
    "generated",
    "equations",
    "flight",
]
myst_enable_extensions = ["colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 3
exclude_patterns = ["_build", "_ext"]
nitpicky = True
nitpick_ignore_regex = [
    ("py:.*", ".*")
]  # types of signatures: most are other libraries', and no network is asked for them
napoleon_use_ivar = True
highlight_language = "none"  # of blocks without one: formulae of docstrings
default_role = "code"  # single backticks of docstrings
autodoc_type_aliases = {
    name: name for name in ("Array", "Counts", "Floats", "Quaternion", "Record", "Tables", "Vector")
}
autodoc_member_order = "bysource"
autodoc_class_signature = "separated"
autodoc_typehints_format = "short"
smartquotes = False  # quoted values are TOML

html_theme = "furo"
html_title = f"mavsitl {release}"
html_show_sourcelink = False
