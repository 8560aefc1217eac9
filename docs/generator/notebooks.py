"""Notebooks of the gallery that hold what they print and draw."""

import os
import re
from pathlib import Path

import nbformat
from nbclient import NotebookClient

from generator.gallery import PAGE

ROOT = Path(__file__).parents[2]
MADE = ROOT / "docs" / "gallery"

INLINE = "module://matplotlib_inline.backend_inline"


def execute_all(*_: object) -> None:
    """Execute the notebooks that the gallery's page offers so, where sphinx-gallery has made them anew.

    Raises nbclient's CellExecutionError for one that fails.
    """
    for name in re.findall(r"<executed/(\w+)\.ipynb>", PAGE):
        made, executed = MADE / f"{name}.ipynb", MADE / "executed" / f"{name}.ipynb"
        if executed.exists() and executed.stat().st_mtime >= made.stat().st_mtime:
            continue
        notebook = nbformat.read(made, as_version=4)
        where, quiet = {"metadata": {"path": str(ROOT)}}, ["--log-level=ERROR"]
        NotebookClient(notebook, resources=where, extra_arguments=quiet).execute(
            env={**os.environ, "MPLBACKEND": INLINE}
        )
        executed.parent.mkdir(exist_ok=True)
        nbformat.write(notebook, executed)
