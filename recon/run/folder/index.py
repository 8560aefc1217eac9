"""README.txt of a folder of results: a line for each file that is in it."""

from pathlib import Path

from torchdic import __version__
from torchdic.files.whole import write_text

INDEX = "README.txt"

# What each file is, by its name, in the order in which one looks at them.
FILES = {
    "report.html": "all results on one page: the verdict, sections, images, numbers; opens in a browser",
    "volume.ome.tif": "Δn (z, y, x), the index above the medium's, at its scale in µm: see it by torchdic view",
    "sections.png": "sections through the volume along z, y and x",
    "images.png": "measured and modelled images, and what the model leaves of them",
    "images.ome.tif": "every plane as it was measured and as the model has it, two channels for each prism",
    "metrics.json": "the verdict, misfit, what was learned, what was measured in the stack",
    "misfit.png": "misfit and priors, step by step",
    "log.csv": "the same as numbers: a row for each step",
    "checkpoint.pt": "to go on from, with --resume; error-bars needs it too",
    "volume.interrupted.ome.tif": "Δn of a later run in this folder, which was interrupted",
    "opl.ome.tif": "optical path lengths in µm, plane by plane",
    "sd.ome.tif": "standard deviation of each voxel of the volume, by noise",
    "error.ome.tif": "standard deviation of each voxel's whole error: noise, and what is lost",
    "error_bars.png": "the volume with its error bars",
    "error_bars.json": "volume, mean index and dry mass of each region, with their errors",
    "refits": "the fits that the error bars come from; they serve again",
    "calibrated.toml": "the configuration with what was found, for torchdic reconstruct",
    "calibration.json": "each quantity: value, uncertainty, how it was found or why it was left",
    "microscope.toml": 'the microscope alone, for the configurations of other stacks: include = "microscope.toml"',
    "coverage.png": "which spatial frequencies are seen, and what becomes of a point",
    "coverage.json": "the same as numbers, and what single changes would add",
    "plan.json": "the fastest fidelity within the tolerance, and which effects matter",
    "stack.ome.tif": "the simulated images: planes of each prism",
    "stack.png": "the same as a picture",
    "phase.ome.tif": "the phase, on an arbitrary scale",
    "phase.png": "the image, flattened, and its phase",
    "phase.json": "the shear's axis and how it was found",
    "comparison.png": "the volumes of several methods beside the truth",
    "comparison.json": "their errors and seconds",
    "truth.ome.tif": "Δn as it is",
    "projection.ome.tif": "Δn by straight rays",
    "rays.ome.tif": "Δn by bent rays",
    "wave.ome.tif": "Δn by the wave",
    "work_precision.png": "error against seconds and memory",
    "work_precision.json": "each trial: fidelity, error, seconds, memory",
    "work_precision.csv": "the same as a table",
    "fits.png": "error of reconstructions against seconds",
    "fits.json": "each reconstruction that was tried",
    "fits.csv": "the same as a table",
    "run.json": "what was typed, the time and memory that it took, and versions",
    "config.resolved.toml": "the configuration with every key, as it was used",
    **{
        f"{command}.resolved.toml": f"the same of torchdic {command}, which ran after the reconstruction"
        for command in ("simulate", "plan", "coverage", "work-precision")
    },
}


# What is of the volume that was there when they were made.
OF_VOLUME = ("sd.ome.tif", "error.ome.tif", "error_bars.png", "error_bars.json", "refits")

_HEAD = "Left by torchdic"


def leave_index(out: Path) -> None:
    """Write README.txt into a folder of results, unless the user has one there. Raises WriteError."""
    there = [name for name in FILES if (out / name).exists()]
    if there and _is_ours(out / INDEX):
        wide = max(map(len, there))
        lines = [f"{name:{wide}}  {FILES[name]}{_age(out, name)}" for name in there]
        write_text(out / INDEX, "\n".join([f"{_HEAD} {__version__}:", "", *lines, ""]))


def _is_ours(path: Path) -> bool:
    """Whether a file may be replaced: it is missing, or was left here before."""
    if not path.exists():
        return True
    try:
        with path.open("rb") as file:
            return file.read(len(_HEAD)) == _HEAD.encode()
    except OSError:  # a folder, or what can't be read
        return False


def _age(out: Path, name: str) -> str:
    """What to say of error bars that are older than the volume beside them."""
    volume = out / "volume.ome.tif"
    older = name in OF_VOLUME and volume.exists() and (out / name).stat().st_mtime < volume.stat().st_mtime
    return " (of an earlier volume)" if older else ""
