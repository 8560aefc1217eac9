"""The site: `make docs`. The reference is made first, from the code; the blocks of all pages are checked.

Sphinx, because its autodoc reads our docstrings, MyST the pages that are read on a code host too, and sphinx-gallery
runs the examples; pydata's theme, because it is that of NumPy, SciPy and scikit-image, and needs no network.
"""

import os
import sys
from pathlib import Path

DOCS = Path(__file__).parent
sys.path.insert(0, str(DOCS))
sys.path.insert(0, str(DOCS.parent))  # a checkout's packages go before installed ones
os.environ["OMP_NUM_THREADS"] = os.environ.get("OMP_NUM_THREADS", "1")
os.environ["TQDM_DISABLE"] = "1"  # bars of progress are no output of the gallery's scripts

from generator import blocks, commands, gallery, keys, names, notebooks  # noqa: E402
from generator.autodoc import describe  # noqa: E402

import torchdic  # noqa: E402

project, author, release = "torchdic", "The torchdic developers", torchdic.__version__
project_copyright = f"{author}, BSD-3-Clause"
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx_gallery.gen_gallery"]
exclude_patterns = ["_build", "generator", "gallery/*.ipynb", "gallery/*.py", "sg_execution_times.rst"]
myst_heading_anchors = 4
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
python_maximum_signature_line_length = 88
python_use_unqualified_type_names = True

html_theme = "pydata_sphinx_theme"
html_title = "torchdic"
html_theme_options = {"show_prev_next": True, "navigation_with_keys": False, "secondary_sidebar_items": ["page-toc"]}
html_static_path, html_css_files = ["_static"], ["site.css"]
# pages without others beside them have nothing to show there
html_sidebars = {page: [] for page in ("install", "own_stack", "simulate", "reconstruct", "accuracy", "concepts")}
html_show_sourcelink = False

sphinx_gallery_conf = {
    "examples_dirs": str(gallery.SCRIPTS),
    "gallery_dirs": "gallery",
    "copyfile_regex": r"index\.rst",
    "filename_pattern": gallery.runs(os.environ.get(gallery.DATA)),
    "minigallery_sort_order": "generator.gallery.place",
    "backreferences_dir": "generated/examples",
    "abort_on_example_error": True,
    "show_memory": False,
    "write_computation_times": False,
    "remove_config_comments": True,
}


def make_reference(*_: object) -> None:
    """Write the pages of the reference, where they have changed."""
    folder = DOCS / "generated"
    folder.mkdir(exist_ok=True)
    for name, page in (("keys", keys.page), ("commands", commands.page), ("names", names.page)):
        path, text = folder / f"{name}.md", page()
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")


def setup(app) -> None:
    """What Sphinx calls before it reads the pages."""
    app.connect("builder-inited", make_reference, priority=100)
    app.connect("builder-inited", blocks.check_all, priority=200)
    app.connect("builder-inited", notebooks.execute_all, priority=900)  # after sphinx-gallery, which makes them
    app.connect("autodoc-process-docstring", describe)
