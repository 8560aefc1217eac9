"""Tables of a report: what was calibrated, covered, measured and compared, each from a file of the folder."""

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from recon.report.html.folder import Folder, list_in, table_in, tables_in
from recon.report.html.words import NONE, duration, percent, short, size, sure

# The calibrated quantity that is a direction: a full turn makes no difference.
DIRECTION = "shear's angle"


@dataclass(frozen=True)
class Table:
    """A table under a heading.

    title: the heading. head: of its columns. rows: the first cell of each names it. note: what is to be said of it.
    """

    title: str
    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    note: str = ""


def tables(folder: Folder, metrics: dict[str, Any], bars: dict[str, Any], *, earlier: bool) -> tuple[Table, ...]:
    """All tables that a folder's files fill, but those of its runs.

    metrics, bars: of metrics.json and error_bars.json. earlier: whether the bars are those of an earlier volume.
    """
    made = (
        _comparison(folder.records("comparison.json")),
        _regions(bars, earlier),
        _calibration(folder.table("calibration.json")),
        _coverage(folder.table("coverage.json")),
        _changes(folder.table("coverage.json")),
        _effects(folder.table("plan.json")),
        _prisms(metrics),
        _learned(metrics),
    )
    return tuple(table for table in made if table is not None and table.rows)


def runs(folder: Folder) -> tuple[Table, ...]:
    """The commands that left the folder's files: when, their time and memory, and with which versions."""
    return tuple(
        Table(f"torchdic {name}", ("", ""), tuple(_run(record)))
        for name, record in folder.table("run.json").items()
        if isinstance(record, dict)
    )


def _run(record: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    yield "Command", str(record.get("command", NONE))
    yield "Finished", str(record.get("finished", NONE))
    yield (
        "Time",
        f"{duration(record.get('seconds'))}, of which the processor worked {duration(record.get('processor_seconds'))}",
    )
    yield "Memory at most", size(record.get("peak_bytes"))
    if record.get("gpu_peak_bytes") is not None:
        yield "GPU's memory at most", size(record["gpu_peak_bytes"])
    yield "Device", str(record.get("device", NONE))
    versions = record.get("versions")
    if isinstance(versions, dict):
        yield "Versions", ", ".join(f"{name} {version}" for name, version in versions.items())


def _comparison(scores: list[dict[str, Any]]) -> Table:
    head = "Propagation", "Error of the volume", "Mean Δn in the bead", "Misfit", "Time"
    rows = tuple(
        (
            str(one.get("propagation")),
            short(one.get("volume_error")),
            short(one.get("mean_delta")),
            short(one.get("misfit")),
            duration(one.get("seconds")),
        )
        for one in scores
    )
    note = "The error is the rms difference from the true Δn over the rms of that: an empty volume has 1."
    return Table("Comparison with the truth", head, rows, note)


def _regions(bars: dict[str, Any], earlier: bool) -> Table:
    regions = table_in(bars, "regions")
    numbers = {name: table_in(regions, name) for name in regions}
    rows = tuple(
        (name, *(_known(table_in(one, key)) for key in ("volume_um3", "mean_index", "dry_mass_pg")))
        for name, one in numbers.items()
    )
    near = table_in(bars, "inside_and_near")
    whole, noise, lost = (short(near.get(part), 2) for part in ("whole", "noise", "lost"))
    note = (
        f"± 1 standard deviation. Δn inside and near the specimen is known to ± {whole}: noise makes ± {noise} "
        f"and what is lost ± {lost}. What the images don't show at all, and what is wrong with the model, is in no bar."
    )
    return Table(
        "Error bars of an earlier volume" if earlier else "Error bars",
        ("Part", "Volume, µm³", "Mean index", "Dry mass, pg"),
        rows,
        note,
    )


def _known(value: Mapping[str, Any]) -> str:
    return sure(value.get("value"), value.get("error"))


def _calibration(found: dict[str, Any]) -> Table:
    rows = tuple(
        (
            name,
            _value(name, one, "value") if one.get("found") else "left as told",
            _value(name, one, "uncertainty"),
            _value(name, one, "before"),
            str(one.get("how", "")),
        )
        for name, one in found.items()
        if isinstance(one, dict) and "how" in one
    )
    gauges = list_in(found, "not told by any image")
    note = f"No image tells: {'; '.join(map(str, gauges))}." if gauges else ""
    return Table("Calibration", ("Quantity", "Found", "± 1 deviation", "Told", "How"), rows, note)


def _value(name: str, quantity: Mapping[str, Any], part: str) -> str:
    """A part of a calibrated quantity, angles in degrees."""
    value, unit = quantity.get(part), quantity.get("unit")
    in_rad = unit == "rad"
    numbers = [math.degrees(one) if in_rad else one for one in _numbers(value)]
    if in_rad and name == DIRECTION and part != "uncertainty":
        numbers = [degrees % 360 for degrees in numbers]
    if not numbers:
        return NONE if value is None else str(value)
    if len(numbers) > 4:
        told = f"{short(min(numbers), 4)} … {short(max(numbers), 4)}"
    else:
        told = ", ".join(short(one, 2 if part == "uncertainty" else 4) for one in numbers)
    return f"{told}{'°' if in_rad else f' {unit}' if unit else ''}"


def _numbers(value: object) -> list[float]:
    """The numbers of a value, of a list of them, or of a table."""
    if isinstance(value, int | float) and not isinstance(value, bool):
        return [float(value)]
    parts: Iterable[object] = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
    return [number for part in parts for number in _numbers(part)]


def _coverage(seen: dict[str, Any]) -> Table:
    widths = table_in(seen, "point_width_um")
    rows = [
        ("Frequencies that are seen", percent(seen.get("seen_share")), "of those that the apertures pass"),
        ("A point's width across z", f"{short(widths.get('finest'))} to {short(widths.get('coarsest'))} µm", ""),
        ("A point's width along z", f"{short(widths.get('axial'))} µm", ""),
        ("Δn of a voxel", f"± {short(seen.get('deviation'), 2)}", f"± {short(seen.get('deviation_before'), 2)} before"),
    ]
    return Table("Coverage", ("", "", ""), tuple(rows) if seen else ())


def _changes(seen: dict[str, Any]) -> Table:
    rows = tuple(
        (str(one.get("change")), percent(one.get("seen_share")), short(one.get("images")))
        for one in tables_in(seen, "changes")
    )
    return Table("What single changes would add", ("Change", "Seen then", "Times the images"), rows)


def _effects(plan: dict[str, Any]) -> Table:
    rows = tuple(
        (
            str(one.get("name")),
            "yes" if one.get("needed") else "no",
            short(one.get("error"), 2),
            percent(one.get("cost")),
            str(one.get("note", "")),
        )
        for one in tables_in(plan, "effects")
    )
    return Table("Effects", ("Effect", "Needed", "Error without", "Cost", "How it is known"), rows)


def _prisms(metrics: dict[str, Any]) -> Table:
    left = list_in(metrics, "residual_rms")
    rows = tuple(
        (
            f"Prism {number}",
            short(one.get("noise")),
            short(left[number - 1]) if number <= len(left) else NONE,
            short(one.get("background")),
            percent(one.get("flicker"), 1),
            percent(one.get("unevenness"), 1),
        )
        for number, one in enumerate(tables_in(metrics, "prisms"), 1)
    )
    head = "Setting", "Noise", "Residual, rms", "Background", "Flicker", "Unevenness"
    note = "Noise and residual are in units of the empty bright field, the background in those of the file."
    return Table("What was measured in the stack", head, rows, note)


def _learned(metrics: dict[str, Any]) -> Table:
    learned = table_in(metrics, "learned").items()
    rows = tuple((name, _spread(numbers)) for name, value in learned if (numbers := _numbers(value)))
    note = "As they are computed with: lengths in µm, angles in rad, brightness relative to the stack's own."
    return Table("Learned beside Δn", ("Quantity", "Value, or least … greatest of several"), rows, note)


def _spread(numbers: list[float]) -> str:
    if len(numbers) == 1:
        return short(numbers[0], 4)
    return f"{short(min(numbers), 4)} … {short(max(numbers), 4)}"
