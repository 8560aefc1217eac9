"""torchdic work-precision: what accuracy costs, measured on the configuration's scene."""

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from tqdm import tqdm

from recon.cli.accuracy import fits
from recon.cli.specimens import check_exact_field, specimen_of, voxels
from recon.config.reading import load
from recon.config.schema import Config, ConfigError
from recon.report import figures
from recon.report.fronts import as_dict, as_table, draw_fronts, write_csv
from recon.run.exact_images import exact_images
from recon.run.folder.prepared import prepare_folder
from recon.run.folder.results import check_no_results
from recon.run.interruption import InterruptedRunError
from recon.run.results import leave_configuration
from torchdic import Candidate, Fidelity, Trial
from torchdic.files.whole import write_json
from torchdic.planning.comparisons import TRUTH
from torchdic.planning.ladders import reaches_a_side
from torchdic.planning.work_precision import converged_fidelities, ladder, trials

# The file of a finished run.
RESULTS = "work_precision.json"


def run(options: argparse.Namespace) -> None:
    """Time each candidate, compare it with the truth, and leave the measurements as CSV, JSON and a figure."""
    if options.fit:
        fits.run(options)
        return
    if options.resume:
        raise ConfigError("--resume goes with --fit: images are measured anew each time")
    check_no_results(options.out, (RESULTS,), restart=options.restart)
    config = load(options.config)
    specimen = specimen_of(config, str(options.config))
    check_exact_field(config, specimen, str(options.config))
    grid, microscope, acquisition = config.volume.grid, config.microscope, config.acquisition
    volume = voxels(specimen, grid, options.device)
    candidates = config.candidates or ladder(grid, padded=not reaches_a_side(volume))
    reference = _references(config, candidates)
    prepare_folder(options.out)
    leave_configuration(replace(config, candidates=candidates), options.out, "work-precision")
    exact = None
    if hasattr(specimen, "field"):
        # the exact field is lit from as many directions as the truth that it replaces
        lit = reference[TRUTH]
        exact = exact_images(specimen, grid, microscope, acquisition, lit).to(options.device)
    print("the truth: converged images and their gradient …", flush=True)
    steps = trials(
        volume, microscope, acquisition, candidates, reference, exact=exact, repeats=config.work_precision.repeats
    )
    found: list[Trial] = []
    try:
        for trial in tqdm(steps, desc="work-precision", total=len(candidates), unit="candidate"):
            found.append(trial)
            write_csv(options.out / "work_precision.csv", found)
    except KeyboardInterrupt:
        if not found:
            raise
        raise InterruptedRunError(
            f"interrupted after {len(found)} of {len(candidates)} candidates; "
            f"{options.out / 'work_precision.csv'} holds what was measured"
        ) from None
    _write(found, reference, str((config.specimen or {})["kind"]), options.out)


def _references(config: Config, candidates: Sequence[Candidate]) -> dict[str, Fidelity]:
    """For each propagation the fidelity whose result counts as converged: the configuration's, or the usual one."""
    reference: dict[str, Fidelity] = converged_fidelities(candidates, config.volume.grid)
    given = config.work_precision.reference
    if given is None:
        return reference
    return {propagation: replace(given, propagation=propagation) for propagation in reference}


def _write(found: Sequence[Trial], reference: Mapping[str, Fidelity], scene: str, out: Path) -> None:
    """Write the measurements as CSV, JSON and a figure, and print them as a table."""
    write_csv(out / "work_precision.csv", found)
    write_json(out / RESULTS, as_dict(found, reference))
    figures.save(draw_fronts({scene: found}), out / "work_precision.png")
    print(as_table(found))
    print(f"\n{out / 'work_precision.csv'}, .json and .png: {len(found)} candidates")
