"""Values that may be right, but are likely wrong, such as a decimal point in the wrong place: a warning, no refusal."""

import math
from collections.abc import Iterator
from typing import Any

from recon.config.plausible.impossible import numbers_in
from recon.config.schema import Config
from recon.config.spelling import DEGREES
from torchdic.scalar import number

# Light of DIC in µm. From INFRARED on, silicon and germanium are media.
_LIGHT, INFRARED = (0.19, 2.5), 1.0

# The highest index of a medium: of immersion oil (1.78) and more, and in the infrared of germanium (4.0).
_MEDIUM, _INFRARED_MEDIUM = 2.0, 4.2

# The lowest aperture of an objective for DIC.
_LEAST_NA = 0.1

# By how much a condenser's aperture may lie above the objective's: rings are read to some per cent.
_WIDER = 1.05

# Sides of a pixel, and lengths of a shear, over the resolution λ/(2 NA).
_PIXEL, _SHEAR = (1 / 15, 4.0), 4.0

# Images of nothing at all err by their own standard deviation, in whose unit a tolerance is.
_TOLERANCE = 1.0

# Bytes in which not even a small image has room.
_LEAST_MEMORY = 1 << 16

# The greatest |Δn| of what light passes without much loss: of air against glass, with room to spare.
_DIFFERENCE = 1.0


# Angles in degrees that are known by their multiple of π, and how near a number comes that was meant so.
_MULTIPLES = {
    15.0: "π/12", 22.5: "π/8", 30.0: "π/6", 45.0: "π/4", 60.0: "π/3", 67.5: "3π/8", 90.0: "π/2", 120.0: "2π/3",
    135.0: "3π/4", 150.0: "5π/6", 180.0: "π", 270.0: "3π/2", 360.0: "2π",
}  # fmt: skip
_NEAR = 2e-3


def like_radians(angle: float) -> tuple[str, float] | None:
    """The multiple of π in rad that an angle looks like, in words and in degrees; None where it looks like none."""
    for degrees, words in _MULTIPLES.items():
        if abs(abs(angle) - math.radians(degrees)) < _NEAR:
            sign = "−" if angle < 0 else ""
            return f"{sign}{words}", math.copysign(degrees, angle)
    return None


def degrees_in_radians(values: dict[str, Any]) -> Iterator[str]:
    """A line for each angle in degrees that looks as if it were in rad. values: of a file, as TOML holds them."""
    told: set[tuple[str, float]] = set()
    for key, numbers in numbers_in(values):
        name = key.rpartition(".")[2]
        for value in numbers.values() if name.endswith(DEGREES) else ():
            like = like_radians(value)
            if like is not None and (name, abs(value)) not in told:
                told.add((name, abs(value)))
                yield f"{key}: {value:g}° is likely wrong: if {like[0]} rad is meant, that is {like[1]:g}°"


def unlikely(config: Config) -> Iterator[str]:
    """What is likely wrong, a line each, which begins with the key and the value."""
    yield from _light(config)
    yield from _apertures(config)
    yield from _differences(config)
    if config.fidelity is not None and config.fidelity.memory < _LEAST_MEMORY:
        yield (
            f"fidelity.memory: {config.fidelity.memory} bytes is likely wrong: no image has room in them, and the "
            "least is taken, which is slow; 1 GiB is 1073741824"
        )
    if config.tolerance is not None and config.tolerance >= _TOLERANCE:
        yield (
            f"tolerance: {config.tolerance:g} is likely wrong: images of nothing meet it, for it is relative to the "
            f"images' standard deviation; if {config.tolerance:g} % is meant, that is {config.tolerance / 100:g}"
        )
    if config.data is not None:  # a simulation may be as fine as it likes
        yield from _sampling(config)
        yield from _slices(config)
        yield from _without_shear(config)


def _light(config: Config) -> Iterator[str]:
    wavelength, index = config.microscope.wavelength, config.volume.background
    low, high = _LIGHT
    if not low <= wavelength <= high:
        yield f"microscope.wavelength: {wavelength:g} µm is likely wrong: DIC's light has {low:g} to {high:g} µm"
    infrared = wavelength >= INFRARED
    if index > (_INFRARED_MEDIUM if infrared else _MEDIUM):
        where = "in the infrared: that of germanium is 4.0" if infrared else "in visible light: that of oil is 1.52"
        yield f"volume.background: {index:g} is likely wrong: no usual medium has such an index {where}"


def _apertures(config: Config) -> Iterator[str]:
    objective, condenser = config.microscope.objective, config.microscope.condenser
    if config.data is not None and condenser is None:
        yield (
            "microscope.condenser: none is likely wrong: all light would come along the axis; DIC's condensers are "
            "opened to 0.6 to 1 times the objective's NA (condenser = { na = 0 } says that it is shut)"
        )
    if objective is None:
        return
    if objective.na < _LEAST_NA:
        yield f"microscope.objective.na: {objective.na:g} is likely wrong: DIC's objectives have {_LEAST_NA:g} or more"
    if condenser is None or condenser.points is not None:
        return
    na, reach = condenser.limited(config.volume.background).na, objective.na
    if na > _WIDER * reach:
        inner = (condenser.inner_na or 0.0) ** 2
        beside = 1 - max(reach**2 - inner, 0.0) / (na**2 - inner)
        yield (
            f"microscope.condenser.na: {condenser.na:g} is above microscope.objective.na {reach:g}, which is unusual: "
            f"{beside:.0%} of its light passes beside the objective; for DIC a condenser is opened to 0.6 to 1 times "
            "the objective's NA"
        )


def _differences(config: Config) -> Iterator[str]:
    bounds, bead = config.reconstruction.bounds, config.calibration.bead
    for name, value in (("lower", bounds.lower), ("upper", bounds.upper)):
        if value is not None and abs(value) > _DIFFERENCE:
            yield f"reconstruction.bounds.{name}: {value:g} is likely wrong: Δn is rarely beyond ±{_DIFFERENCE:g}"
    contrast = 0.0 if bead is None else bead.index - config.volume.background
    if bead is not None and abs(contrast) > _DIFFERENCE:
        yield (
            f"calibration.bead.index: {bead.index:g} is likely wrong: that is Δn {contrast:+.3g} in a medium of "
            f"{config.volume.background:g}"
        )


def _slices(config: Config) -> Iterator[str]:
    """A slice thicker than the depth of field, and than what the planes of focus span: it lies about all of them."""
    thickness, planes = config.volume.spacing[0], list(map(number, config.acquisition.focus))
    span = max(planes) - min(planes)
    if config.microscope.objective is None or config.volume.shape[0] < 2 or not span:
        return
    reach = config.microscope.objective.reach(config.volume.background)
    depth = config.microscope.wavelength * config.volume.background / reach**2
    if thickness > max(span, depth):
        yield (
            f"volume.slice_thickness (or spacing): {thickness:g} µm is likely wrong: the planes of focus span "
            f"{span:g} µm, and the depth of field is {depth:.2g} µm"
        )


def _without_shear(config: Config) -> Iterator[str]:
    """Prisms whose shear is 0 among others whose isn't: their images show no difference of path."""
    lengths = [None if p is None else math.hypot(*map(number, p.shear)) for p in config.acquisition.prisms]
    for place, length in enumerate(lengths):
        if length == 0 and any(lengths):
            yield (
                f"acquisition.prisms[{place}].shear: 0 is likely wrong among others of {max(filter(None, lengths)):g} "
                "µm: without shear an image has no DIC contrast"
            )


def _sampling(config: Config) -> Iterator[str]:
    """Pixels and shears over the resolution."""
    if config.microscope.objective is None:
        return
    resolution = config.microscope.wavelength / (2 * config.microscope.objective.na)
    what = f"the resolution λ/(2 NA), {resolution:.2g} µm"
    camera, sides = config.microscope.camera, config.volume.spacing[1:]
    key, where = "volume.pixel_size (or spacing)", ""
    if camera is not None and camera.pixel_size is not None:
        key, where = "microscope.camera.pixel_size", " in the specimen"
        sides = camera.pixel_spacing(sides)
    fine, coarse = _PIXEL
    for side in dict.fromkeys(sides):
        if side > coarse * resolution:
            yield f"{key}: {side:g} µm{where} is likely wrong: that is {side / resolution:.0f} times {what}"
        elif side < fine * resolution:
            yield f"{key}: {side:g} µm{where} is likely wrong: that is a {resolution / side:.0f}th of {what}"
    widest = max(config.volume.grid.extent[1:])  # of a longer one `load` warns
    told: set[float] = set()
    for place, prism in enumerate(config.acquisition.prisms):
        length = 0.0 if prism is None else math.hypot(*map(number, prism.shear))
        if _SHEAR * resolution < length <= widest and length not in told:
            told.add(length)
            yield (
                f"acquisition.prisms[{place}].shear: {length:g} µm is likely wrong: that is "
                f"{length / resolution:.0f} times {what}, which it is usually below"
            )
