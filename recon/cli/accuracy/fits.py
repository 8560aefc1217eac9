"""torchdic work-precision --fit: what each way to reconstruct costs, and how near it comes, on one stack."""

import argparse
import signal
from collections.abc import Sequence
from typing import NoReturn

import torch
from tqdm import tqdm

from recon.cli.specimens import specimen_of
from recon.config.reading import load
from recon.config.schema import Config, ConfigError
from recon.fit.step import Step
from recon.report import figures
from recon.report.fit_fronts import draw_fits, fits_table
from recon.report.fit_trial import FitCandidate
from recon.run.data import load_data, prepared
from recon.run.fits.finer import FinerModel
from recon.run.fits.kept import EarlierTrials, KeptTrials
from recon.run.fits.ladder import fits_of
from recon.run.fits.trials import Recorded, fit_trials
from recon.run.folder.prepared import prepare_folder
from recon.run.interruption import InterruptedRunError, signals_kept
from recon.run.results import leave_configuration
from torchdic.files.format import Stack


def run(options: argparse.Namespace) -> None:
    """Fit the configuration's stack by each candidate; leave fits.csv, fits.json and fits.png, and print a table."""
    signal.signal(signal.SIGTERM, _interrupt)
    config = load(options.config)
    _check_pixels(config)
    candidates = fits_of(config)
    earlier = EarlierTrials.within(options.out, resume=options.resume, restart=options.restart)
    recorded = _recorded(config, str(options.config), options.device)
    kept = KeptTrials(options.out, recorded, earlier)
    prepare_folder(options.out)
    leave_configuration(config, options.out, "work-precision")
    _try_each(recorded, candidates, kept)
    found = [trial for candidate in candidates for trial in kept.trials if trial.candidate == candidate]
    print(fits_table(found))
    if all(trial.failure is not None for trial in found):
        raise ConfigError(f"{options.config}: no candidate can fit this stack")
    scene = "measured stack" if config.specimen is None else str(config.specimen["kind"])
    figures.save(draw_fits({scene: found}), options.out / "fits.png")
    print(f"\n{options.out / 'fits.csv'}, .json and .png: {len(found)} fits")


def _check_pixels(config: Config) -> None:
    """Raise ConfigError where the camera's pixels aren't the volume's voxels."""
    camera = config.microscope.camera
    if camera is not None and camera.pixel_size is not None:
        raise ConfigError(
            f"microscope.camera.pixel_size: {camera.pixel_size:g}: fits are compared on pixels that are the volume's "
            "voxels; leave it out and give voxels the size of the pixels"
        )


def _try_each(recorded: Recorded, candidates: Sequence[FitCandidate], kept: KeptTrials) -> None:
    """Fit by each candidate that hasn't been tried, and keep what comes of it."""
    missing = kept.missing(candidates)
    done = len(candidates) - len(missing)
    try:
        with (
            tqdm(total=len(candidates), initial=done, desc="fits", unit="fit") as bar,
            signals_kept() as check_signals,
        ):

            def seen(candidate: FitCandidate, step: Step) -> None:
                bar.set_description(f"{candidate.label}, step {step.number}", refresh=False)
                bar.set_postfix(misfit=f"{step.misfit:.4g}")
                check_signals()

            for trial in fit_trials(recorded, missing, seen):
                done += 1
                kept.add(trial, complete=done == len(candidates))
                bar.update()
                check_signals()
    except KeyboardInterrupt:
        raise InterruptedRunError(f"interrupted after {done} of {len(candidates)} fits; go on with --resume") from None
    if not missing:
        kept.write(complete=True)


def _recorded(config: Config, source: str, device: torch.device) -> Recorded:
    """The stack that is fitted: of the specimen from a finer model or its exact field, else the measured one."""
    if config.specimen is None:
        if config.data is None:
            raise ConfigError(f"{source}: missing key specimen or data.path: fits need a known specimen or a stack")
        print(f"{', '.join(config.data.files)}: the truth isn't known; the misfit over the noise is all that is told")
        return Recorded(config, load_data(config), None, device)
    specimen, model, grid = specimen_of(config, source), FinerModel(), config.volume.grid
    exact = hasattr(specimen, "field")
    print(f"the specimen's stack, from {'its exact field' if exact else 'a finer model'} …", flush=True)
    images = model.images(specimen, grid, config.microscope, config.acquisition)
    camera = config.microscope.camera
    if camera is not None:
        images = camera.record(images, torch.Generator().manual_seed(config.simulation.seed))
    stack = Stack(images.numpy(), grid.spacing[1:], source=source)
    noisy = camera is not None and camera.photons is not None
    return Recorded(config, prepared(config, stack), model.truth(specimen, grid), device, noisy)


def _interrupt(_number: int, _frame: object) -> NoReturn:
    raise KeyboardInterrupt
