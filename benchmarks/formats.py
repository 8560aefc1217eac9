"""What is kept of a stack in each format: read from files of others' writers, and written for others' readers.

    python benchmarks/formats.py [--imagej ij.jar:bioformats_package.jar]

It prints two tables in Markdown. The first reads small files that others' writers made (see makers.py), and compares
with what was put into them. The second lets others open what torchdic writes. Rows whose packages are missing are named
at the end; ImageJ's need Java, a screen, and both jars.
"""

import argparse
import importlib
import io
import math
import os
import re
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
from PIL import Image

import makers
from torchdic import Grid
from torchdic.errors import StackError
from torchdic.files.gathered import gather
from torchdic.files.stack import write_stack, write_volume

# (scene, prism, focus, y, x), and what is said of it: sizes in µm along z, y and x.
DATA = np.random.default_rng(0).integers(0, 4000, (2, 2, 4, 6, 8)).astype(np.uint16)
SIZES = (0.3, 0.12, 0.11)
STEPS = {"Z": 0.3e-6, "Y": 0.12e-6, "X": 0.11e-6}  # m

KEPT, LOST, ABSENT = "kept", "**lost**", "–"


@dataclass(frozen=True)
class Foreign:
    """A row of the first table.

    write: a file into a folder, of the scenes that are given; returns it. holds: what the writer says in it. several:
    whether it can hold two scenes. squares: whether its pixels are squares of 0.11 µm. names: begin as the prisms' do.
    """

    format: str
    writer: str
    write: Callable[[Path, np.ndarray], Path]
    holds: tuple[str, ...] = ("pixel", "step", "names", "bits", "lens")
    several: bool = False
    squares: bool = False
    names: tuple[str, str] = makers.NAMES


def ome_tiff(folder: Path, data: np.ndarray) -> Path:
    """An OME-TIFF of each scene as an image, by tifffile."""
    path = folder / "stack.ome.tif"
    said = {f"PhysicalSize{axis}": size for axis, size in zip("ZYX", SIZES, strict=True)}
    metadata = {"axes": "CZYX", "SignificantBits": 12, "Channel": {"Name": list(makers.NAMES)}, **said}
    with tifffile.TiffWriter(path, ome=True) as file:
        for scene in data:
            file.write(scene, photometric="minisblack", metadata=metadata)
    return path


def imagej(folder: Path, data: np.ndarray) -> Path:
    """A hyperstack of ImageJ's, by tifffile."""
    path, (z, y, x) = folder / "stack.tif", SIZES
    metadata = {"axes": "ZCYX", "spacing": z, "unit": "um"}
    tifffile.imwrite(path, data[0].swapaxes(0, 1), imagej=True, resolution=(1 / x, 1 / y), metadata=metadata)
    return path


def pages(folder: Path, data: np.ndarray) -> Path:
    """The planes of one prism, page by page, by Pillow."""
    first, *others = (Image.fromarray(plane) for plane in data[0, 0])
    first.save(folder / "stack.tif", save_all=True, append_images=others)
    return folder / "stack.tif"


# The settings of a folder are in the natural order of its files' names.
IN_ORDER = ("minus", "plus")


def planes(folder: Path, data: np.ndarray, suffix: str) -> Path:
    """A folder with a file for each plane, by Pillow."""
    inside = folder / "planes"
    inside.mkdir()
    for channel, z in np.ndindex(data.shape[1:3]):
        Image.fromarray(data[0, channel, z]).save(inside / f"{IN_ORDER[channel]}_z{z}.{suffix}")
    return inside


def lif(folder: Path, data: np.ndarray) -> Path:
    """A LIF with an image for each scene."""
    images = (makers.lif_image(f"image {number}", scene, "CZYX", STEPS) for number, scene in enumerate(data))
    return makers.write_lif(folder / "stack.lif", *images)


def zarr(folder: Path, data: np.ndarray) -> Path:
    """An OME-Zarr, with several images where there are several scenes."""
    several = len(data) > 1
    return makers.write_zarr(folder / "stack.ome.zarr", data if several else data[0], several=several)


SIZED = ("pixel", "step", "names")
FOREIGN = (
    Foreign("OME-TIFF", "tifffile", ome_tiff, (*SIZED, "bits"), several=True),
    Foreign("ImageJ TIFF", "tifffile", imagej, ("pixel", "step")),
    Foreign("TIFF, page by page", "Pillow", pages, ()),
    Foreign("folder of TIFF", "Pillow", lambda folder, data: planes(folder, data, "tif"), ("names",), names=IN_ORDER),
    Foreign(
        "folder of PNG, 16 bits", "Pillow", lambda folder, data: planes(folder, data, "png"), ("names",), names=IN_ORDER
    ),
    Foreign(
        "NDTiff",
        "ndstorage (Micro-Manager)",
        lambda folder, data: makers.write_ndtiff(folder / "stack", data[0]),
        (*SIZED, "bits"),
        squares=True,
    ),
    Foreign("OME-Zarr 0.5", "yaozarrs", zarr, SIZED, several=True),
    Foreign(
        "CZI", "pylibCZIrw (Zeiss)", lambda folder, data: makers.write_czi(folder / "stack.czi", data), several=True
    ),
    Foreign("LIF", "byte by byte", lif, ("pixel", "step", "bits", "lens"), several=True),
    Foreign(
        "ND2",
        "byte by byte",
        lambda folder, data: makers.write_nd2(folder / "stack.nd2", data.swapaxes(1, 2)),
        several=True,
        squares=True,
        names=("DIC 0", "DIC 1"),
    ),
)


def read_row(row: Foreign, folder: Path) -> list[str]:
    """What is kept of one format."""
    found = gather([row.write(folder, DATA[:1])])
    stack, (z, y, x) = found.stack, SIZES
    right = {
        "pixel": np.allclose(stack.pixel_size or math.nan, (x if row.squares else y, x)),
        "step": bool(stack.focus_step) and math.isclose(stack.focus_step or 0, z),
        "names": all(map(str.startswith, stack.names, row.names)) and len(stack.names) == 2,
        "bits": stack.bits == 12,
        "lens": found.setup.na in (1.2, 1.4),
    }
    expected = DATA[0, : len(stack.data)]
    cells = [KEPT if stack.data.shape == expected.shape and (stack.data == expected).all() else LOST]
    cells += [(KEPT if good else LOST) if name in row.holds else ABSENT for name, good in right.items()]
    return [row.format, row.writer, *cells, _one_of_several(row, folder / "several")]


def _one_of_several(row: Foreign, folder: Path) -> str:
    """Whether one of several stacks in a file is refused with advice where none is chosen, and read where one is."""
    if not row.several:
        return ABSENT
    folder.mkdir()
    path = row.write(folder, DATA)
    try:
        gather([path])
    except StackError as error:
        told = "series = 0 … 1 in [data]" in str(error)
        return "`series = N`" if told and (gather([path], 1).stack.data == DATA[1]).all() else LOST
    return LOST


# --- what others make of what is written ------------------------------------------------------------------------------


@dataclass(frozen=True)
class Opened:
    """What another reader finds: arrays (z, y, x), the sizes of their voxels, the unit and the names."""

    data: list[np.ndarray]
    sizes: tuple[float, ...]
    unit: str
    names: str


VOLUME, GRID = (DATA[0, 0] / 1e5).astype(np.float32), Grid((4, 6, 8), SIZES)
IMAGES = (DATA[0] / 4096).astype(np.float32)


def by_napari(path: Path) -> Opened:
    """By the plugin that reads the format."""
    for name in ("napari_tiff", "napari_ome_zarr"):
        importlib.import_module(name)
    importlib.import_module("npe2").PluginManager.instance().discover()
    viewer = importlib.import_module("napari.components").ViewerModel()
    with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):  # readers print what they read
        viewer.open(path, plugin="napari-tiff" if path.suffix == ".tif" else "napari-ome-zarr")
    layers = list(viewer.layers)
    units = {str(unit) for layer in layers for unit in layer.units}
    (sizes,) = {tuple(map(float, layer.scale)) for layer in layers}
    return Opened([np.asarray(layer.data) for layer in layers], sizes, " ".join(units), ", ".join(map(str, layers)))


def by_ome_types(path: Path) -> Opened:
    """By tifffile, and ome-types, which holds the XML against its schema."""
    with tifffile.TiffFile(path) as file:
        (image,) = importlib.import_module("ome_types").from_xml(file.ome_metadata, validate=True).images
        data = file.series[0].asarray(squeeze=False).reshape(-1, 4, 6, 8)
    pixels = image.pixels
    sizes = tuple(float(getattr(pixels, f"physical_size_{axis}")) for axis in "zyx")
    (unit,) = {getattr(pixels, f"physical_size_{axis}_unit").value for axis in "zyx"}
    return Opened(list(data), sizes, unit, ", ".join(channel.name for channel in pixels.channels))


def by_ome_zarr_models(path: Path) -> Opened:
    """By zarr, and ome-zarr-models, which holds the attributes against the specification."""
    version = "v05" if path.name.endswith(".ome.zarr") else "v04"
    models = importlib.import_module(f"ome_zarr_models.{version}.image")
    group: Any = importlib.import_module("zarr").open_group(str(path), mode="r")
    said = models.Image.from_zarr(group).attributes
    said = said.ome if version == "v05" else said
    image = said.multiscales[0]
    (unit,) = {axis.unit for axis in image.axes[1:]}
    channels = said.model_dump()["omero"]["channels"]
    sizes = tuple(image.datasets[0].coordinateTransformations[0].scale[1:])
    return Opened(list(np.asarray(group["0"])), sizes, unit, ", ".join(channel["label"] for channel in channels))


MACRO = """
path = getArgument();
if (WAY) run("Bio-Formats Importer", "open=[" + path + "] color_mode=Default view=Hyperstack stack_order=XYCZT");
else open(path);
getVoxelSize(width, height, depth, unit);
getDimensions(columns, rows, channels, slices, frames);
print("found;" + depth + ";" + height + ";" + width + ";" + unit + ";" + channels + ";" + slices + ";"
    + getInfo("slice.label"));
saveAs("raw data", path + ".raw");
"""


def by_imagej(path: Path, jars: str, *, bio_formats: bool) -> Opened:
    """By ImageJ: through Bio-Formats, or by its own File > Open."""
    macro, raw = path.with_suffix(".ijm"), Path(f"{path}.raw")
    macro.write_text(MACRO.replace("WAY", str(int(bio_formats))), encoding="utf-8")
    plugins = path.parent / "plugins"
    plugins.mkdir(exist_ok=True)
    for jar in jars.split(os.pathsep)[1:]:
        (plugins / Path(jar).name).unlink(missing_ok=True)
        (plugins / Path(jar).name).symlink_to(Path(jar).resolve())
    words = ["java", f"-Dplugins.dir={path.parent}", "-cp", jars, "ij.ImageJ", "-ijpath", str(path.parent), "-batch"]
    done = subprocess.run([*words, str(macro), str(path)], capture_output=True, text=True, timeout=120, check=True)
    found = re.search(r"^found;(.*)$", done.stdout, re.MULTILINE)
    if found is None:
        raise OSError(f"ImageJ told nothing: {done.stdout[-200:]} {done.stderr[-200:]}")
    depth, height, width, unit, channels, slices, label = found[1].split(";")
    values = np.fromfile(raw, ">f4").reshape(-1, int(channels), 6, 8)  # z by z, in each channel by channel
    data = list(values.swapaxes(0, 1)) if int(slices) == len(values) else [values]
    return Opened(data, (float(depth), float(height), float(width)), unit, label)


def opened_rows(jars: str | None) -> Iterator[tuple[str, str, str, Callable[[Path], Opened]]]:
    """Suffix, format, reader, and how it opens a file."""
    yield ".ome.tif", "OME-TIFF", "tifffile, ome-types (schema)", by_ome_types
    yield ".ome.tif", "OME-TIFF", "napari with napari-tiff", by_napari
    if jars is not None:
        for name, bio in (("ImageJ's Bio-Formats Importer", True), ("ImageJ's File > Open", False)):
            yield ".ome.tif", "OME-TIFF", name, lambda path, bio=bio: by_imagej(path, jars, bio_formats=bio)
    for suffix, version in ((".zarr", "0.4"), (".ome.zarr", "0.5")):
        yield suffix, f"OME-Zarr {version}", "zarr, ome-zarr-models (specification)", by_ome_zarr_models
        yield suffix, f"OME-Zarr {version}", "napari with napari-ome-zarr", by_napari


def opened_row(suffix: str, way: Callable[[Path], Opened], folder: Path) -> list[str]:
    """What another reader finds in a volume of Δn and in images."""
    volume, images = folder / f"volume{suffix}", folder / f"images{suffix}"
    write_volume(volume, VOLUME, GRID)
    write_stack(images, IMAGES, SIZES[1:], SIZES[0], names=makers.NAMES)
    found, others = way(volume), way(images)
    same = len(found.data) == 1 and np.array_equal(found.data[0], VOLUME)
    both = len(others.data) == 2 and np.array_equal(np.stack(others.data), IMAGES)
    scale = " × ".join(f"{size:.4g}" for size in found.sizes)
    right = np.allclose(found.sizes, SIZES) and np.allclose(others.sizes, SIZES)
    cells = [KEPT if same else LOST, KEPT if both else LOST, scale if right else f"**{scale}**", found.unit]
    return [*cells, "; ".join(filter(None, (found.names, others.names))) or ABSENT]


# --- the tables -------------------------------------------------------------------------------------------------------


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table in Markdown."""
    return "\n".join(f"| {' | '.join(cells)} |" for cells in (head, ["---"] * len(head), *rows))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--imagej", metavar="JARS", help="class path of ImageJ and Bio-Formats, ImageJ's jar first")
    jars = parser.parse_args().imagej
    warnings.simplefilter("ignore")
    missing: list[str] = []

    def each(rows: Iterator[tuple[str, Callable[[Path], list[str]]]]) -> Iterator[list[str]]:
        """The rows whose packages are there."""
        for name, of in rows:
            with tempfile.TemporaryDirectory() as folder:
                try:
                    yield of(Path(folder))
                except (ImportError, StackError) as error:
                    if not isinstance(error, ImportError) and not isinstance(error.__cause__, ImportError):
                        raise
                    missing.append(f"{name} ({error})")

    read = each((row.format, lambda folder, row=row: read_row(row, folder)) for row in FOREIGN)
    print(table(("read", "written by", "images", "pixel", "step", "names", "bits", "aperture", "of several"), [*read]))
    opened = each(
        (
            reader,
            lambda folder, suffix=suffix, format=format, reader=reader, way=way: [
                format,
                reader,
                *opened_row(suffix, way, folder),
            ],
        )
        for suffix, format, reader, way in opened_rows(jars)
    )
    print("\n" + table(("written", "opened by", "Δn", "images", "voxel (z × y × x)", "unit", "names"), [*opened]))
    for name in missing:
        print(f"missing: {name}", file=sys.stderr)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
