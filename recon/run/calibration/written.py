"""What a calibration leaves in its folder."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from recon.config.rewritten import Source, rewritten, rewritten_microscope
from recon.config.schema import CalibrationSection, Config
from recon.run.calibration.found import Calibration
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
    config = replace(calibration.config, calibration=CalibrationSection())
    source = source.without("calibration")
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
        write_text(out / MICROSCOPE, rewritten_microscope(config, source, comments, [*head, use]))
        written.append(MICROSCOPE)
    print(f"{out / written[0]}, {', '.join(written[1:])}")
