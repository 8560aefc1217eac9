"""A reconstruction from a configuration to a folder of results, which may be interrupted and resumed."""

import csv
import hashlib
import math
import signal
import threading
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from types import FrameType
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from tqdm import tqdm

from recon.config.conversion import dump, flat
from recon.config.schema import Config, ConfigError, SimulationSection
from recon.fit.descent import Step, descend
from recon.fit.misfit import gaussian, spatial_variance
from recon.fit.planned import announce_record, current
from recon.fit.start import bytes_of_linear_start
from recon.recording.preparation import ExpectedStack, Measured, Normalisation, prepare
from recon.report import figures
from recon.report.metrics import residual_rms
from recon.run import checkpoint
from recon.run.checkpoint import Checkpoint, CheckpointError, Row
from torchdic import Acquisition, Fidelity, Grid, Volume, foreseen, image
from torchdic.errors import StackError
from torchdic.files.stack import read_stack, write_volume
from torchdic.files.whole import write_json, write_text, written_whole
from torchdic.memory.free import check_room, check_volume, free_bytes

CHECKPOINT = "checkpoint.pt"

# Volumes that a descent holds beside an image and its gradient: Δn and what it is made of, Adam's moments, the total
# variation's differences, and the last two steps that are handed out. 12 to 15 as measured.
COPIES = 15

# Without a [fidelity] section: what a first-order split step lacks is below what condenser directions and voxels leave.
RECOMMENDED = Fidelity("wave", order=1)


class PoorFitWarning(UserWarning):
    """A descent has ended at a volume that explains its data less than empty medium does."""


class InterruptedRunError(Exception):
    """The user stopped a descent; its message says how to go on."""


@dataclass(frozen=True)
class Result:
    """What a reconstruction leaves: Δn (z, y, x) and its metrics, as in metrics.json."""

    delta: Float[Tensor, "z y x"]
    metrics: dict[str, object]


def load_data(config: Config) -> Measured:
    """The configuration's measured stack in the model's unit. Raises ConfigError or StackError."""
    if config.data is None:
        raise ConfigError("missing key data.path: a reconstruction needs a stack")
    camera = config.microscope.camera
    if camera is not None and camera.pixel_size is not None:
        raise ConfigError(
            f"microscope.camera.pixel_size: {camera.pixel_size} can be simulated; a reconstruction's pixels are its "
            "volume's voxels"
        )
    sheared = any(prism is not None for prism in config.acquisition.prisms)
    if sheared and not config.microscope.condenser_prism and config.reconstruction.start == "linear":
        raise ConfigError(
            "reconstruction.start: 'linear' needs a condenser prism, microscope.condenser_prism is false; use 'zero'"
        )
    if config.microscope.lenses is not None and config.reconstruction.start == "linear":
        raise ConfigError("reconstruction.start: 'linear' can't hold microscope.polarisation.pupil; use 'zero'")
    section = config.data
    stack = read_stack(section.path)
    expected = ExpectedStack(
        biases=tuple(None if prism is None else float(prism.bias) for prism in config.acquisition.prisms),
        focus=tuple(float(focus) for focus in config.acquisition.focus),
        pixel_size=config.volume.spacing[1:],
        pixels=config.volume.shape[1:],
        empty=tuple(_empty_field(config)),
    )
    normalisation = Normalisation(section.flatten, section.scale, section.offset, section.order)
    measured = prepare(stack, expected, normalisation)
    try:
        spatial_variance(torch.from_numpy(measured.data))
    except ValueError as error:
        raise StackError(f"{section.path}: {error}") from error
    return measured


def _empty_field(config: Config) -> list[float]:
    """What the model's empty volume gives behind each prism: 1 and sin²(bias/2) where nothing leaks or is stopped.

    In as many directions as the fidelity has, in many where it has yet to be planned.
    """
    nothing = torch.zeros(1, 1, 1, dtype=torch.float64)
    point = Volume(Grid((1, 1, 1), config.volume.spacing), nothing, config.volume.background)
    fidelity = Fidelity("projection", sources=200 if config.fidelity is None else config.fidelity.sources)
    with torch.no_grad():
        images = image(point, replace(config.microscope, camera=None), Acquisition(config.acquisition.prisms), fidelity)
    return images.flatten().tolist()


def reconstruct(
    config: Config, out: Path, device: torch.device, *, resume: bool = False, restart: bool = False
) -> Result:
    """Fit a volume to the configuration's stack and leave it in `out`, with metrics, log, configuration and figures.

    resume: go on from the checkpoint in `out`, if there is one. restart: begin anew in spite of one.
    Raises ConfigError, StackError and CheckpointError for bad input and ShortOfMemoryError where there is no room for
    the descent, before `out` is touched; InterruptedRunError on Ctrl-C, with a checkpoint saved.
    """
    fidelity = config.tolerance or config.fidelity or RECOMMENDED
    if isinstance(fidelity, Fidelity):
        config = replace(config, fidelity=fidelity)
    measured = load_data(config)
    data = torch.from_numpy(measured.data).to(device)
    check_volume(config.volume.grid, COPIES, device)
    if isinstance(fidelity, Fidelity):  # else one has yet to be planned
        _check_room(config, fidelity, data)
    identity = _identity(config, measured)
    saved = out / CHECKPOINT
    start: Checkpoint | None = None
    if saved.exists():
        if resume:
            start = checkpoint.load(saved, identity)
        elif not restart:
            raise CheckpointError(f"{saved}: an interrupted run; go on with --resume or begin anew with --restart")
    prepare_folder(out)

    last, rows = _descend(config, fidelity, data, out, identity, start)
    grid = config.volume.grid
    plans = list(last.plans)
    if not isinstance(fidelity, Fidelity):
        fidelity = current(last.plans)
    with torch.no_grad():
        volume = Volume(grid, last.delta, config.volume.background)
        modelled = image(volume, config.microscope, config.acquisition, fidelity).cpu()
    data, delta = data.cpu(), last.delta.cpu()
    metrics: dict[str, Any] = {"propagation": fidelity.propagation, **_metrics(measured, modelled, data, delta, last)}
    if plans:
        metrics["plans"] = plans
    if metrics["misfit"] > 1:
        warnings.warn(
            f"the misfit {metrics['misfit']:.3g} is above 1: empty medium would explain the stack better; "
            "a smaller learning_rate or more tv may help",
            PoorFitWarning,
            stacklevel=2,
        )
    write_volume(out / "volume.ome.tif", delta, grid)
    comments = "".join(f"# {announce_record(record)}\n" for record in plans)
    write_text(out / "config.resolved.toml", comments + dump(config))
    write_json(out / "metrics.json", metrics)
    prisms, focus = config.acquisition.prisms, measured.focus
    figures.save(figures.draw_images(data, modelled, prisms, focus, grid), out / "images.png")
    figures.save(figures.draw_sections({"": delta}, grid), out / "sections.png")
    figures.save(figures.draw_misfit(rows), out / "misfit.png")
    saved.unlink(missing_ok=True)
    return Result(delta, metrics)


def _check_room(config: Config, fidelity: Fidelity, data: Tensor) -> None:
    """Raise ShortOfMemoryError where a descent would take more memory than is free."""
    grid, recipe = config.volume.grid, config.reconstruction
    volume = Volume(grid, data.new_zeros(grid.shape), config.volume.background)
    wanted = foreseen(volume, config.microscope, config.acquisition, fidelity, gradient=True).least
    wanted += COPIES * math.prod(grid.shape) * data.element_size()
    if recipe.start == "linear":
        wanted = max(wanted, bytes_of_linear_start(grid, config.acquisition, data.element_size()))
    shape = "×".join(map(str, grid.shape))
    check_room(wanted, free_bytes(data.device), f"Steps of a reconstruction of {shape} voxels")


def _identity(config: Config, measured: Measured) -> str:
    """What the descent depends on, a line for each value: another of these is another descent."""
    fit = replace(
        config,
        data=None,  # as the descent sees them: by their digest
        specimen=None,
        simulation=SimulationSection(),
        reconstruction=replace(config.reconstruction, checkpoint_every=1),
    )
    return "\n".join([*flat(fit), f"data's sha256 = {hashlib.sha256(measured.data.tobytes()).hexdigest()}"])


def prepare_folder(out: Path) -> None:
    """Make sure that `out` is a folder that can be written to. Raises ConfigError."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        with written_whole(out / ".writable"):
            pass
        (out / ".writable").unlink()
    except OSError as error:
        raise ConfigError(f"{out}: can't be written to: {error.strerror or error}") from error


def _descend(
    config: Config, fidelity: Fidelity | float, data: Tensor, out: Path, identity: str, start: Checkpoint | None
) -> tuple[Step, list[Row]]:
    section = config.reconstruction
    rows = [] if start is None else list(start.rows)
    step = None if start is None else start.step
    announced = 0 if step is None else len(step.plans)
    steps = descend(
        data,
        config.volume.grid,
        config.volume.background,
        config.microscope,
        config.acquisition,
        fidelity,
        section,
        step,
    )
    with (
        _log(out / "log.csv", rows) as log,
        tqdm(total=section.steps, initial=len(rows), unit="step") as bar,
        _signals_kept() as check_signals,
    ):
        try:
            for step in steps:
                rows.append(_row(step))
                log.writerow(rows[-1])
                for record in step.plans[announced:]:
                    tqdm.write(announce_record(record))
                announced = len(step.plans)
                bar.set_postfix(misfit=f"{step.misfit:.4g}", refresh=False)
                bar.update()
                if step.number % section.checkpoint_every == 0:
                    checkpoint.save(out / CHECKPOINT, Checkpoint(step, rows, identity))
                check_signals()
        except KeyboardInterrupt:
            if step is None:
                raise InterruptedRunError("interrupted before the first step") from None
            if len(rows) < step.number:  # the signal came between the step and its row
                rows.append(_row(step))
                log.writerow(rows[-1])
            checkpoint.save(out / CHECKPOINT, Checkpoint(step, rows, identity))
            raise InterruptedRunError(
                f"interrupted after step {step.number} of {section.steps}; go on with --resume"
            ) from None
    assert step is not None
    return step, rows


@contextmanager
def _signals_kept() -> Iterator[Callable[[], None]]:
    """Gives what raises KeyboardInterrupt if a signal's was lost: Python ignores one that is raised in a destructor."""
    received: list[int] = []

    def check() -> None:
        if received:
            raise KeyboardInterrupt

    def keeping(handler: Callable[[int, FrameType | None], Any]) -> Callable[[int, FrameType | None], None]:
        def keep(number: int, frame: FrameType | None) -> None:
            received.append(number)
            handler(number, frame)

        return keep

    found = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    main = threading.current_thread() is threading.main_thread()  # which alone may set handlers
    handlers = {number: handler for number, handler in found.items() if main and callable(handler)}
    for number, handler in handlers.items():
        signal.signal(number, keeping(handler))
    try:
        yield check
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)


def _row(step: Step) -> Row:
    return step.number, step.misfit, step.loss, step.seconds


@contextmanager
def _log(path: Path, rows: list[Row]) -> Iterator[Any]:
    """log.csv open for further rows, the earlier ones in it already."""
    with path.open("w", newline="", encoding="utf-8", buffering=1) as file:
        writer = csv.writer(file)
        writer.writerow(("step", "misfit", "loss", "seconds"))
        writer.writerows(rows)
        yield writer


def _metrics(measured: Measured, modelled: Tensor, data: Tensor, delta: Tensor, last: Step) -> dict[str, object]:
    variance = spatial_variance(data)
    noise = [report.noise for report in measured.prisms]
    floor = None
    if None not in noise:
        floor = sum(n**2 / v for n, v in zip(noise, variance.tolist(), strict=True)) / len(noise)  # pyright: ignore[reportOptionalOperand]
    return {
        "misfit": float(gaussian(modelled, data, variance)),
        "noise_misfit": floor,
        "residual_rms": residual_rms(modelled, data),
        "steps": last.number,
        "seconds": round(last.seconds, 3),
        "delta": {"min": float(delta.min()), "max": float(delta.max()), "mean": float(delta.mean())},
        "prisms": [asdict(report) for report in measured.prisms],
    }
