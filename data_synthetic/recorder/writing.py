"""A recording becomes a file, or several, of any kind that programs of microscopes leave."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import tifffile

from data_synthetic.recorder.record import Recording

# The immersion that OME's schema names, by its index: the nearest is taken.
_IMMERSIONS = {1.0: "Air", 1.333: "Water", 1.474: "Glycerol", 1.515: "Oil"}


def write_recording(recording: Recording, path: Path, kind: str = "ome", *, immersion: float | None = None) -> Path:
    """Write a recording as programs leave theirs; returns the file or the folder.

    path: of the file; of the folder for the kinds "folder" and "micro-manager", which is made.
    kind: "ome" (OME-TIFF with sizes, bits, wavelength and objective), "imagej" (a hyperstack with sizes), "tiff" (one
        array, as tifffile writes it, without sizes), "pages" (pages that were written one by one, of one prism),
        "folder" (a file for each plane, named without leading zeros), or "micro-manager" (a file for each plane, and
        metadata.txt).
    immersion: index of the objective's immersion, which the file then states; None states none.
    Raises ValueError for another kind, and for more prisms than the kind can hold.
    """
    if kind not in KINDS:
        raise ValueError(f"kind {kind!r} must be one of {', '.join(map(repr, KINDS))}")
    data = recording.data
    if kind == "pages" and len(data) > 1:
        raise ValueError(f"pages written one by one hold one prism, the recording has {len(data)}")
    KINDS[kind](recording, data, path, immersion)
    return path


def _write_ome(recording: Recording, data: np.ndarray, path: Path, immersion: float | None) -> None:
    microscope, channels = recording.microscope, len(data)
    wavelength = round(1000 * microscope.wavelength, 1)
    metadata: dict[str, Any] = {
        "axes": "CZYX",
        "SignificantBits": recording.camera.bits,
        **{f"PhysicalSize{axis}": float(recording.field.spacing[1]) for axis in "XY"},
        "Channel": {
            "Name": [f"setting {number + 1}" for number in range(channels)],
            "EmissionWavelength": [wavelength] * channels,
            "EmissionWavelengthUnit": ["nm"] * channels,
        },
    }
    if recording.focus_step is not None:
        metadata["PhysicalSizeZ"] = recording.focus_step
    tifffile.imwrite(path, data, ome=True, photometric="minisblack", metadata=metadata)
    if microscope.objective is None:
        return
    aperture, index = f'LensNA="{microscope.objective.na:g}"', ""
    if immersion is not None:
        aperture += f' Immersion="{_immersion_name(immersion)}"'
        index = f' RefractiveIndex="{immersion:g}"'
    instrument = f'<Instrument ID="Instrument:0"><Objective ID="Objective:0" {aperture}/></Instrument>'
    with tifffile.TiffFile(path) as tif:
        described = str(tif.ome_metadata)
    described = described.replace("<Image ", f"{instrument}<Image ", 1)
    settings = f'<InstrumentRef ID="Instrument:0"/><ObjectiveSettings ID="Objective:0"{index}/>'
    tifffile.tiffcomment(path, described.replace("<Pixels ", f"{settings}<Pixels ", 1).encode())


def _write_imagej(recording: Recording, data: np.ndarray, path: Path, immersion: float | None) -> None:
    info = _objective_lines(recording, immersion)
    metadata: dict[str, Any] = {"axes": "ZCYX", "unit": "um", "Info": "\n".join(info)}
    if recording.focus_step is not None:
        metadata["spacing"] = recording.focus_step
    per_um = 1 / recording.field.spacing[1]
    tifffile.imwrite(path, np.swapaxes(data, 0, 1), imagej=True, resolution=(per_um, per_um), metadata=metadata)


def _write_plain(_recording: Recording, data: np.ndarray, path: Path, _immersion: float | None) -> None:
    tifffile.imwrite(path, data if len(data) > 1 else data[0], photometric="minisblack")


def _write_pages(_recording: Recording, data: np.ndarray, path: Path, _immersion: float | None) -> None:
    with tifffile.TiffWriter(path) as tiff:
        for plane in data[0]:
            tiff.write(plane, photometric="minisblack", metadata=None, contiguous=False)


def _write_folder(_recording: Recording, data: np.ndarray, path: Path, _immersion: float | None) -> None:
    path.mkdir()
    for prism, planes in enumerate(data):
        for number, plane in enumerate(planes, 1):
            setting = f"setting{prism + 1}_" if len(data) > 1 else ""
            tifffile.imwrite(path / f"{setting}plane{number}.tif", plane, photometric="minisblack", metadata=None)


def _write_micro_manager(recording: Recording, data: np.ndarray, path: Path, immersion: float | None) -> None:
    path.mkdir()
    prisms, planes, height, width = data.shape
    summary: dict[str, Any] = {
        "Summary": {
            "Slices": planes,
            "Channels": prisms,
            "Width": width,
            "Height": height,
            "BitDepth": recording.camera.bits,
            "PixelSize_um": recording.field.spacing[1],
            "z-step_um": recording.focus_step or 0.0,
            "ChNames": [f"setting{number}" for number in range(prisms)],
        }
    }
    for prism in range(prisms):
        for plane in range(planes):
            name = f"img_channel{prism:03}_position000_time000000000_z{plane:03}.tif"
            tifffile.imwrite(path / name, data[prism, plane], photometric="minisblack", metadata=None)
            summary[f"Metadata-Default/{name}"] = {
                "ZPositionUm": float(recording.acquisition.focus[plane]),
                "Objective-Label": "; ".join(_objective_lines(recording, immersion)),
            }
    (path / "metadata.txt").write_text(json.dumps(summary, indent=2), encoding="utf-8")


def _objective_lines(recording: Recording, immersion: float | None) -> list[str]:
    """The objective as Bio-Formats writes it into ImageJ's Info."""
    objective = recording.microscope.objective
    if objective is None:
        return []
    lines = [f"Information|Instrument|Objective|LensNA #1 = {objective.na:g}"]
    if immersion is not None:
        lines.append(f"Information|Instrument|Objective|Immersion #1 = {_immersion_name(immersion)}")
    return lines


def _immersion_name(index: float) -> str:
    return _IMMERSIONS[min(_IMMERSIONS, key=lambda known: abs(known - index))]


# Who writes each kind: the recording, its data as an array, the path, the objective's immersion.
KINDS: dict[str, Callable[[Recording, np.ndarray, Path, float | None], None]] = {
    "ome": _write_ome,
    "imagej": _write_imagej,
    "tiff": _write_plain,
    "pages": _write_pages,
    "folder": _write_folder,
    "micro-manager": _write_micro_manager,
}
