"""Values that can't be: in a wrong unit, such as nm for µm or degrees for rad, or an index of no medium."""

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from recon.config.spelling import ANGLES, DEGREES

# Factors to µm of the units in which lengths are given by mistake, in the order in which they are tried.
_LENGTHS = {"nm": 1e-3, "m": 1e6, "mm": 1e3}

# A rounded full turn is still one.
_TURN = 6.29

# A specimen that is larger than the volume by this factor isn't in it, nor is a focus that is as far away.
_BEYOND = 10


@dataclass(frozen=True)
class _Plausible:
    """The sizes that a quantity can have, in µm, rad or without unit; 0 is none of a size.

    keys: a regular expression of the keys that hold the quantity. what: its name. each: whether each number of an array
    has to reach the lowest size, or the largest of them alone. likely: what it is usually below, where it has no unit.
    """

    keys: str
    what: str
    lowest: float
    highest: float
    unit: str = "µm"
    each: bool = False
    likely: float = math.inf

    def problem(self, key: str, numbers: dict[str, float]) -> str | None:
        """What is wrong with a key's numbers, each with its place in the key; None where they may be right."""
        largest = max(map(abs, numbers.values()))
        for place, number in numbers.items():
            size = abs(number)
            tiny = 0 < size < self.lowest and (self.each or largest < self.lowest)
            if tiny or size > self.highest:
                meant = self._meant(number, key)
                return f"{key}{place}: {_with(number, self.unit)} is no {self.what} {self._limits()}{meant}"
        return None

    def _limits(self) -> str:
        if self.lowest == 0:
            return f"(at most {_with(self.highest, self.unit)})"
        return f"({self.lowest:g} to {_with(self.highest, self.unit)})"

    def _meant(self, number: float, key: str) -> str:
        if self.unit == "°":
            return ""
        if not self.unit:
            slipped = next((number / ten for ten in _SLIPS if abs(number) / ten < self.likely), None)
            return "" if slipped is None else f"; is the decimal point in the wrong place? {slipped:.6g} would do"
        if self.unit == "rad":
            last = key.rpartition(".")[2]
            other = f", or {last}{DEGREES} = {number:g}" if last in ANGLES else ""
            return f"; angles are in rad: {number:g}° are {math.radians(number):.5g} rad{other}"
        for unit, factor in _LENGTHS.items():
            if self.lowest <= abs(number) * factor <= self.highest:
                return f"; lengths are in µm: {number:g} {unit} are {number * factor:.6g} µm"
        return "; lengths are in µm"


def _with(number: float, unit: str) -> str:
    return f"{number:g}{unit}" if unit == "°" else f"{number:g} {unit}".rstrip()


# The highest index of a transparent medium, with room above germanium's 4.0 and lead telluride's 5.7; the greatest
# difference of two; and by what factors a decimal point slips.
HIGHEST, DIFFERENCE, _SLIPS = 6.0, 5.0, (10, 100, 1000)

_PRISM = r"acquisition\.prisms\[\d+\]\."

_QUANTITIES = (
    _Plausible(
        rf"microscope\.wavelength|microscope\.spectrum\.wavelengths|{_PRISM}wavelength",
        "wavelength of light",
        0.01,
        20,
        each=True,
    ),
    _Plausible(r"volume\.(spacing|slice_thickness)", "size of a voxel", 1e-3, 100, each=True),
    _Plausible(r"microscope\.camera\.pixel_size", "size of a pixel", 1e-3, 100),
    _Plausible("z_step", "distance between focus planes", 1e-3, 100),  # an option of `torchdic new`
    _Plausible(rf"{_PRISM}shear(\.length)?", "shear", 1e-4, 20),
    _Plausible(rf"{_PRISM}({'|'.join(ANGLES)}|shear\.angle){DEGREES}", "angle of at most a turn", 0, 360, "°"),
    _Plausible(rf"{_PRISM}focal_length", "focal length of an objective", 100, 1e6),
    _Plausible(rf"{_PRISM}offset", "offset of a prism", 1e-4, 1e5),
    _Plausible(r"microscope\.objective\.layer\.(thickness|depth)", "thickness of a layer", 1e-3, 1e4),
    _Plausible(r"fidelity\.reference_plane", "depth in a volume", 1e-4, 1e3),
    _Plausible(rf"{_PRISM}wedge", "angle of a wedge", 0, 1, "rad"),
    _Plausible(
        rf"{_PRISM}(bias|polariser|axis)|microscope\.polarisation\.(analyser_error|retardance_error)"
        r"|microscope\.polarisation\.pupil\.retardance\.\d+",
        "phase or angle of at most a turn",
        0,
        _TURN,
        "rad",
    ),
    _Plausible(r"microscope\.objective\.aberrations\.\d+", "aberration of a lens", 0, 60, "rad"),
    _Plausible(
        r"(volume|specimen)\.background|calibration\.bead\.index|microscope\.objective\.layer\.(index|design_index)"
        r"|microscope\.objective\.layer\.(medium|design)",
        "refractive index of a transparent medium",
        0,
        HIGHEST,
        "",
        likely=2.0,
    ),
    _Plausible(
        r"reconstruction\.bounds\.(lower|upper)|specimen\.(.*\.)?contrast",
        "difference of two refractive indices",
        0,
        DIFFERENCE,
        "",
        likely=1.0,
    ),
)

# A pixel may be coarse, but not as coarse as a slice.
_LATERAL = _Plausible("", "size of a pixel", 1e-3, 20, each=True)

_OF_SPECIMENS = (
    r"specimen\.(sigma|radius|centre|height|offset|surface|edge|period|bottom|axis|.*semi_axes|.*\.centre)"
    r"|calibration\.bead\.radius"
)


def impossible(values: dict[str, Any]) -> str | None:
    """What is wrong with the first value that can't be, with its key and what may be meant, or None.

    values: of a configuration file, as TOML holds them. Values of a wrong type are passed over.
    """
    known = dict(numbers_in(values))
    quantities = (*_QUANTITIES, _focus(known), *_of_the_specimen(known))
    for key, numbers in known.items():
        if key in ("volume.spacing", "volume.pixel_size"):
            lateral = {place: n for place, n in numbers.items() if key != "volume.spacing" or place in ("[1]", "[2]")}
            if lateral and (problem := _LATERAL.problem(key, lateral)):
                return problem
        for quantity in quantities:
            if re.fullmatch(quantity.keys, key) and (problem := quantity.problem(key, numbers)):
                return problem
    return None


def _focus(known: dict[str, dict[str, float]]) -> _Plausible:
    """How far a focus may lie from the centre: not many times the volume's depth or the depth of field."""
    wavelength, aperture = (known.get(f"microscope.{name}", {}).get("", 0) for name in ("wavelength", "objective.na"))
    field = wavelength / aperture**2 if wavelength > 0 and aperture > 0 else math.inf
    furthest = max(_BEYOND * max(_extent(known)[:1], default=0), 2 * _BEYOND * field, 50)
    return _Plausible(r"acquisition\.focus(\.first|\.step)?", "focus in this volume", 1e-4, min(furthest, 1e4))


def _of_the_specimen(known: dict[str, dict[str, float]]) -> list[_Plausible]:
    """How large a specimen may be: it lies in the volume. An empty list where the volume isn't one."""
    extent = _extent(known)
    if not extent:
        return []
    return [_Plausible(_OF_SPECIMENS, "length of a specimen in this volume", 1e-4, max(_BEYOND * max(extent), 50))]


def _extent(known: dict[str, dict[str, float]]) -> list[float]:
    """The volume's size (z, y, x) in µm; an empty list where it has none."""
    shape, spacing, pixel, thickness = (
        list(known.get(f"volume.{name}", {}).values()) for name in ("shape", "spacing", "pixel_size", "slice_thickness")
    )
    sides = spacing or [*thickness, *(pixel * 2)[:2]]
    return [n * d for n, d in zip(shape, sides, strict=True)] if len(shape) == len(sides) == 3 else []


def numbers_in(value: Any, key: str = "") -> Iterator[tuple[str, dict[str, float]]]:
    """Each key with its number, or with the numbers of its array by their place in it."""
    if isinstance(value, dict):
        for name, below in value.items():
            yield from numbers_in(below, f"{key}.{name}" if key else name)
    elif isinstance(value, list) and any(isinstance(below, dict) for below in value):
        for index, below in enumerate(value):
            yield from numbers_in(below, f"{key}[{index}]")
    else:
        array = {f"[{i}]": below for i, below in enumerate(value)} if isinstance(value, list) else {"": value}
        found = {place: float(number) for place, number in array.items() if _is_finite_number(number)}
        if found:
            yield key, found


def _is_finite_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
