"""What a calibration leaves in its folder."""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from recon.calibration.foreknowledge import Foreknowledge
from recon.config.rewritten import Source, rewritten, rewritten_microscope
from recon.config.schema import CalibrationSection, Config
from recon.run.calibration.assumed import corrected
from recon.run.calibration.found import DIRECTION, LENGTH, Calibration, FoundQuantity, rounded
from recon.run.calibration.provenance import provenance
from torchdic import __version__
from torchdic.files.whole import write_json, write_text

CALIBRATED, CALIBRATION, MICROSCOPE = "calibrated.toml", "calibration.json", "microscope.toml"
# Of each of them an earlier calibration's would be replaced.
RESULTS = (CALIBRATION, CALIBRATED, MICROSCOPE)

_UNITS = "Lengths are in µm, angles in degrees from right towards down; indices and apertures have no unit."


def write_calibration(
    out: Path,
    told: Config,
    calibration: Calibration,
    gauges: Sequence[str],
    source: Source,
    *,
    with_microscope: bool,
) -> None:
    """Write the calibrated configuration, each quantity as JSON, and the microscope alone where it is to be reused.

    told: the configuration before. source: of its file, whose keys and comments are kept.
    Raises WriteError where a file can't be written.
    """
    orders, found = calibration.orders, calibration.found
    config = calibration.config
    source = replace(source, comments=corrected(source.comments, told.assumed))
    comments = provenance(told, config, orders, found, source.comments)
    head = [f"Written by torchdic calibrate ({__version__}), which found:"]
    head += [f"  {quantity.words}" for quantity in found]
    if config.assumed:
        head += ["Correct what is assumed, and take its name out of this list; a reconstruction warns of the others."]
    head += ["Each value says where it comes from; what is calibrated, with one standard deviation.", _UNITS]
    write_text(out / CALIBRATED, rewritten(config, out, source, comments, head))
    record: dict[str, Any] = {quantity.name: quantity.as_json() for quantity in found}
    if orders is not None:
        record["short fits"] = [
            {"name": tried.otherwise.name, "misfit": tried.misfit, "round": tried.rounds} for tried in orders.tried
        ]
        record["noise misfit"] = orders.noise
    record["not told by any image"] = list(gauges)
    write_json(out / CALIBRATION, record)
    written = [CALIBRATED, CALIBRATION]
    if with_microscope:
        use = f'include = "{MICROSCOPE}" at the top of another stack\'s configuration uses these.'
        reused = replace(config, calibration=_known_by_bead(found))
        write_text(out / MICROSCOPE, rewritten_microscope(reused, source, comments, [*head, use]))
        written.append(MICROSCOPE)
    print(f"{out / written[0]}, {', '.join(written[1:])}")


def _known_by_bead(found: Sequence[FoundQuantity]) -> CalibrationSection:
    """How closely a bead tells the prisms: what other stacks' calibrations weigh their images against."""
    unsure = {quantity.name: quantity for quantity in found if quantity.told}
    length = unsure[LENGTH]
    share = max(deviation / value for deviation, value in zip(length.uncertainty, length.value, strict=True))
    within, *angles = Foreknowledge(share, *(max(unsure[name].uncertainty) for name in ("bias", DIRECTION))).limits
    bias, angle = (math.radians(rounded(math.degrees(min(each, math.pi / 2)), 2)) for each in angles)
    return CalibrationSection(length_within=rounded(min(within, 0.99), 2), bias_within=bias, angle_within=angle)
