"""torchdic plan: which effects a scene calls for, and the cheapest way to compute it within a tolerance."""

import argparse

import torch

import torchdic
from recon.cli.evidence.coverage import in_short
from recon.cli.specimens import specimen_of, voxels
from recon.config.reading import load
from recon.config.schema import Config, ConfigError
from recon.earlier.tikhonov import tikhonov
from recon.fit.setup import Setup, empty_medium
from recon.run.data import load_data
from recon.run.folder.prepared import prepare_folder
from recon.run.results import leave_configuration
from recon.run.room import check_room_for_direct
from torchdic import Volume
from torchdic.files.whole import write_json

# The tolerance of a configuration that names none.
USUAL_TOLERANCE = 0.01


def run(options: argparse.Namespace) -> None:
    """Print the plan of the configuration's specimen, or of a first estimate of the one behind its stack.

    With a folder the plan is left there as plan.json, beside the configuration.
    """
    config = load(options.config)
    tolerance = USUAL_TOLERANCE if config.tolerance is None else config.tolerance
    if config.specimen is None:
        volume = _first_estimate(config, str(options.config), options.device)
    else:
        volume = voxels(specimen_of(config, str(options.config)), config.volume.grid, options.device)
    if options.out is not None:
        prepare_folder(options.out)
    planned = torchdic.plan(volume, config.microscope, config.acquisition, tolerance)
    print(planned.table())
    if options.out is not None:
        write_json(options.out / "plan.json", planned.as_dict())
        leave_configuration(config, options.out, "plan")
    if (seen := in_short(config, str(options.config))) is not None:
        print(f"\n{seen}")


def _first_estimate(config: Config, source: str, device: torch.device) -> Volume:
    """The volume whose linear images explain the stack, which stands for a specimen that isn't known."""
    if config.data is None:
        raise ConfigError(f"{source}: missing key specimen or data.path: a plan needs a known specimen or a stack")
    measured = load_data(config)
    data = torch.from_numpy(measured.data).to(device)
    medium = empty_medium(config.volume.grid, config.volume.background, data)
    setup = Setup(medium, config.microscope, config.acquisition)
    try:
        check_room_for_direct("linear", data, setup, config.reconstruction.bounds)
        found = tikhonov(data, setup, measured.noise, config.reconstruction.bounds)
    except ValueError as error:
        raise ConfigError(f"{source}: no first estimate of the specimen for a plan: {error}") from error
    print(f"{config.data.path}: planned on the linear estimate of its specimen")
    return Volume(medium.grid, found.delta, medium.background)
