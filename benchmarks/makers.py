"""Small files as others write them, for `benchmarks/formats.py` and the tests.

CZI and NDTiff are written by packages of those who made the formats, and OME-Zarr by one that torchdic doesn't read it
by. No package writes LIF or ND2: these are written byte by byte, LIF after Leica's "LIF file format, version 2", and
ND2 after what the reader nd2 knows of its chunks, in version 2.
"""

import importlib
import struct
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np

# --- LIF --------------------------------------------------------------------------------------------------------------

LETTERS = {"X": 1, "Y": 2, "Z": 3, "T": 4, "M": 10}


def dimension(letter: str, count: int, inc: int, length: float, unit: str = "m") -> str:
    """An axis. inc: bytes from one pixel to the next. length: from the first pixel's centre to the last's."""
    return (
        f'<DimensionDescription DimID="{LETTERS[letter]}" NumberOfElements="{count}" Origin="0" Length="{length}" '
        f'Unit="{unit}" BitInc="0" BytesInc="{inc}"/>'
    )


def lif_image(
    name: str, data: np.ndarray, axes: str, steps: Mapping[str, float], bits: int = 12
) -> tuple[str, tuple[str, bytes]]:
    """An image's element and its bytes. axes: letters, slowest first, C among them; steps: in m, by letter."""
    incs, inc = {}, data.itemsize
    for letter, count in zip(reversed(axes), reversed(data.shape), strict=True):
        incs[letter], inc = inc, inc * count
    channels = "".join(
        f'<ChannelDescription DataType="0" ChannelTag="0" Resolution="{bits}" NameOfMeasuredQuantity="" Min="0" '
        f'Max="1" Unit="" LUTName="Gray" IsLUTInverted="0" BytesInc="{c * incs.get("C", 0)}" BitInc="0"/>'
        for c in range(dict(zip(axes, data.shape, strict=True)).get("C", 1))
    )
    dimensions = "".join(
        dimension(letter, count, incs[letter], steps.get(letter, 0.0) * (count - 1))
        for letter, count in reversed(list(zip(axes, data.shape, strict=True)))
        if letter != "C"
    )
    settings = (
        '<Attachment Name="HardwareSetting"><ATLCameraSettingDefinition ObjectiveName="HC PL APO 63x/1.40 OIL" '
        'NumericalAperture="1.4" RefractionIndex="1.518" Immersion="OIL"/></Attachment>'
    )
    return (
        f'<Element Name={quoteattr(name)} UniqueID="{name}"><Data><Image><ImageDescription><Channels>{channels}'
        f"</Channels><Dimensions>{dimensions}</Dimensions></ImageDescription>{settings}</Image></Data>"
        f'<Memory Size="{data.nbytes}" MemoryBlockID="Mem_{name}"/><Children/></Element>'
    ), (f"Mem_{name}", data.tobytes())


def write_lif(path: Path, *images: tuple[str, tuple[str, bytes]]) -> Path:
    """A LIF file of images as `lif_image` makes them."""
    elements = "".join(element for element, _ in images)
    header = (
        f'<LMSDataContainerHeader Version="2"><Element Name="{path.name}"><Data><Experiment/></Data>'
        f'<Memory Size="0" MemoryBlockID="Mem_0"/><Children>{elements}</Children></Element></LMSDataContainerHeader>'
    )
    parts = [struct.pack("<IIBI", 0x70, 2 * len(header) + 5, 0x2A, len(header)), header.encode("utf-16-le")]
    for name, content in (block for _, block in images):
        parts += [struct.pack("<IIBQBI", 0x70, 2 * len(name) + 14, 0x2A, len(content), 0x2A, len(name))]
        parts += [name.encode("utf-16-le"), content]
    path.write_bytes(b"".join(parts))
    return path


# --- ND2 --------------------------------------------------------------------------------------------------------------

MAGIC = 0x0ABECEDA
RUNTYPES = {bool: "bool", int: "lx_uint32", float: "double", str: "CLxStringW"}


def variant(values: Mapping[str, Any]) -> bytes:
    """Values as the XML in which ND2 keeps them."""

    def element(name: str, value: Any) -> str:
        if isinstance(value, dict):
            inner = "".join(element(key, one) for key, one in value.items())
            return f'<{name} runtype="CLxListVariant">{inner}</{name}>'
        text = str(value).lower() if isinstance(value, bool) else str(value)
        return f'<{name} runtype="{RUNTYPES[type(value)]}" value={quoteattr(text)}/>'

    inner = element("no_name", values)
    return f'<?xml version="1.0" encoding="UTF-8"?><variant version="1.0">{inner}</variant>'.encode()


def chunk(name: bytes, content: bytes, reserved: int | None = None) -> bytes:
    """A chunk. reserved: bytes for its name."""
    reserved = reserved or len(name) + 20
    return struct.pack("<IIQ", MAGIC, reserved, len(content)) + name.ljust(reserved, b"\0") + content


def write_nd2(
    path: Path, data: np.ndarray, step: float = 0.3, pixel: float = 0.11, *, calibrated: bool = True, bits: int = 12
) -> Path:
    """An ND2 file of data (position, z, channel, y, x); pixel and step in µm."""
    positions, planes, channels, ny, nx = data.shape
    attributes = {"uiWidth": nx, "uiWidthBytes": nx * channels * 2, "uiHeight": ny, "uiComp": channels}
    attributes |= {"uiBpcInMemory": 16, "uiBpcSignificant": bits, "uiSequenceCount": positions * planes}
    peak = {"uiCount": 1, "pPoint": {"Point0": {"eType": 1, "dWavelength": 546.0, "dTValue": 1.0}}}
    probe = {"m_ExcitationSpectrum": peak, "m_EmissionSpectrum": peak}
    common = {"uiCompCount": 1, "uiSampleIndex": 0, "uiColor": 0, "pFluorescentProbe": probe}
    plane = {f"a{c}": {**common, "sDescription": f"DIC {c}"} for c in range(channels)}
    metadata = {"bCalibrated": calibrated, "dCalibration": pixel, "dObjectiveNA": 1.2, "dObjectiveMag": 60.0}
    metadata |= {"dRefractIndex1": 1.333, "wsObjectiveName": "Plan Apo", "dTimeAbsolute": 0.0}
    metadata |= {"sPicturePlanes": {"uiCount": channels, "uiCompCount": channels, "sPlaneNew": plane}}
    z = {
        "uiCount": planes,
        "dZLow": 0.0,
        "dZHigh": step * (planes - 1),
        "dZStep": step,
        "iType": 0,
        "bZInverted": False,
    }
    z |= {"iType": 0, "bZInverted": False}
    loops = {"eType": 4, "uiLoopPars": 0, "uLoopPars": z}
    if positions > 1:
        points = {f"i{p:010}": {"dPosX": 0.0, "dPosY": 0.0, "dPosZ": 0.0} for p in range(positions)}
        xy = {"uiCount": positions, "bUseZ": False, "Points": points}
        loops = {"eType": 2, "uLoopPars": xy, "ppNextLevelEx": {"i0000000000": loops}}
    chunks = {
        b"ImageAttributes!": chunk(b"ImageAttributes!", variant(attributes)),
        b"ImageMetadataSeq|0!": chunk(b"ImageMetadataSeq|0!", variant(metadata)),
        b"ImageMetadata!": chunk(b"ImageMetadata!", variant(loops)),
    }
    for number, frame in enumerate(data.reshape(-1, channels, ny, nx)):
        name = f"ImageDataSeq|{number}!".encode()
        pixels = frame.transpose(1, 2, 0).astype("<u2").tobytes()
        chunks[name] = chunk(name, struct.pack("<d", 0.0) + pixels, 4072)
    written = bytearray(chunk(b"ND2 FILE SIGNATURE CHUNK NAME01!", b"Ver2.0".ljust(64, b"\0"), 32))
    places = bytearray()
    for name, content in chunks.items():
        places += name + struct.pack("<QQ", len(written), len(content))
        written += content
    signature, at = b"ND2 CHUNK MAP SIGNATURE 0000001!", len(written)
    ends = struct.pack("<Q", at)
    written += chunk(b"ND2 FILEMAP SIGNATURE NAME 0001!", bytes(places) + signature + ends)
    path.write_bytes(bytes(written))
    return path


# --- by packages ------------------------------------------------------------------------------------------------------

BITS = "<ComponentBitCount>12</ComponentBitCount>"
LENS = """<Instrument><Objectives>
<Objective Name="Plan-Apo"><LensNA>1.4</LensNA><Immersion>Oil</Immersion></Objective>
</Objectives></Instrument>"""
NAMES = ("plus", "minus")


def everything(_: tuple[int, ...]) -> bool:
    """Every plane is written."""
    return True


def write_czi(
    path: Path,
    data: np.ndarray,
    *,
    written: Callable[[tuple[int, ...]], bool] = everything,
    kinds: tuple[type, type] = (np.uint16, np.uint16),
) -> Path:
    """A CZI of data (scene, channel, z, y, x), by Zeiss's pylibCZIrw; pixels of 0.12 × 0.11 µm, steps of 0.3 µm.

    written: whether a plane (scene, channel, z) is. kinds: of each channel's pixels.
    """
    czi = importlib.import_module("pylibCZIrw.czi")
    with czi.create_czi(str(path)) as file:
        for scene, channel, z in filter(written, np.ndindex(*data.shape[:3])):
            plane = data[scene, channel, z].astype(kinds[channel])
            plane = plane if plane.ndim == 3 else plane[..., None]
            file.write(plane, plane={"C": channel, "Z": z}, scene=scene, location=(100 * scene, 0))
        names = dict(enumerate(NAMES))
        file.write_metadata("stack", channel_names=names, scale_x=0.11e-6, scale_y=0.12e-6, scale_z=0.3e-6)
    with czi.edit_czi(str(path)) as file, file.edit_session() as builder:
        xml = builder.get_xml().replace("<Information>", f"<Information>{LENS}", 1)
        builder.set_xml(xml.replace("<Image>", f"<Image>{BITS}", 1))
        builder.commit()
    return path


def write_ndtiff(folder: Path, data: np.ndarray, *, written: Callable[[tuple[int, ...]], bool] = everything) -> Path:
    """The file of an NDTiff of data (channel, z, y, x), by Micro-Manager's ndstorage, in a folder that isn't there yet.

    written: whether a plane (channel, z) is.
    """
    folder.mkdir()
    said = {"PixelSize_um": 0.11, "z-step_um": 0.3}
    ndstorage = importlib.import_module("ndstorage")
    file = ndstorage.NDTiffDataset(str(folder), name="stack", summary_metadata=said, writable=True)
    for channel, z in filter(written, np.ndindex(*data.shape[:2])):
        axes = {"channel": NAMES[channel], "z": z - 2}  # about the plane in focus
        file.put_image(axes, data[channel, z], {"BitDepth": 12})
    file.finish()
    file.close()
    return next(folder.glob("*/*.tif"))


def write_zarr(path: Path, data: np.ndarray, *, several: bool = False) -> Path:
    """An OME-Zarr 0.5 of data (channel, z, y, x), or of several such, by yaozarrs; in nm, as some programs have it."""
    v05, write = importlib.import_module("yaozarrs.v05"), importlib.import_module("yaozarrs.write.v05")
    space = [v05.SpaceAxis(name=name, unit="nanometer") for name in "zyx"]
    scale = v05.ScaleTransformation(scale=[1.0, 300.0, 120.0, 110.0])
    dataset = v05.Dataset(path="0", coordinateTransformations=[scale])
    multiscale = v05.Multiscale(name="stack", axes=[v05.ChannelAxis(name="c"), *space], datasets=[dataset])
    window = v05.OmeroWindow(start=0, min=0, end=4095, max=4095)
    channels = [v05.OmeroChannel(label=name, color="FFFFFF", window=window) for name in NAMES[: data.shape[-4]]]
    image = v05.Image(multiscales=[multiscale], omero=v05.Omero(channels=channels))
    if several:
        write.write_bioformats2raw(path, {str(n): (image, one) for n, one in enumerate(data)})
    else:
        write.write_image(path, image, data)
    return path
