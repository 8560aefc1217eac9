"""torchdic plan: which effects a scene calls for, and the cheapest way to compute it within a tolerance."""

import argparse

import torchdic
from recon.cli.specimens import specimen_of, voxels
from recon.config.reading import load
from recon.run.reconstruct import prepare_folder
from torchdic.files.whole import write_json

# The tolerance of a configuration that names none.
USUAL_TOLERANCE = 0.01


def run(options: argparse.Namespace) -> None:
    """Print the plan of the configuration's specimen; leave it as plan.json if a folder is given."""
    config = load(options.config)
    specimen = specimen_of(config, str(options.config))
    tolerance = USUAL_TOLERANCE if config.tolerance is None else config.tolerance
    volume = voxels(specimen, config.volume.grid, options.device)
    if options.out is not None:
        prepare_folder(options.out)
    planned = torchdic.plan(volume, config.microscope, config.acquisition, tolerance)
    print(planned.table())
    if options.out is not None:
        write_json(options.out / "plan.json", planned.as_dict())
