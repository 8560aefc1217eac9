"""Whether a TIFF is whole: its pages, their tags and their pixels lie inside the file.

tifffile reads a truncated file without a word: it stops at the first missing page and fills missing pixels with zeros.
"""

import math
import os
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, NoReturn

import tifffile

from torchdic.errors import StackError

# TIFF 6.0 and BigTIFF: the bytes that a value of each type takes
_TYPE_BYTES = {16: 8, 17: 8, 18: 8, **dict(enumerate((1, 1, 2, 4, 8, 1, 1, 2, 4, 8, 4, 8, 4), start=1))}

# the first four bytes of a file: its byte order, and whether it is a BigTIFF
_MAGIC = {b"II*\0": ("<", False), b"MM\0*": (">", False), b"II+\0": ("<", True), b"MM\0+": (">", True)}


def check_pages(path: Path) -> None:
    """Follow the chain of pages from the first to the last, and find the end of each tag's values.

    Raises StackError for a file that is no TIFF, has no pages, is truncated, or whose pages form a circle.
    """
    with path.open("rb") as file:
        head = file.read(4)
        if head not in _MAGIC:
            raise StackError(
                f"{path}: is no TIFF: it starts with {head!r}, a TIFF with II or MM and 42 or 43; Fiji saves "
                "as one what it can open: File > Save As > Tiff…"
            )
        order, is_big = _MAGIC[head]
        tiff = _OpenTiff(file, path, os.fstat(file.fileno()).st_size, order, is_big)
        page = tiff.number(8 if is_big else 4, tiff.pointer)
        if page == 0:
            raise StackError(f"{path}: holds no pages; a stack has at least one")
        seen: set[int] = set()
        while page:
            if page in seen:
                raise StackError(f"{path}: its chain of pages runs in a circle after {len(seen)}")
            seen.add(page)
            page = tiff.next_page(page)


@dataclass(frozen=True)
class _OpenTiff:
    """An open TIFF of `size` bytes; `order` is struct's sign for its byte order."""

    file: BinaryIO
    path: Path
    size: int
    order: str
    is_big: bool

    @property
    def pointer(self) -> str:
        """The letter of struct for an offset in the file."""
        return "Q" if self.is_big else "I"

    def next_page(self, page: int) -> int:
        """The offset of the page that follows the one at offset `page`, 0 after the last.

        Raises StackError where the page or the values of its tags lie beyond the end of the file.
        """
        count_form = "Q" if self.is_big else "H"
        tag_form, inline = ("HHQ8s", 8) if self.is_big else ("HHI4s", 4)
        tags = self.number(page, count_form)
        first = page + struct.calcsize(self.order + count_form)
        for _, kind, count, value in struct.iter_unpack(self.order + tag_form, self.read(first, tag_form, tags)):
            length = _TYPE_BYTES.get(kind, 0) * count
            if length > inline:  # then the tag holds the offset of its values, not the values
                end = struct.unpack(self.order + self.pointer, value)[0] + length
                if end > self.size:
                    _raise_truncated(self.path, end, self.size)
        return self.number(first + tags * struct.calcsize(self.order + tag_form), self.pointer)

    def number(self, offset: int, form: str) -> int:
        """The integer at an offset; `form` is its letter of struct."""
        return struct.unpack(self.order + form, self.read(offset, form))[0]

    def read(self, offset: int, form: str, times: int = 1) -> bytes:
        """The bytes at an offset of `times` values; `form` is a value's letters of struct."""
        length = struct.calcsize(self.order + form) * times
        if offset + length > self.size:
            _raise_truncated(self.path, offset + length, self.size)
        self.file.seek(offset)
        return self.file.read(length)


def check_pixels(tif: tifffile.TiffFile, series: tifffile.TiffPageSeries, path: Path) -> None:
    """Raise StackError where a strip or tile of a page is missing or lies beyond the end of the file."""
    size = tif.filehandle.size
    if series.dataoffset is not None:
        end = series.dataoffset + math.prod(series.get_shape(squeeze=False)) * series.dtype.itemsize
        if end > size:
            _raise_truncated(path, end, size)
    for page in tif.pages:
        for offset, count in zip(page.dataoffsets, page.databytecounts, strict=True):
            if offset == 0 or count == 0:
                raise StackError(f"{path}: page {page.index} misses a part of its pixels")
            if offset + count > size:
                _raise_truncated(path, offset + count, size)
    if series.dataoffset is None:
        _check_planes(tif, series, path)


def _check_planes(tif: tifffile.TiffFile, series: tifffile.TiffPageSeries, path: Path) -> None:
    """Raise StackError where a plane of a series is missing, or lies in another file that ends before it."""
    missing = sum(page is None for page in series)
    if missing:
        raise StackError(f"{path}: {missing} of {len(series)} planes that it lists are missing")
    for page in series:
        if page is not None and page.parent is not tif:
            size = page.parent.filehandle.size
            end = max(o + c for o, c in zip(page.dataoffsets, page.databytecounts, strict=True))
            if end > size:
                _raise_truncated(path.parent / page.parent.filename, end, size)


def _raise_truncated(path: Path, end: int, size: int) -> NoReturn:
    raise StackError(f"{path}: truncated: its contents reach to byte {end}, the file ends at byte {size}")
