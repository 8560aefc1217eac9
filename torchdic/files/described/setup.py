"""What a file says of its microscope: aperture, immersion and wavelength, in OME-XML or in a program's own words."""

import dataclasses
import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import tifffile

from torchdic.files.described.bits import texts
from torchdic.files.described.units import micrometres

# Refractive indices of the immersions that OME's schema and others name.
IMMERSIONS = {
    "air": 1.0,
    "dry": 1.0,
    "water": 1.333,
    "waterdipping": 1.333,
    "glycerol": 1.474,
    "glycerin": 1.474,
    "silicone": 1.406,
    "oil": 1.515,
}

# Light of a microscope, in µm; a number beyond is a filter's name or a mistake.
_VISIBLE = (0.3, 1.2)

_NUMBER = r"(\d+(?:[.,]\d+)?)"
_APERTURES = (
    re.compile(
        rf"(?:Lens ?NA|Numerical[ _]?Aperture|Objective[ _]?NA)(?: #\d+)?[\"']?\W{{1,6}}{_NUMBER}", re.IGNORECASE
    ),
    re.compile(r"\d+x ?/ ?([01][.,]\d+)", re.IGNORECASE),  # 63x/1.40 Oil
    re.compile(r"\bNA[ =:]{0,3}([01][.,]\d+)"),
)
_IMMERSED = re.compile(rf"Immersion[^\n]{{0,12}}?\b({'|'.join(IMMERSIONS)})\b", re.IGNORECASE)
_IMMERSED_LENS = re.compile(rf"\d+x[^\n]{{0,24}}?\b({'|'.join(IMMERSIONS)})\b", re.IGNORECASE)
_WAVE = re.compile(rf"(?:Emission|Excitation) ?Wavelength(?: #\d+)?[\"']?\W{{1,6}}{_NUMBER}", re.IGNORECASE)
_PIXEL = re.compile(rf"Pixel[ _]?Size[ _]?um[\"']?\W{{1,4}}{_NUMBER}", re.IGNORECASE)
_STEP = re.compile(rf"z-step[ _]?um[\"']?\W{{1,4}}{_NUMBER}", re.IGNORECASE)
_BITS = re.compile(r"Bit[ _]?Depth[\"']?\W{1,4}(\d{1,2})\b", re.IGNORECASE)


@dataclass(frozen=True)
class StatedSetup:
    """What files say of a microscope and its stack; None where they don't.

    wavelength: in µm. na: of the objective. immersion: its refractive index. objective: its name.
    pixel_size: in µm. focus_step: in µm. bits: of the camera.
    """

    wavelength: float | None = None
    na: float | None = None
    immersion: float | None = None
    objective: str | None = None
    pixel_size: float | None = None
    focus_step: float | None = None
    bits: int | None = None

    def completed(self, other: "StatedSetup") -> "StatedSetup":
        """The same, with the other's values where this one has none."""
        mine, theirs = (dataclasses.asdict(setup) for setup in (self, other))
        return StatedSetup(**{key: theirs[key] if value is None else value for key, value in mine.items()})


def setup_in_tiff(path: Path) -> StatedSetup:
    """What a TIFF says: its OME-XML first, then ImageJ's, Micro-Manager's and other programs' words in it."""
    with tifffile.TiffFile(path) as tif:
        words = setup_in_words("\n".join(texts(tif, tif.pages.first.keyframe)))
        if not tif.is_ome:
            return words
        try:
            root = ElementTree.fromstring(tif.ome_metadata or "")
        except ElementTree.ParseError:
            return words
    return setup_in_ome(root, path).completed(words)


def setup_in_ome(root: ElementTree.Element, path: Path) -> StatedSetup:
    """What OME-XML says of the first image's objective and channel."""
    settings = root.find(".//{*}Image/{*}ObjectiveSettings")
    lenses = root.findall(".//{*}Instrument/{*}Objective")
    used = [lens for lens in lenses if settings is not None and lens.get("ID") == settings.get("ID")]
    lens = next(iter([*used, *lenses]), None)
    channel = root.find(".//{*}Image/{*}Pixels/{*}Channel")
    index = _number(settings.get("RefractiveIndex")) if settings is not None else None
    wavelength = None
    for kind in ("EmissionWavelength", "ExcitationWavelength"):
        if channel is not None and wavelength is None and channel.get(kind):
            wavelength = _light(micrometres(channel.get(kind), channel.get(f"{kind}Unit", "nm"), kind, path))
    if lens is None:
        return StatedSetup(wavelength=wavelength, immersion=index)
    return StatedSetup(
        wavelength=wavelength,
        na=_number(lens.get("LensNA")),
        immersion=index or IMMERSIONS.get((lens.get("Immersion") or "").lower()),
        objective=lens.get("Model"),
    )


def setup_in_words(text: str) -> StatedSetup:
    """What a program's description says, line by line or as JSON."""
    aperture = next((found for pattern in _APERTURES if (found := _first(pattern, text)) is not None), None)
    immersed = _IMMERSED.search(text) or _IMMERSED_LENS.search(text)
    wavelength, bits = _first(_WAVE, text), _first(_BITS, text)
    return StatedSetup(
        wavelength=None if wavelength is None else _light(wavelength / 1000),
        na=aperture,
        immersion=None if immersed is None else IMMERSIONS[immersed[1].lower()],
        pixel_size=_first(_PIXEL, text),
        focus_step=_first(_STEP, text),
        bits=None if bits is None else int(bits),
    )


def setup_of_all(setups: Iterable[StatedSetup]) -> StatedSetup:
    """What several files say together; the first that says a value is believed."""
    known = StatedSetup()
    for setup in setups:
        known = known.completed(setup)
    return known


def _first(pattern: re.Pattern[str], text: str) -> float | None:
    """The first number above 0 that a pattern finds."""
    return next((number for found in pattern.findall(text) if (number := _number(found)) is not None), None)


def _number(text: str | None) -> float | None:
    try:
        number = float((text or "").replace(",", "."))
    except ValueError:
        return None
    return number if 0 < number < float("inf") else None


def _light(wavelength: float | None) -> float | None:
    return wavelength if wavelength is not None and _VISIBLE[0] <= wavelength <= _VISIBLE[1] else None
