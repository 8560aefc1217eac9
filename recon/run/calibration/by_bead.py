"""Values from a stack of a bead of known size and index."""

import cmath
import math
from dataclasses import replace

import torch
from torch import Tensor

from recon.calibration.known_specimen import PLANES, ModelledSpecimen, OpticsFound, calibrate
from recon.calibration.optics import firsts_of
from recon.config.schema import BeadSection, Config, ConfigError
from recon.fit.setup import Setup, empty_medium
from recon.run.calibration.found import DIRECTION, FoundQuantity, Value, plain, rounded, rounded_angle, rounded_shear
from recon.run.calibration.stack import CalibrationStack
from recon.run.data import camera_pixels
from torchdic import Acquisition
from torchdic.scalar import number

# The least size of the field over the bead's.
ROOM = 1.2

# A fit that leaves more than this many times the noise's misfit, and this share of the contrast, isn't explained.
POOR, LEAST = 1.5, 0.02

# What slabs and directions move the aperture's logarithm by, as measured on known scenes.
MODEL_APERTURE = 5e-3

# A bias that is as uncertain as this, in rad, is said to be.
UNSURE = math.radians(5)


def by_bead(
    stack: CalibrationStack, bead: ModelledSpecimen, section: BeadSection
) -> tuple[CalibrationStack, list[FoundQuantity]]:
    """The stack with what its bead tells of the optics, and each quantity.

    Raises ConfigError where the bead isn't found in the field.
    """
    config, data = stack.config, stack.data
    medium = empty_medium(config.volume.grid, config.volume.background, data)
    setup, terms = Setup(medium, config.microscope, config.acquisition), config.calibration.aberrations
    print(f"the optics behind the bead, by {len(data)} × {min(data.shape[1], PLANES)} of its images …", flush=True)
    try:
        found = calibrate(data, setup, bead, stack.noise, stack.mask, terms)
    except ValueError as error:
        raise ConfigError(f"calibration.bead: {error}") from error
    return stack.with_config(_calibrated(config, found)), _quantities(config, found)


def check_bead(config: Config, section: BeadSection) -> None:
    """Raise ConfigError where the field is no larger than the bead, or where aberrations are sought of no objective."""
    extent = min(camera_pixels(config).extent[1:])
    if extent < ROOM * 2 * section.radius:
        raise ConfigError(
            f"calibration.bead.radius: {section.radius:g} µm is too large for a field of {extent:g} µm: "
            "the images must show the bead and some of the medium around it"
        )
    terms = list(config.calibration.aberrations)
    if terms and config.microscope.objective is None:
        raise ConfigError(f"calibration.aberrations: {terms} are of an objective, and microscope.objective isn't given")


def _calibrated(config: Config, found: OpticsFound) -> Config:
    """The configuration with the optics that were found."""
    acquisition, microscope = found.setup.acquisition, found.setup.microscope
    prisms = [
        None if prism is None else replace(rounded_shear(prism), bias=rounded_angle(prism.bias))
        for prism in acquisition.prisms
    ]
    condenser, objective = config.microscope.condenser, config.microscope.objective
    if condenser is not None and microscope.condenser is not None and condenser.points is None:
        inner = microscope.condenser.inner_na
        condenser = replace(
            condenser,
            na=rounded(microscope.condenser.na, 5),
            inner_na=None if inner is None else rounded(inner, 5),
        )
    if objective is not None and microscope.objective is not None and microscope.objective.aberrations:
        terms = {term: rounded(v, 4) for term, v in microscope.objective.aberrations.items()}
        objective = replace(objective, aberrations=terms)
    return replace(
        config,
        acquisition=Acquisition(prisms, config.acquisition.focus),
        microscope=replace(config.microscope, condenser=condenser, objective=objective),
    )


def _quantities(config: Config, found: OpticsFound) -> list[FoundQuantity]:
    """Each quantity that a bead tells."""
    how, whole = "by the bead", _how(found)
    declared = config.acquisition.prisms
    sheared = [i for i, prism in enumerate(declared) if prism is not None]
    biases = [number(prism.bias) for prism in declared if prism is not None]
    made = [_of("bias", "rad", biases, found.values["bias"][sheared], found.deviations["bias"][sheared], whole)]
    made += _shears(config, found, how)
    if "condenser" in found.values:
        assert config.microscope.condenser is not None
        before = number(config.microscope.condenser.na)
        deviation = found.deviations["condenser"].square().add(MODEL_APERTURE**2).sqrt()
        na, sure = (before * found.values["condenser"] * part for part in (1.0, deviation))
        made.append(_of("condenser na", "", before, na, sure, how))
    where = f"{how}; the planes stay as told, because focus against z is a gauge"
    made.append(_of("bead's z", "µm", None, -found.values["focus_zero"], found.deviations["focus_zero"], where))
    drift, lit = found.values["drift"], found.values["brightness"]
    moved = drift - drift.mean((0, 1))
    of = f"{how}, of planes {', '.join(map(str, found.planes))} (from 0)"
    made.append(_of("drift", "µm", None, moved, found.deviations["drift"], of))
    made.append(_of("brightness", "", None, lit, found.deviations["brightness"] * lit, of))
    if "aberrations" in found.values:
        made.append(_aberrations(config, found, how))
    return made


def _of(name: str, unit: str, before: Value, value: Tensor, deviation: Tensor, how: str) -> FoundQuantity:
    return FoundQuantity(name, unit, before, plain(value, 5), plain(deviation, 2), how)


def _aberrations(config: Config, found: OpticsFound, how: str) -> FoundQuantity:
    objective = config.microscope.objective
    assert objective is not None
    terms, known = config.calibration.aberrations, dict(objective.aberrations or {})
    before = {str(term): number(known.get(term, 0.0)) for term in terms}
    added, sure = (plain(part, 4) for part in (found.values["aberrations"], found.deviations["aberrations"]))
    values = {name: rounded(told + more, 4) for (name, told), more in zip(before.items(), added, strict=True)}
    return FoundQuantity("aberrations", "rad", before, values, dict(zip(before, sure, strict=True)), how)


def _shears(config: Config, found: OpticsFound, how: str) -> list[FoundQuantity]:
    """Length and angle of each axis's shear, by its first prism."""
    told, now = (
        [cmath.polar(complex(number(prism.shear[1]), number(prism.shear[0]))) for prism in firsts_of(acquisition)]
        for acquisition in (config.acquisition, found.setup.acquisition)
    )
    deviations = found.deviations["shear"]
    lengths, angles = ([rounded(value, 5) for value in values] for values in zip(*now, strict=True))
    sure = plain(torch.tensor(lengths) * deviations[:, 0].cpu(), 2)
    note = f"{how}; from right towards down"
    return [
        FoundQuantity("shear's length", "µm", [length for length, _ in told], lengths, sure, how),
        FoundQuantity(DIRECTION, "rad", [a for _, a in told], angles, plain(deviations[:, 1], 2), note),
    ]


def _how(found: OpticsFound) -> str:
    how = "by the bead"
    if found.noise:
        ratio = found.misfit / found.noise
        how += f", misfit {ratio:.2f} × the noise's"
        if float(found.deviations["bias"].max()) > UNSURE:
            how += "; bias and shear's length are uncertain together, a bead of more contrast tells more"
        if ratio > POOR and found.misfit - found.noise > LEAST:
            how += ": they aren't explained; check the bead's radius and index, the medium's, wavelength and NA"
    return how
