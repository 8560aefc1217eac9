"""The page: what a folder holds, brought together in a template, and written as report.html."""

import base64
from collections.abc import Iterator
from datetime import datetime
from functools import cache
from importlib.resources import files
from pathlib import Path
from shlex import quote
from typing import Any

import matplotlib as mpl
import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup
from plotly.offline import get_plotlyjs

from recon.report.html.folder import Folder, table_in, tables_in
from recon.report.html.headline import RECONSTRUCTION, facts, headline, kind_of
from recon.report.html.images import Images, images_of
from recon.report.html.packed import packed
from recon.report.html.plots import draw_course, draw_spectrum
from recon.report.html.tables import runs, tables
from recon.report.html.volumes import volumes_of
from recon.report.html.words import is_number, short
from torchdic import __version__
from torchdic.files.whole import write_text

REPORT, BARS = "report.html", "error_bars.json"

# In a page's head it says who made it; in a page without it nothing is replaced.
_MADE = '<meta name="generator" content="torchdic'

MAPS = ("gray", "viridis", "magma", "RdBu_r")
# In the order in which they are run.
SCRIPTS = ("bytes.js", "sections.js", "images.js", "surface.js")

# Pictures for which the page has no view, with what they show.
PICTURES = {
    "coverage.png": "The frequencies that are seen, along and across the shear, and what becomes of a point",
    "error_bars.png": "Sections of Δn and of its standard deviations, and lines through them with error bars",
    "comparison.png": "Sections through the true volume and the reconstructed ones",
    "phase.png": "The image, flattened, beside its phase",
    "work_precision.png": "Error against seconds and memory, a mark for each way to compute",
    "fits.png": "Error of reconstructions against seconds, a mark for each",
}
# Those that stand in for the view of volumes, and of images, where scripts don't run or its files are missing.
OF_VOLUMES = {"sections.png": "Sections through Δn along z, y and x"}
OF_IMAGES = {
    "images.png": "Measured and modelled images and their residuals",
    "stack.png": "Simulated images by prism setting and focus plane",
}
CONFIGURATIONS = {
    "config.resolved.toml": "The whole configuration, as it was used",
    "calibrated.toml": "The calibrated configuration",
}
# What a reconstruction may have, by file: what the page lacks without it, and how it is made.
WANTED = {
    "metrics.json": "the verdict and its numbers",
    "images.ome.tif": "measured and modelled images, and the residual's spectrum",
    "log.csv": "the misfit step by step",
    "config.resolved.toml": "the configuration",
    "run.json": "command, time, memory and versions",
    "calibration.json": "what the images tell of the microscope: torchdic calibrate, into a folder of its own",
    "coverage.json": "which structures the images show: torchdic coverage, into a folder of its own",
    BARS: "error bars: torchdic error-bars finds them",
}


class ForeignReportError(ValueError):
    """A folder holds a report.html that isn't torchdic's: one line."""


def leave_report(out: Path) -> Path | None:
    """Write report.html into a folder of results, from its files alone; returns it, or None where there is no result.

    Raises ForeignReportError where a file of that name isn't torchdic's, and WriteError where there is no room.
    """
    folder, path = Folder(out), out / REPORT
    kind = kind_of(folder)
    if kind is None:
        return None
    if not _is_ours(path):
        raise ForeignReportError(
            f"{path}: isn't torchdic's: move it away, and torchdic report {quote(str(out))} makes one"
        )
    write_text(path, page(folder, kind))
    return path


def _is_ours(path: Path) -> bool:
    """Whether a page may be replaced: it is missing, or was made here before."""
    if not path.exists():
        return True
    try:
        with path.open("rb") as file:
            return _MADE.encode() in file.read(1000)
    except OSError:  # a folder, or what can't be read
        return False


def page(folder: Folder, kind: tuple[str, str]) -> str:
    """The page of a folder, as HTML. kind: of its run, as of `kind_of`."""
    metrics, config, bars = (folder.table(name) for name in ("metrics.json", "config.resolved.toml", BARS))
    earlier = folder.is_older(BARS, "volume.ome.tif")
    volumes = volumes_of(folder)
    images = images_of(folder, table_in(config, "acquisition"))
    rows = folder.rows("log.csv")
    views = ((volumes, OF_VOLUMES), (images, OF_IMAGES))
    instead = {name: words for view, names in views if view is not None for name, words in names.items()}
    shown_alone = {name: words for view, names in views if view is None for name, words in names.items()}
    noise = metrics.get("noise_misfit") if is_number(metrics.get("noise_misfit")) else None
    data = {
        "volumes": [] if volumes is None else volumes.shown,
        "surfaces": None if volumes is None or volumes.surfaces is None else volumes.surfaces.as_json(),
        "images": None if images is None else images.shown,
        "maps": {name: packed(_colours(name)) for name in MAPS},
    }
    shown = {
        "kind": kind[0],
        "judged": kind[0] == RECONSTRUCTION,
        "headline": headline(kind, metrics),
        "facts": facts(metrics, config, {} if earlier else bars, volumes, images),
        "volumes": volumes,
        "images": images,
        "course": Markup(draw_course(rows, noise)) if rows else None,
        "rows": rows,
        "noise": noise,
        "spectrum": None if images is None else _spectrum(images, metrics, config),
        "tables": tables(folder, metrics, bars, earlier=earlier),
        "runs": runs(folder),
        "pictures": tuple(_pictures(folder, {**PICTURES, **shown_alone})),
        "still": tuple(_pictures(folder, instead)),
        "configs": tuple(_configs(folder)),
        "missing": tuple(_missing(folder, kind[0])),
        "data": data,
    }
    written = _template().render(
        **shown,
        name=folder.name,
        version=__version__,
        made=datetime.now().astimezone().strftime("%Y-%m-%d %H:%M"),
        damaged=folder.damaged,
        style=_source("page.css"),
        scripts=[_source(name) for name in SCRIPTS],
        plotly=_plotly() if data["surfaces"] is not None else None,
        short=short,
    )
    # bytes of a file's name that are no UTF-8 can't stand in a page that is
    return written.encode("utf-8", "replace").decode("utf-8")


def _spectrum(images: Images, metrics: dict[str, Any], config: dict[str, Any]) -> Markup | None:
    """The residual's spectrum, where there are models: over the noise's power if that is known, else over its mean."""
    if not images.spectra:
        return None
    noises = [noise for one in tables_in(metrics, "prisms") if is_number(noise := one.get("noise")) and noise > 0]
    known = len(noises) == len(images.spectra)
    lines = []
    for number, (frequency, power) in enumerate(images.spectra):
        level = noises[number] ** 2 if known else float(power.mean()) or 1.0
        lines.append((f"prism {number + 1}", frequency, power / level))
    unit = "power of the residual ÷ noise" if known else "power of the residual ÷ its mean"
    return Markup(draw_spectrum(lines, _passed(config), unit))


def _passed(config: dict[str, Any]) -> float | None:
    """The highest frequency that an objective and a condenser pass, in 1/µm; None where one of them isn't told."""
    microscope = table_in(config, "microscope")
    objective, condenser = (table_in(microscope, part).get("na") for part in ("objective", "condenser"))
    wavelength = microscope.get("wavelength")
    if is_number(objective) and is_number(condenser) and is_number(wavelength):
        return (objective + condenser) / wavelength
    return None


def _pictures(folder: Folder, names: dict[str, str]) -> Iterator[tuple[str, str, str]]:
    """The pictures of these names that a folder holds: name, what it shows, and the picture itself as an address."""
    for name, words in names.items():
        if (picture := folder.picture(name)) is not None:
            yield name, words, f"data:image/png;base64,{base64.b64encode(picture).decode('ascii')}"


def _configs(folder: Folder) -> Iterator[tuple[str, str, str]]:
    """The configurations that a folder holds: name, what it is, and its text."""
    for name, words in CONFIGURATIONS.items():
        if (text := folder.text(name)) is not None:
            yield name, words, text


def _missing(folder: Folder, kind: str) -> Iterator[str]:
    """What the page of a reconstruction lacks, a line each."""
    if kind == RECONSTRUCTION:
        yield from (f"{name} is not in this folder: {words}" for name, words in WANTED.items() if not folder.has(name))


def _colours(name: str) -> np.ndarray:
    """A map's 256 colours as bytes (red, green, blue)."""
    return (mpl.colormaps[name](np.arange(256))[:, :3] * 255).round().astype(np.uint8)


@cache
def _plotly() -> str:
    return packed(get_plotlyjs().encode())


@cache
def _source(name: str) -> Markup:
    """A style or a script of the template, as it is."""
    return Markup((files("recon.report.html") / "template" / name).read_text(encoding="utf-8"))


@cache
def _template():
    loader = PackageLoader("recon.report.html", "template")
    made = Environment(loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    return made.get_template("page.html")
