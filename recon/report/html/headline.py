"""What a report says first: what kind of run it is, the verdict in plain words, and the numbers that one asks for."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any, Literal

from recon.evidence.ends import open_ends
from recon.report.html.folder import Folder, table_in, tables_in
from recon.report.html.images import Images
from recon.report.html.volumes import Volumes
from recon.report.html.words import duration, is_number, percent, short, sure, times
from recon.report.verdict import FOLLOWS, LEAST

RECONSTRUCTION = "Reconstruction"

# What a folder holds, by the file that says so: the kind of its run, and what there is to say where nothing is judged.
# The first file that is there gives the page its title.
KINDS = {
    "volume.ome.tif": (RECONSTRUCTION, ""),
    "comparison.json": (
        "Demonstration",
        "A bead of known index, reconstructed in three ways and held against the truth",
    ),
    "calibration.json": ("Calibration", "What the images of a stack tell of the microscope, and how surely"),
    "stack.ome.tif": ("Simulation", "The images that a known specimen would give"),
    "phase.ome.tif": ("Phase", "The phase behind one image, on an arbitrary scale"),
    "coverage.json": ("Coverage", "Which structures an acquisition shows, and which it can't"),
    "work_precision.json": ("Work and precision", "What accuracy costs in time and memory"),
    "fits.json": ("Work and precision", "What accuracy of reconstructions costs in time"),
    "plan.json": ("Plan", "How carefully images must be computed, and which effects matter"),
}


@dataclass(frozen=True)
class Headline:
    """The verdict.

    state: whether the volume explains the images; "open" where nothing is judged, or more is to be said. words: in one
    line. further: sentences that go with it. causes: of a poor fit, each (name, reason, advice).
    """

    state: Literal["good", "poor", "open"]
    words: str
    further: tuple[str, ...] = ()
    causes: tuple[tuple[str, str, str], ...] = ()


@dataclass(frozen=True)
class Fact:
    """A number that one asks for. name: of it. value: with its unit. note: what goes with it."""

    name: str
    value: str
    note: str = ""


def kind_of(folder: Folder) -> tuple[str, str] | None:
    """The kind of run a folder is of, and what there is to say of it; None where it holds no result."""
    return next((kind for name, kind in KINDS.items() if folder.has(name)), None)


def headline(kind: tuple[str, str], metrics: dict[str, Any]) -> Headline:
    """What to say first. kind: of the run, as of `kind_of`. metrics: of metrics.json; empty where it is missing."""
    name, words = kind
    if name != RECONSTRUCTION:
        return Headline("open", words)
    if not metrics:
        return Headline("open", "Not judged: the run isn't finished, or its metrics.json is missing")
    verdict = table_in(metrics, "verdict")
    if not isinstance(verdict.get("words"), str):
        return Headline("open", "Not judged: the run is older than verdicts are")
    measured, _, judgement = verdict["words"].partition(": ")
    lacks = table_in(metrics, "seen").get("lacks")
    first, *others = judgement.split("; ")
    causes = tuple(_causes(verdict))
    if verdict.get("poor"):
        advice = () if causes else others
        further = [first, measured, *advice, lacks]
        return Headline("poor", "The volume does not explain the images", _sentences(further), causes)
    state = "open" if _follows_noise(metrics, verdict) or _goes_on(verdict) else "good"
    return Headline(state, _sentence(first), _sentences([measured, *others, lacks]))


def facts(
    metrics: dict[str, Any],
    config: dict[str, Any],
    bars: dict[str, Any],
    volumes: Volumes | None,
    images: Images | None,
) -> tuple[Fact, ...]:
    """The numbers that one asks for. metrics, config, bars: of the folder's files; empty where one is missing."""
    found = [*_measures(bars), *_of_volume(volumes, config), *_of_fit(metrics)]
    if images is not None:
        prisms, planes, *pixels = images.shape
        beside = f"prism settings × focus planes, of {times(pixels)} pixels"
        found.append(Fact("Images", times((prisms, planes)), beside))
    return tuple(found)


def _measures(bars: dict[str, Any]) -> Iterator[Fact]:
    """What error bars say of the specimen as a whole."""
    region = table_in(table_in(bars, "regions"), "specimen")
    names = {"volume_um3": ("Volume", " µm³"), "mean_index": ("Mean index", ""), "dry_mass_pg": ("Dry mass", " pg")}
    for key, (name, unit) in names.items():
        known = table_in(region, key)
        if known:
            yield Fact(name, f"{sure(known.get('value'), known.get('error'))}{unit}", "of the specimen, ± 1 deviation")


def _of_volume(volumes: Volumes | None, config: dict[str, Any]) -> Iterator[Fact]:
    if volumes is None:
        return
    medium = table_in(config, "volume").get("background")
    beside = f"above the medium's index {short(medium, 5)}" if medium is not None else "above the medium's index"
    yield Fact(volumes.shown[0]["title"], f"{short(volumes.low)} … {short(volumes.high)}", beside)
    grid = volumes.grid
    sizes = f"{times(grid.shape)} voxels of {times(grid.spacing)} µm (z, y, x)"
    yield Fact("Field", f"{times(grid.extent)} µm", sizes)


def _of_fit(metrics: dict[str, Any]) -> Iterator[Fact]:
    verdict, seen = table_in(metrics, "verdict"), table_in(metrics, "seen")
    misfit, ratio, share = metrics.get("misfit"), verdict.get("ratio"), seen.get("share")
    if ratio is not None:
        yield Fact("Misfit", f"{short(ratio, 4)} × noise", f"{short(misfit)}, where an empty volume has 1")
    elif misfit is not None:
        yield Fact("Misfit", short(misfit), "an empty volume has 1; the noise isn't known")
    if "explained" in verdict:
        yield Fact("Contrast explained", percent(verdict["explained"], 1), "of what isn't noise")
    if share is not None:
        yield Fact("Seen", percent(share), "of the frequencies that the apertures pass")
    if "method" in metrics:
        steps = metrics.get("steps")
        taken = f", {steps} steps" if steps else ""
        yield Fact(
            "Fit", duration(metrics.get("seconds")), f"{metrics['method']}{taken}, {metrics.get('propagation', '')}"
        )


def _follows_noise(metrics: dict[str, Any], verdict: dict[str, Any]) -> bool:
    """Whether the volume follows the noise, so that there is something to do although it explains the images."""
    noise, ratio = metrics.get("noise_misfit"), verdict.get("ratio")
    return bool(noise and noise >= LEAST and ratio is not None and ratio < FOLLOWS)


def _goes_on(verdict: dict[str, Any]) -> bool:
    """Whether the specimen doesn't end within the volume's depth. Verdicts of earlier versions don't tell."""
    found = verdict.get("ends")
    return isinstance(found, list) and len(found) == 2 and all(map(is_number, found)) and open_ends(*found) is not None


def _causes(verdict: dict[str, Any]) -> Iterator[tuple[str, str, str]]:
    for cause in tables_in(verdict, "causes"):
        name, reason, advice = (str(cause.get(part, "")) for part in ("name", "reason", "advice"))
        yield _sentence(name), reason, advice


def _sentences(parts: Iterable[object]) -> tuple[str, ...]:
    """Those of the parts that are words, as sentences."""
    return tuple(f"{_sentence(part)}." for part in parts if isinstance(part, str) and part)


def _sentence(words: str) -> str:
    return words[:1].upper() + words[1:]
