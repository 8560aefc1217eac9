"""The gallery: in which order its scripts stand, and which of them are run.

Its page, `experiments/gallery/index.rst`, lists the scripts twice in each section: as pictures, and as pages.
"""

from pathlib import Path

SCRIPTS = Path(__file__).parents[2] / "experiments" / "gallery"
PAGE = (SCRIPTS / "index.rst").read_text(encoding="utf-8")

# The variable that names the folder of measured data; a script that has it in its text reads them.
DATA = "TORCHDIC_DATA"


def place(path: str) -> int:
    """Where the page names a script: the key by which sphinx-gallery sorts the pictures."""
    return PAGE.index(f"/{Path(path).name}\n")


def runs(data: str | None) -> str:
    """A pattern of the scripts that are run. data: folder of measured data; without it those that read them aren't."""
    names = [path.stem for path in SCRIPTS.glob("*.py") if data or DATA not in path.read_text(encoding="utf-8")]
    return rf"[/\\]({'|'.join(sorted(names))})\.py$"
