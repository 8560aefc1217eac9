"""A reconstruction from a configuration to a folder of results, which may be interrupted and resumed."""

import hashlib
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from recon.config.conversion import flat
from recon.config.reading import load
from recon.config.resolved import RESOLVED
from recon.config.schema import CalibrationSection, Config, ConfigError, CoverageSection, SimulationSection
from recon.earlier.direct import solved_directly
from recon.fit.problem import DIRECT, Problem
from recon.fit.setup import Setup, empty_medium
from recon.fit.step import Step
from recon.misfit.base import Misfit
from recon.recording.cut_field import needed_margin
from recon.recording.preparation import Measured
from recon.report.forecast import Forecast
from recon.run import checkpoint
from recon.run.checkpoint import Checkpoint, CheckpointError, save_if_possible
from recon.run.data import load_data, load_support, looks, warn_of_changes
from recon.run.folder.lock import when_done
from recon.run.folder.prepared import prepare_folder
from recon.run.folder.results import check_inputs_stay, check_no_results
from recon.run.misfits import misfit_for
from recon.run.recorded import CHECKPOINT, LOG, STOPPING, descend_recorded, leave_stopped, tell_foreseen
from recon.run.results import GO_ON, IMAGES, INTERRUPTED, LEFT, METRICS, VOLUME, Result, ResultsError, write_results
from recon.run.room import (
    check_room_for_descent,
    check_room_for_direct,
    check_room_for_report,
    check_room_for_volume,
)
from recon.run.tiles.fitting import TiledFit, tiles_to_fit
from recon.run.tiles.kept import TILES, forget, remembered_side
from recon.run.tiles.sizes import Cut, cut_of
from torchdic import Fidelity
from torchdic.memory.shortage import as_shortage

# Without a [fidelity] section. Newton's steps are computed with few directions and corrected to these images, whose
# error is below the noise of 40 000 photons a pixel; each of Adam's many steps is computed with its own in full, and
# the error of a first-order split step is below that of its directions and of the voxels.
RECOMMENDED = Fidelity("wave", sources=128, padding=8)
RECOMMENDED_FOR_ADAM = Fidelity("wave", order=1)

# Pixels along a side of a field that is too small to tell whether the specimen goes on beyond it.
LEAST_FIELD = 24


def reconstruct(
    config: Config,
    out: Path,
    device: torch.device,
    *,
    resume: bool = False,
    restart: bool = False,
    misfit: Callable[[Tensor], Misfit] | None = None,
) -> Result:
    """Fit a volume to the configuration's stack and leave it in `out`, with metrics, log, configuration and figures.

    resume: go on from the checkpoint in `out`, if there is one; a finished run goes on where more steps are asked for.
    restart: begin anew although there are a checkpoint or results.
    misfit: makes the misfit that is lowered from the prepared stack (prism, focus, y, x); None is the configuration's.
    Raises ConfigError, StackError and CheckpointError for bad input, FinishedError where `out` holds results, and
    ShortOfMemoryError where there is no room for the descent, before `out` is touched; InterruptedRunError on Ctrl-C,
    with a checkpoint and the volume so far saved; ResultsError where results cannot be written.
    """
    _check_inputs_stay(config, out)
    before, budget = looks(config), None if config.fidelity is None else config.fidelity.memory
    config, measured, made, problem, identity = _asked(config, device, misfit)
    start = None if restart else _checkpoint_to_resume(out, identity, resume=resume)
    if config.reconstruction.method in DIRECT:
        return _solved(config, measured, problem, out, identity)
    cut = None
    if start is None:
        cut = cut_of(config, problem, made, budget, None if restart else remembered_side(out))
    else:  # a field of which a fit is under way stays whole
        check_room_for_descent(problem, made)
    tiled = None if cut is None else _tiled(config, measured, problem, cut, out, identity)
    _check_room_for_report(problem)
    prepare_folder(out)
    if restart:
        forget(out)
    if tiled is not None:
        result = _in_tiles(config, measured, tiled)
        warn_of_changes(config, before)
        return result
    forecast = Forecast(problem)
    tell_foreseen(problem, forecast, 0 if start is None else start.step.number)
    every = config.reconstruction.checkpoint_every
    ended = descend_recorded(problem, out, every, identity, start, forecast=forecast)
    warn_of_changes(config, before)
    save_if_possible(out / CHECKPOINT, ended)
    try:
        return write_results(out, config, measured, problem, ended)
    except ResultsError as error:
        raise ResultsError(f"{error}; make room and {_how_to_go_on(out, identity)}") from error
    except STOPPING as error:  # the images by which the volume is judged have no room, or can't be followed
        known = as_shortage(error)
        known.args = (f"{known}; {leave_stopped(out, problem, ended)}",)
        raise known from known.__cause__


def _check_room_for_report(problem: Problem) -> None:
    check_room_for_report(problem.misfit.data.numel(), math.prod(problem.setup.field.shape))


def _solved(config: Config, measured: Measured, problem: Problem, out: Path, identity: str) -> Result:
    """The results of a method without a descent, written into `out`."""
    section = config.reconstruction
    check_room_for_direct(section.method, problem.misfit.data, problem.setup, section.bounds)
    _check_room_for_report(problem)
    try:
        step, sections = solved_directly(section, problem, measured.noise)
    except ValueError as error:
        raise ConfigError(f"reconstruction.method: {config.reconstruction.method!r}: {error}") from error
    prepare_folder(out)
    return write_results(out, config, measured, problem, Checkpoint(step, [], identity), sections)


def _tiled(config: Config, measured: Measured, whole: Problem, cut: Cut, out: Path, identity: str) -> TiledFit:
    """The fit by tiles of a field; lines say of which. Raises ConfigError where no tile can be fitted."""
    problem, layout = cut.problem(whole), cut.layout
    sides = f"{layout.along_y.count} × {layout.along_x.count} voxels"
    print(f"{len(layout)} tiles of {sides} and {layout.margin} more on each side (tiles = {layout.side})")
    tiles, every = tiles_to_fit(problem, layout), config.reconstruction.checkpoint_every
    return TiledFit(problem, layout, tiles, measured.noise, out, identity, every)


def _in_tiles(config: Config, measured: Measured, fit: TiledFit) -> Result:
    """The results of a fit by tiles, which are removed once the command has left all that it leaves."""
    out, tiled = fit.out, fit.fitted()
    config = replace(config, reconstruction=replace(config.reconstruction, tiles=fit.layout.side))
    try:
        result = write_results(out, config, measured, fit.whole, tiled.ended, tiled=tiled)
    except ResultsError as error:
        raise ResultsError(f"{error}{GO_ON}") from error
    for name in (LOG, CHECKPOINT):  # of an earlier fit of the whole
        (out / name).unlink(missing_ok=True)
    when_done(lambda: forget(out))
    return result


@dataclass(frozen=True, eq=False)
class Reconstructed:
    """A finished reconstruction, read from its folder.

    out: the folder. config, measured, problem: that were fitted. step: the last. identity: of all that the fit depends
    on.
    """

    out: Path
    config: Config
    measured: Measured
    problem: Problem
    step: Step
    identity: str


def reconstructed(out: Path, device: torch.device) -> Reconstructed:
    """The reconstruction that a folder holds.

    Raises ConfigError where the folder holds no finished one, and CheckpointError where its configuration or its data
    have changed since, or its own misfit was one that only a script knows.
    """
    resolved = out / RESOLVED
    missing = [name for name in (VOLUME, RESOLVED) if not (out / name).exists()]
    if missing:
        raise ConfigError(f"{out}: holds no finished reconstruction: {' and '.join(missing)} missing")
    config, measured, _, problem, identity = _asked(load(resolved), device)
    if config.reconstruction.method in DIRECT:
        step, _ = solved_directly(config.reconstruction, problem, measured.noise)
    elif isinstance(config.reconstruction.tiles, int) and not (out / CHECKPOINT).exists():
        raise ConfigError(
            f"{out}: was fitted by tiles, and the fit is done again whole: fit a part of the field by itself"
        )
    elif (out / CHECKPOINT).exists():
        step = checkpoint.load(out / CHECKPOINT, identity).step
        step = replace(step, delta=step.delta.to(device))
    else:
        raise ConfigError(f"{out / CHECKPOINT}: missing: the fit can't be done again without it")
    return Reconstructed(out, config, measured, problem, step, identity)


def _asked(
    config: Config, device: torch.device, misfit: Callable[[Tensor], Misfit] | None = None
) -> tuple[Config, Measured, Callable[[Tensor], Misfit], Problem, str]:
    """What a configuration asks to be fitted: itself spelled out, its stack, what makes the misfit, and the problem.

    misfit: in place of the configuration's. The last is the fit's identity.
    """
    config = spelled_out(config)
    measured = load_data(config)
    data = torch.from_numpy(measured.data).to(device)
    check_room_for_volume(config.volume.grid, device)
    made = misfit or misfit_for(config, measured)
    problem = problem_of(config, data, made, measured)
    return config, measured, made, problem, _identity(config, measured, problem)


def spelled_out(config: Config) -> Config:
    """The configuration with what it leaves to the method: the fidelity, and how a descent steps."""
    section = config.reconstruction
    if config.tolerance is None and config.fidelity is None:
        config = replace(config, fidelity=RECOMMENDED_FOR_ADAM if section.method == "adam" else RECOMMENDED)
    if section.method in DIRECT:
        return config
    steps = replace(section, steps=section.most_steps, l1=section.sparse, draft_sources=section.drafts)
    return replace(config, reconstruction=steps)


def problem_of(config: Config, data: Tensor, misfit: Callable[[Tensor], Misfit], measured: Measured) -> Problem:
    """What the configuration asks to be fitted to the data, with the fidelity or for the tolerance that it gives."""
    margin = margin_of(config, measured)
    medium = empty_medium(config.volume.grid.widened(margin, margin), config.volume.background, data)
    setup = Setup(medium, config.microscope, config.acquisition, margin=margin)
    fidelity = config.fidelity or config.tolerance
    assert fidelity is not None
    support = load_support(config, measured)
    try:
        return Problem.from_recipe(data, setup, fidelity, config.reconstruction, misfit, measured.noise, support)
    except ValueError as error:
        if support is None:
            raise
        raise ConfigError(f"reconstruction.support: {config.reconstruction.support}: {error}") from error


def margin_of(config: Config, measured: Measured) -> int:
    """Voxels beyond the field on each side; a line says so where they are added without having been asked for."""
    section = config.reconstruction
    if section.margin != "auto":
        return section.margin
    if section.method in DIRECT or min(*config.volume.shape[1:], *measured.data.shape[2:]) < LEAST_FIELD:
        return 0
    scene = config.volume.grid, config.microscope, config.volume.background
    margin = needed_margin(measured.data, measured.noise, *scene)
    if margin > 0:
        print(f"the images show the specimen at their border: {margin} voxels are added beyond it (margin = {margin})")
    return margin


def _identity(config: Config, measured: Measured, problem: Problem) -> str:
    """All that the descent depends on, one line `key = value` each. Where a value differs, it is another descent."""
    fit = replace(
        config,
        data=None,  # what the descent sees of them is in their digest
        specimen=None,
        calibration=CalibrationSection(),
        coverage=CoverageSection(),
        simulation=SimulationSection(),
        # with more steps it is the same one, prolonged
        reconstruction=replace(config.reconstruction, steps=None, checkpoint_every=1, support=None),
    )
    support = problem.support
    digests = {
        "data": measured.data,
        "mask": measured.left_out.counted,
        "support": None if support is None else support.cpu().numpy(),
    }
    seen = [f"{name}'s sha256 = {_digest(array)}" for name, array in digests.items() if array is not None]
    return "\n".join([*flat(fit), f"misfit = {problem.misfit.name}", *seen])


def _how_to_go_on(out: Path, identity: str) -> str:
    """What the user can do where results could not be written."""
    try:
        saved = checkpoint.load(out / CHECKPOINT, identity).step
    except CheckpointError:
        return "begin anew"
    return f"go on with --resume, from step {saved.number}"


def _digest(array: np.ndarray) -> str:
    return hashlib.sha256(array.tobytes()).hexdigest()


def _checkpoint_to_resume(out: Path, identity: str, *, resume: bool) -> Checkpoint | None:
    """The checkpoint to go on from, None to begin in a folder without one.

    Raises CheckpointError or FinishedError where the folder holds an earlier run, and the user must choose.
    """
    if (out / TILES).exists():
        if resume:
            return None
        raise CheckpointError(f"{out / TILES}: an interrupted run; go on with --resume, or begin anew with --restart")
    saved, finished = out / CHECKPOINT, (out / METRICS).exists() and not (out / INTERRUPTED).exists()
    if saved.exists():
        if resume:
            return checkpoint.load(saved, identity)
        which = (
            "a finished run; go on with more steps and --resume"
            if finished
            else "an interrupted run; go on with --resume"
        )
        raise CheckpointError(f"{saved}: {which}, or begin anew with --restart")
    check_no_results(out, (METRICS, VOLUME, IMAGES), restart=False)
    return None


def _check_inputs_stay(config: Config, out: Path) -> None:
    """Raise ConfigError where a result would replace a file that the configuration names."""
    data, support = config.data, config.reconstruction.support
    inputs = [] if data is None else [*data.files, data.mask, data.empty]
    check_inputs_stay(out, [*inputs, None if support == "edges" else support], LEFT)
