"""A recording of any specimen, by any microscope and with any faults, drawn at random, and what a user tells of it."""

import math
import warnings
from dataclasses import dataclass

import numpy as np

from data_synthetic.bead import Bead
from data_synthetic.recorder.faults import Faults
from data_synthetic.recorder.record import Finer, Recording, record
from data_synthetic.recorder.told import Mistakes, Told, tell
from data_synthetic.scenes.any_specimen import any_specimen
from data_synthetic.specimen import Specimen
from torchdic.errors import ApertureWarning, WrapAroundWarning
from torchdic.grid import Grid
from torchdic.instrument.camera import Camera
from torchdic.instrument.condenser import Condenser
from torchdic.instrument.microscope import Acquisition, Microscope
from torchdic.instrument.objective import Objective
from torchdic.instrument.prism import Prism

# Objectives as they are sold: NA, index of the immersion, and a pixel of the camera behind them in µm.
OBJECTIVES = ((0.75, 1.0, 0.16), (0.9, 1.0, 0.15), (1.2, 1.333, 0.12), (1.4, 1.515, 0.11))

CONDENSERS = (0.55, 0.7, 0.9)

MEDIA = (1.335, 1.36, 1.45)

WAVELENGTHS = (0.532, 0.546, 0.59)

_FEWEST = 32


@dataclass(frozen=True)
class Drawn:
    """A recording that was drawn, and what a user tells of it.

    kind: of the specimen. recording: with the exact truth. told: with mistakes in it, which it names.
    immersion: index of the objective's immersion. file_kind: of `write_recording`.
    """

    kind: str
    recording: Recording
    told: Told
    immersion: float
    file_kind: str


def drawn(seed: int, *, pixels: int = 64, finer: Finer | None = None) -> Drawn:
    """Draw a specimen, optics, faults and a user; the same seed draws the same.

    pixels: of the field along y and x. finer: how much finer than the recording its light is computed.

    The specimen is a bead, beads, a cell, fibres, a graded one or one of lower index. The user knows wavelength, NA,
    medium and pixels; she is off by up to 10° in bias, 15 % in shear and 10° in its axis. She doesn't know the shear's
    sign: every second time it is told reversed, and every fourth time the planes are told in the opposite order.
    Raises ValueError for a field of fewer than 32 pixels, which has no room for every specimen.
    """
    if pixels < _FEWEST:
        raise ValueError(f"a field of {pixels} pixels has no room for every specimen: it takes {_FEWEST}")
    random = np.random.default_rng(seed)
    microscope, immersion, pixel = _microscope(random)
    background = float(random.choice(MEDIA))
    field = Grid((24, pixels, pixels), (0.3, pixel, pixel))
    kind, specimen = _specimen(random, field, background)
    acquisition, faults = _acquisition(random, field), _faults(random)
    with warnings.catch_warnings():
        # an oil objective on a watery medium is drawn on purpose; 0.02 % of the light wraps around a margin of 16
        for kind_of_warning in (ApertureWarning, WrapAroundWarning):
            warnings.simplefilter("ignore", kind_of_warning)
        noise = int(random.integers(2**31))
        recording = record(specimen, field, microscope, acquisition, faults, finer, noise)
    mistakes = Mistakes(
        bias=math.radians(random.uniform(-10, 10)),
        length=float(random.uniform(0.85, 1.15)),
        turn=math.radians(random.uniform(-10, 10)),
        reversed_shear=bool(random.random() < 0.5),
        reversed_focus=bool(random.random() < 0.25),
    )
    file_kind = str(random.choice(["ome", "imagej", "tiff", "folder", "micro-manager"]))
    return Drawn(kind, recording, tell(recording, mistakes), immersion, file_kind)


def _microscope(random: np.random.Generator) -> tuple[Microscope, float, float]:
    """A microscope with its camera, the index of its immersion, and its pixel in µm."""
    na, immersion, pixel = OBJECTIVES[int(random.integers(len(OBJECTIVES)))]
    bits = int(random.choice([12, 16]))
    photons = float(random.uniform(4000, 15000))
    offset = float(round(random.uniform(60, 200)))
    # two and a half empty bright fields below saturation, or less where the well is not so deep
    gain = min((2**bits - 1 - offset) / (2.5 * photons), 2.0)
    camera = Camera(photons=photons, read_noise=float(random.uniform(1, 4)), gain=float(gain), offset=offset, bits=bits)
    condenser = Condenser(float(random.choice([aperture for aperture in CONDENSERS if aperture <= na])))
    return Microscope(float(random.choice(WAVELENGTHS)), Objective(na), condenser, camera), immersion, pixel


def _specimen(random: np.random.Generator, field: Grid, background: float) -> tuple[str, Specimen]:
    """Every fifth time a bead, else any specimen."""
    if random.random() < 0.2:
        radius, contrast = 0.2 * min(field.extent), math.exp(random.uniform(math.log(0.008), math.log(0.04)))
        place = [float(random.uniform(-0.1, 0.1) * e) for e in field.extent]
        return "bead", Bead(float(radius), float(contrast), background, (place[0], place[1], place[2]))
    return any_specimen(random, field.extent, background)


def _acquisition(random: np.random.Generator, field: Grid) -> Acquisition:
    """One shear or two across, each with one bias or two of opposite sign, and planes through the field's depth."""
    length, angle = random.uniform(0.15, 0.25), random.uniform(0, 2 * math.pi)
    axes = [angle] if random.random() < 0.6 else [angle, angle + math.pi / 2]
    bias = math.radians(random.uniform(50, 110))
    biases = [bias, -bias] if random.random() < 0.6 else [bias]
    prisms = [
        Prism((float(length * math.sin(axis)), float(length * math.cos(axis))), b) for axis in axes for b in biases
    ]
    planes = int(random.integers(9, 16))
    step = round(0.8 * field.extent[0] / (planes - 1), 2)
    focus = [round((number - (planes - 1) / 2) * step, 4) for number in range(planes)]
    return Acquisition(prisms, focus)


def _faults(random: np.random.Generator) -> Faults:
    return Faults(
        tilt=(float(random.uniform(-0.2, 0.2)), float(random.uniform(-0.2, 0.2))),
        vignette=math.radians(random.uniform(0, 15)),
        flicker=float(random.uniform(0, 0.03)),
        drift=(float(random.uniform(-0.01, 0.01)), float(random.uniform(-0.01, 0.01))),
        hot=int(random.integers(0, 10)),
        dead=int(random.integers(0, 3)),
    )
