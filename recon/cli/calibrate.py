"""torchdic calibrate: signs, orders and values of the optics, as far as a stack's images tell them."""

import argparse

import torch
from torch import Tensor

from data_synthetic import Bead
from recon.calibration.known_specimen import ModelledSpecimen
from recon.config.reading import load
from recon.config.rewritten import Source
from recon.config.schema import BeadSection, ConfigError
from recon.run.calibration.calibrate import calibrate
from recon.run.interruption import InterruptedRunError
from torchdic import Grid


def run(options: argparse.Namespace) -> None:
    """Find what the configuration's stack tells of its optics, and leave a calibrated configuration in the folder."""
    config = load(options.config)
    if config.data is None:
        raise ConfigError(f"{options.config}: missing key data.path: a calibration needs a stack")
    section = config.calibration.bead
    bead = None if section is None else known_bead(section, config.volume.background)
    source = Source.of(options.config)
    try:
        calibrate(config, options.out, options.device, bead, source=source, restart=options.restart)
    except KeyboardInterrupt:
        raise InterruptedRunError("interrupted; a calibration writes nothing before it has found all") from None


def known_bead(section: BeadSection, background: float) -> ModelledSpecimen:
    """The bead that a configuration names. background: index of its medium."""
    bead = Bead(section.radius, section.index - background, background)

    def delta(grid: Grid) -> Tensor:
        return bead.delta(grid, dtype=torch.float32)

    return ModelledSpecimen(delta, 2 * section.radius, 2 * section.radius)
