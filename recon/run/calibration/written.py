"""What a calibration leaves in its folder."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from recon.calibration.trials.orders import Orders
from recon.config.conversion import dump, dump_microscope
from recon.config.schema import CalibrationSection, Config
from recon.run.calibration.found import FoundQuantity
from torchdic.files.whole import write_json, write_text

CALIBRATED, CALIBRATION, MICROSCOPE = "calibrated.toml", "calibration.json", "microscope.toml"
# Of each of them an earlier calibration's would be replaced.
RESULTS = (CALIBRATION, CALIBRATED, MICROSCOPE)


def write_calibration(
    out: Path,
    config: Config,
    orders: Orders | None,
    found: Sequence[FoundQuantity],
    gauges: Sequence[str],
    *,
    with_microscope: bool,
) -> None:
    """Write the calibrated configuration, each quantity as JSON, and the microscope alone where it is to be reused.

    Raises WriteError where a file can't be written.
    """
    comments = "".join(f"# {quantity.words}\n" for quantity in found)
    heading = f"# by torchdic calibrate\n{comments}"
    calibrated = replace(config, calibration=CalibrationSection())
    write_text(out / CALIBRATED, heading + dump(calibrated))
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
        use = f'# include = "{MICROSCOPE}" at the top of another stack\'s configuration uses these\n'
        write_text(out / MICROSCOPE, heading + use + dump_microscope(config))
        written.append(MICROSCOPE)
    print(f"{out / written[0]}, {', '.join(written[1:])}")
