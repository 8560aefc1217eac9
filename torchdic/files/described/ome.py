"""OME-XML: sizes, the prisms' names, and in which files the planes lie."""

import warnings
from pathlib import Path
from xml.etree import ElementTree

import tifffile

from torchdic.errors import StackError, StackWarning
from torchdic.files.described.units import micrometres
from torchdic.files.tiff_structure import check_pages

Sizes = tuple[float | None, float | None, float | None]  # focus step and pixel size (z, y, x) in µm


def parsed(tif: tifffile.TiffFile, path: Path) -> ElementTree.Element:
    """The OME-XML of a file. Raises StackError where it cannot be parsed or describes no image."""
    try:
        root = ElementTree.fromstring(tif.ome_metadata or "")
    except ElementTree.ParseError as error:
        raise StackError(f"{path}: its OME-XML cannot be parsed: {error}") from error
    binary = root.find("{*}BinaryOnly")
    if binary is not None:
        other = binary.get("MetadataFile", "another file")
        raise StackError(f"{path}: is one part of a multi-file OME-TIFF, which {other} describes; a stack is one file")
    if root.find(".//{*}Image/{*}Pixels") is None:
        raise StackError(f"{path}: its OME-XML describes no image")
    return root


def sizes_and_names(root: ElementTree.Element, path: Path, series: int = 0) -> tuple[Sizes, tuple[str, ...]]:
    """Focus step and pixel size (z, y, x) in µm, and the prisms' names, of an image; None and () where it has none."""
    images = root.findall(".//{*}Image/{*}Pixels")
    pixels = images[min(series, len(images) - 1)]
    z, y, x = (
        micrometres(
            pixels.get(f"PhysicalSize{axis}"), pixels.get(f"PhysicalSize{axis}Unit", "µm"), f"PhysicalSize{axis}", path
        )
        for axis in "ZYX"
    )
    names = tuple(channel.get("Name", "") for channel in pixels.findall("{*}Channel"))
    return (z, y, x), names if any(names) else ()


def warn_of_guessed_axes(root: ElementTree.Element, path: Path) -> None:
    """Warn StackWarning where the axes of a stack with as many prisms as planes may be no one's choice.

    tifffile names the axes of an array (Z, C, y, x) where its user names none. A stack of (prism, focus, y, x) that was
    written so is transposed, and nothing else can tell.
    """
    pixels = root.find(".//{*}Image/{*}Pixels")
    if pixels is None or not root.get("Creator", "").startswith("tifffile"):
        return
    planes, prisms = pixels.get("SizeZ"), pixels.get("SizeC")
    if pixels.get("DimensionOrder") == "XYCZT" and planes == prisms != "1":
        warnings.warn(
            f"{path}: its axes are Z, C, y, x, as tifffile writes them where none is named: Z ({planes}) is taken as "
            f"the focus and C ({prisms}) as the prism; metadata={{'axes': 'CZYX'}} writes them the other way round",
            StackWarning,
            stacklevel=4,
        )


def has_places(root: ElementTree.Element) -> bool:
    """Whether the images were recorded at more than one place of the stage."""
    images = root.findall("{*}Image")
    planes = [image.find("{*}Pixels/{*}Plane") for image in images]
    places = {(plane.get("PositionX"), plane.get("PositionY")) for plane in planes if plane is not None}
    labels = {label.get("Name") for label in (image.find("{*}StageLabel") for image in images) if label is not None}
    return len(places) > 1 or len(labels) > 1


def find_planes(tif: tifffile.TiffFile, root: ElementTree.Element, path: Path) -> None:
    """Let tifffile find the planes in this file although it was renamed, and in the files beside it.

    A file that holds its whole stack may be named otherwise in its own XML. Then the names are taken out of the XML
    that tifffile reads. Raises StackError where planes lie in files that are missing.
    """
    parts = root.findall(".//{*}TiffData/{*}UUID")
    foreign = [part for part in parts if not _is_own(part, root.get("UUID"), path.name)]
    if not foreign:
        return
    one = len({(part.text, part.get("FileName")) for part in parts}) == 1
    if one and root.get("UUID") is None:
        for data in root.iter():
            for part in data.findall("{*}UUID"):
                data.remove(part)
        tif.pages.first.description = ElementTree.tostring(root, encoding="unicode")
        return
    others = sorted({part.get("FileName", "?") for part in foreign})
    missing = [name for name in others if not (path.parent / name).is_file()]
    if missing:
        shown = ", ".join(missing[:3]) + (", …" if len(missing) > 3 else "")
        verb = "is" if len(missing) == 1 else "are"
        raise StackError(f"{path}: some of its planes lie in other files, of which {shown} {verb} missing beside it")
    for name in others:
        check_pages(path.parent / name)


def _is_own(part: ElementTree.Element, own: str | None, name: str) -> bool:
    """Whether a plane lies in the file whose identity (None where it has none) and name are given."""
    if own and part.text:
        return part.text.strip().lower() == own.strip().lower()
    return part.get("FileName", name).lower() == name.lower()
