"""Pages whose values are grey, and grow with the light."""

from pathlib import Path

import numpy as np
import tifffile

from torchdic.errors import StackError

_GREY, _PALETTE = 1, 3  # PhotometricInterpretation: the value grows with the light; the value is a palette's place

_PHOTOMETRIC = {0: "0 is white", 2: "RGB", 3: "a colour palette", 5: "CMYK", 6: "YCbCr", 8: "CIELab"}


def coloured(path: Path, samples: int, *, apart: bool = False) -> StackError:
    """The error for a colour image. samples: per pixel. apart: whether each has a plane of its own."""
    planes = "; if these are planes, write them with photometric='minisblack' of tifffile.imwrite" if apart else ""
    return StackError(
        f"{path}: is a colour image, {samples} samples per pixel; a stack is grey: in Fiji, Image > Type > 16-bit, or "
        f"Image > Color > Split Channels and the channel of the light's colour, then File > Save As > Tiff…{planes}"
    )


def check_grey(page: tifffile.TiffPage, path: Path) -> None:
    """Raise StackError where a page is coloured, or where its values do not grow with the light."""
    if page.samplesperpixel > 1:
        raise coloured(path, page.samplesperpixel, apart=page.planarconfig == tifffile.PLANARCONFIG.SEPARATE)
    if "PhotometricInterpretation" in page.tags and page.photometric not in (_GREY, _PALETTE):
        _refuse(page, path)


def has_palette(page: tifffile.TiffPage) -> bool:
    """Whether a page's values are places in a palette."""
    return "PhotometricInterpretation" in page.tags and page.photometric == _PALETTE


def greys_of_palette(data: np.ndarray, pages: list[tifffile.TiffPage], path: Path) -> np.ndarray:
    """The grey values that the palette gives, in 8 bits where they are enough.

    data: places in the palette, of any shape. pages: those from which they come.
    Raises StackError where the palette has a colour that the pixels use, has one grey alone, or changes between pages.
    """
    palettes = [page.colormap for page in pages if page.colormap is not None]
    if not palettes:
        raise StackError(f"{path}: is not greyscale (its palette is missing); a stack's values grow with the light")
    palette = palettes[0]
    if any(not np.array_equal(palette, other) for other in palettes[1:]):
        raise StackError(f"{path}: its pages have different palettes; a stack has one scale of grey")
    used = np.unique(data)
    if int(used[-1]) >= palette.shape[1]:
        raise StackError(f"{path}: a pixel is {used[-1]}, its palette has {palette.shape[1]} entries")
    shades = palette[:, used]
    if (shades != shades[0]).any() or len(np.unique(palette)) == 1:
        _refuse(pages[0], path)
    greys = palette[0].astype(np.uint16)
    for factor in (257, 256):  # how writers stretch 8 bits to the 16 of a palette
        if not (greys % factor).any():
            return (greys // factor).astype(np.uint8)[data]
    return greys[data]


def _refuse(page: tifffile.TiffPage, path: Path) -> None:
    kind = _PHOTOMETRIC.get(int(page.photometric), f"photometric interpretation {int(page.photometric)}")
    grey = "; in Fiji, Image > Lookup Tables > Grays makes it one" if page.photometric == _PALETTE else ""
    raise StackError(f"{path}: is not greyscale ({kind}); a stack's values grow with the light{grey}")
