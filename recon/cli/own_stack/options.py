"""What a user can tell `torchdic new` by options, and the laws that it keeps."""

import argparse
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from recon.cli import arguments
from recon.cli.own_stack.settled import BACKGROUND, WAVELENGTH
from recon.config.plausible.impossible import impossible
from recon.config.plausible.unlikely import like_radians
from recon.config.schema import ConfigError
from torchdic import Condenser, Microscope, Objective
from torchdic.instrument.microscope import check_apertures

# What was given, under the options' names; None where nothing was.
Given = dict[str, Any]

# Options in µm, degrees or without unit, each with its help.
OPTIONS = {
    "pixel-size": "side of a camera's pixel in the specimen, µm",
    "z-step": "distance between focus planes, µm",
    "wavelength": "of the light in vacuum, µm",
    "na": "numerical aperture of the objective",
    "condenser-na": "numerical aperture of the condenser, as far as it is open",
    "background": "refractive index of the medium around the specimen",
    "shear": "length of the shear, µm",
    "shear-angle": (
        "direction of the shear in degrees, from right towards down; where the settings have several axes, one for "
        "each in their order, or one for each setting: --shear-angle 45 135; a single one is of the first axis"
    ),
    "bias": (
        "phase between the beams in degrees: one for all settings, whose signs the images show, or one for each "
        "setting: --bias 65 -65"
    ),
    "offset": "counts of a dark image; below 0 what was subtracted from the images, which is put back",
}

# Options that take several numbers, and those that are angles in degrees.
SEVERAL, _ANGLES = ("--shear-angle", "--bias"), ("bias", "shear_angle")

# Where a value is held whose size is checked there.
_AS_KEYS: dict[str, Callable[[float], dict[str, Any]]] = {
    "wavelength": lambda value: {"microscope": {"wavelength": value}},
    "background": lambda value: {"volume": {"background": value}},
    "pixel_size": lambda value: {"volume": {"pixel_size": value}},
    "z_step": lambda value: {"z_step": value},
    "shear": lambda value: {"acquisition": {"prisms": [{"shear": {"length": value}}]}},
    "shear_angle": lambda value: {"acquisition": {"prisms": [{"shear": {"angle_degrees": value}}]}},
    "bias": lambda value: {"acquisition": {"prisms": [{"bias_degrees": value}]}},
}

# Where an aperture is held, which is checked with the medium's index.
_APERTURES: dict[str, Callable[[float], Microscope]] = {
    "na": lambda value: Microscope(WAVELENGTH, Objective(value)),
    "condenser_na": lambda value: Microscope(WAVELENGTH, condenser=Condenser(value)),
}

# The least values of options that need not be above 0.
_LEAST = {"background": 1.0} | dict.fromkeys(("offset", *_ANGLES), -math.inf)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add all of OPTIONS to a parser."""
    for name, words in OPTIONS.items():
        action = "append" if f"--{name}" in SEVERAL else "store"
        parser.add_argument(f"--{name}", type=arguments.decimal, metavar="X", help=words, action=action)


def given_of(options: argparse.Namespace) -> Given:
    """What was given, checked. Raises ConfigError for an option that breaks its law, or that can't be in its unit."""
    given = {name.replace("-", "_"): getattr(options, name.replace("-", "_")) for name in OPTIONS}
    for name, told in given.items():
        for value in _each(told):
            _check(name, value)
    for name, microscope in _APERTURES.items():
        if given[name] is not None:
            _check_aperture(name, microscope(given[name]), given["background"] or BACKGROUND)
    return given


def _check_aperture(name: str, microscope: Microscope, background: float) -> None:
    try:
        check_apertures(microscope, background)
    except ValueError as error:
        raise ConfigError(f"--{name.replace('_', '-')}: {error}") from error


def _check(name: str, value: float) -> None:
    option = f"--{name.replace('_', '-')}"
    if not math.isfinite(value):
        raise ConfigError(f"{option} {value:g} must be finite")
    least = _LEAST.get(name)
    if value <= 0 if least is None else value < least:
        lowest = "above 0" if least is None else f"at least {least:g}"
        raise ConfigError(f"{option} {value:g} must be {lowest}")
    wrong = impossible(_AS_KEYS[name](value)) if name in _AS_KEYS else None
    if wrong is not None:
        raise ConfigError(f"{option}: {wrong.partition(': ')[2]}")


def in_radians(given: Mapping[str, Any]) -> Iterator[str]:
    """A line for each angle that looks as if it were in rad."""
    for name in _ANGLES:
        for value in dict.fromkeys(_each(given.get(name))):
            like = like_radians(value)
            if like is not None:
                words, degrees = like
                option = f"--{name.replace('_', '-')}"
                yield f"warning: {option} {value:g} is taken as {value:g}°; if {words} rad is meant, give {degrees:g}"


def _each(told: float | Sequence[float] | None) -> Sequence[float]:
    if told is None:
        return ()
    return told if isinstance(told, Sequence) else (told,)
