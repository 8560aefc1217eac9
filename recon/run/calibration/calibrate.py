"""From a configuration and its stack to a calibrated configuration: signs and orders first, then values."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch

from recon.calibration.known_specimen import ModelledSpecimen
from recon.calibration.trials.orders import Orders
from recon.config.rewritten import Source
from recon.config.schema import BeadSection, Config, ConfigError
from recon.fit.bounds import Bounds
from recon.recording.survey.survey import SMALLEST
from recon.run.calibration.by_bead import by_bead, check_bead
from recon.run.calibration.by_levels import by_levels
from recon.run.calibration.by_specimen import by_specimen
from recon.run.calibration.found import Calibration, FoundQuantity
from recon.run.calibration.stack import CalibrationStack
from recon.run.calibration.written import RESULTS, write_calibration
from recon.run.folder.prepared import prepare_folder
from recon.run.folder.results import check_no_results

# What no image tells, whatever is fitted.
GAUGES = (
    "a Δn that is the same everywhere (the volume's background is as told)",
    "focus against z: planes that are all moved by the same distance move the volume",
    "shear and bias reversed together: they give the same images",
    "the sign of Δn: −Δn with reversed shears and planes gives the same images (bounds of Δn say which)",
)

# What a configuration may list as assumed, by the quantity that tells it.
ASSUMED = {
    "signs and orders": "order of the planes",
    "bias": "bias",
    "shear's length": "shear's length",
    "shear's angle": "shear's angle",
    "condenser na": "condenser's NA",
}


def calibrate(
    config: Config,
    out: Path,
    device: torch.device,
    bead: ModelledSpecimen | None = None,
    *,
    source: Source | None = None,
    restart: bool = False,
) -> Calibration:
    """Find what the stack's images tell of the optics, and leave calibrated.toml and calibration.json in a folder.

    bead: the one that [calibration] names, where it names one. A line is printed for each quantity, and a table of the
    signs and orders.
    source: of the configuration's file, whose keys and comments calibrated.toml keeps.
    restart: replace what an earlier calibration has left there.
    Raises ConfigError and StackError for bad input, FinishedError where the folder has a calibration, and
    ShortOfMemoryError where the fits have no room, before `out` is touched.
    """
    check_no_results(out, RESULTS, restart=restart)
    section = config.calibration.bead
    if (section is None) != (bead is None):
        raise ConfigError("calibration.bead: a bead is fitted where the configuration names one, and only there")
    if all(prism is None for prism in config.acquisition.prisms):
        raise ConfigError("acquisition.prisms: all images are bright field: there is no shear or bias to calibrate")
    if section is not None:
        check_bead(config, section)
    stack = CalibrationStack.read(config, device)
    if min(sides := stack.data.shape[2:]) < SMALLEST:
        pixels, least = (" × ".join(map(str, v)) for v in (sides, (SMALLEST, SMALLEST)))
        raise ConfigError(f"data.path: images of {pixels} pixels tell nothing of the optics; give {least} or more")
    stack.check_room(bounds_of(config))
    prepare_folder(out)
    orders = stack.orders(bounds_of(config))
    found = [_of_orders(orders, config)]
    if orders is not None:
        print(f"\nsigns and orders, by short fits of what may have been recorded:\n{orders.table()}\n")
        stack = stack.with_config(replace(config, acquisition=orders.chosen.acquisition))
    stack, by_background = by_levels(stack)
    if bead is not None and section is not None:
        stack, others = by_bead(stack, bead, section)
        # a bead tells the biases better
        by_background = [q for q in by_background if q.name not in {other.name for other in others}]
    else:
        stack, others = by_specimen(stack, {q.name for q in by_background if q.told})
        told = {q.name for q in by_background}
        others = [q for q in others if q.name not in told]
    found += [*by_background, *others]
    for quantity in found:
        print(quantity.words)
    print(f"not told by any image: {'; '.join(GAUGES)}")
    known = [quantity for quantity in found if quantity is not found[0] or (orders is not None and orders.told)]
    calibration = Calibration(_known(stack.config, known), orders, tuple(found))
    write_calibration(out, config, calibration, GAUGES, source or Source(), with_microscope=bead is not None)
    return calibration


def _known(config: Config, found: Sequence[FoundQuantity]) -> Config:
    """The configuration, in which what was told is no longer assumed."""
    told = {ASSUMED.get(quantity.name) for quantity in found if quantity.told}
    return replace(config, assumed=tuple(name for name in config.assumed if name not in told))


def bounds_of(config: Config) -> Bounds:
    """The bounds of Δn: a bead's own, or those of the reconstruction."""
    bead: BeadSection | None = config.calibration.bead
    if bead is None:
        return config.reconstruction.bounds
    contrast = bead.index - config.volume.background
    return Bounds(0.0, None) if contrast > 0 else Bounds(None, 0.0)


def _of_orders(orders: Orders | None, config: Config) -> FoundQuantity:
    name, before = "signs and orders", "as declared"
    if orders is None:
        why = "no prism has a linear response, without which no short fit can be made"
        return FoundQuantity(name, "", before, before, None, why, told=False)
    chosen = next(tried for tried in orders.tried if tried.otherwise is orders.chosen)
    others = [tried for tried in orders.tried if tried is not chosen and tried.rounds == chosen.rounds]
    unit = orders.noise or 1.0
    how = f"short fits of {len(orders.tried)} descriptions: misfit {chosen.misfit / unit:.3f} × the noise's"
    if others:
        nearest = min(others, key=lambda tried: (tried.otherwise is not orders.rival, tried.loss))
        how += f", {nearest.misfit / unit:.3f} × with {nearest.otherwise.name}"
    limits = bounds_of(config).lower, bounds_of(config).upper
    if None in limits and 0 not in limits:
        how += "; the sign of Δn is free: signs and planes reversed together explain the images as well with −Δn"
    if orders.rival is not None:
        how += f"; the images can't tell {orders.chosen.name!r} from {orders.rival.name!r}: "
        how += "noise alone moves a misfit so far"
        how += "" if orders.chosen.mistakes else ", so what was declared stays"
    if orders.chosen.mistakes:
        how += f"; {orders.chosen.what}: {orders.chosen.advice}"
    # a changed description is found, even where another one explains the images as well as it
    return FoundQuantity(name, "", before, orders.chosen.name, None, how, orders.told or orders.chosen.mistakes > 0)
