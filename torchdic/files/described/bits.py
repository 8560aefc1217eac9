"""A camera's bit depth, as programs state it in a TIFF."""

import re

import tifffile

# OME's SignificantBits, Micro-Manager's BitDepth, MetaMorph's camera-bit-depth, HCImage's vBitsPerChannel and others:
# the name, some signs without digits, the number
_STATED = re.compile(
    r"(?:significant[ _-]?bits|bit[ _-]?depth|bits[ _-]?per[ _-]?(?:channel|pixel|sample))[^0-9\n<>]{0,24}?(\d{1,2})\b",
    re.IGNORECASE,
)
_LARGEST = ("MaxSampleValue", "SMaxSampleValue")  # TIFF 6.0, tags 281 and 341

_MICRO_MANAGER = 51123  # the tag that holds the metadata of a page


def stated_bits(tif: tifffile.TiffFile, page: tifffile.TiffPage) -> list[int]:
    """All bit depths that the file states, smallest first, below that of the pixels themselves, which tells nothing."""
    found = [page.bitspersample] if isinstance(page.bitspersample, int) else []
    for text in texts(tif, page):
        found += [int(bits) for bits in _STATED.findall(text)]
    for name in _LARGEST:
        largest = page.tags.valueof(name)
        if isinstance(largest, int | float) and float(largest).is_integer() and _is_all_ones(int(largest)):
            found.append(int(largest).bit_length())
    size = 0 if page.dtype is None else 8 * page.dtype.itemsize
    return sorted({bits for bits in found if 0 < bits < size})


def texts(tif: tifffile.TiffFile, page: tifffile.TiffPage) -> list[str]:
    """What programs wrote about the file and one of its pages: descriptions, ImageJ's Info, Micro-Manager's tags."""
    first = tif.pages.first
    values = [page.description, first.description, (tif.imagej_metadata or {}).get("Info")]
    values += [part.tags.valueof(_MICRO_MANAGER) for part in (page, first)]
    values.append((tif.micromanager_metadata or {}).get("Summary"))
    return [str(value) for value in values if value is not None]


def _is_all_ones(number: int) -> bool:
    return number > 0 and number & (number + 1) == 0
