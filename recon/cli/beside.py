"""Where results go if the user names no place: beside the input, named after it."""

import os
import re
from pathlib import Path

# What a file of images or a configuration ends with; anything else that looks so may be part of a name: cell_1.4
_SUFFIX = re.compile(r"(\.ome)?\.(tiff?|tf[28]|btf|zarr|nd2|czi|png|jpe?g|toml)$", re.IGNORECASE)
_OTHER = re.compile(r"\.[a-z]{1,5}$", re.IGNORECASE)


def beside(given: Path, ending: str) -> Path:
    """The input's name without its suffix and with another ending, in the folder that holds the input."""
    # of "." and ".." the name is the folder's own
    path = given if given.name not in ("", "..") else Path(os.path.abspath(given))
    return path.with_name(f"{_stem(path)}{ending}") if path.name else path / f"results{ending}"


def _stem(path: Path) -> str:
    """A file's name without its suffixes; a folder's name."""
    stem = _SUFFIX.sub("", path.name)
    if stem == path.name and not path.is_dir():
        stem = _OTHER.sub("", stem)
    return stem or path.name
