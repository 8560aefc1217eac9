"""Small files in the formats of microscopes' makers, written byte by byte as the formats are described.

LIF: Leica's "LIF file format, version 2". ND2: as the reader nd2 describes its chunks, version 2.
"""

import struct
from xml.sax.saxutils import quoteattr

# --- LIF --------------------------------------------------------------------------------------------------------------

LETTERS = {"X": 1, "Y": 2, "Z": 3, "T": 4, "M": 10}


def dimension(letter, count, inc, length, unit="m"):
    return (
        f'<DimensionDescription DimID="{LETTERS[letter]}" NumberOfElements="{count}" Origin="0" Length="{length}" '
        f'Unit="{unit}" BitInc="0" BytesInc="{inc}"/>'
    )


def lif_image(name, data, axes, steps, bits=12, lens=True):
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
        f"</Channels><Dimensions>{dimensions}</Dimensions></ImageDescription>{settings if lens else ''}</Image></Data>"
        f'<Memory Size="{data.nbytes}" MemoryBlockID="Mem_{name}"/><Children/></Element>'
    ), (f"Mem_{name}", data.tobytes())


def write_lif(path, *images):
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


def variant(values):
    """Values as the XML in which ND2 keeps them."""

    def element(name, value):
        if isinstance(value, dict):
            inner = "".join(element(key, one) for key, one in value.items())
            return f'<{name} runtype="CLxListVariant">{inner}</{name}>'
        text = str(value).lower() if isinstance(value, bool) else str(value)
        return f'<{name} runtype="{RUNTYPES[type(value)]}" value={quoteattr(text)}/>'

    inner = element("no_name", values)
    return f'<?xml version="1.0" encoding="UTF-8"?><variant version="1.0">{inner}</variant>'.encode()


def chunk(name, content, reserved=None):
    reserved = reserved or len(name) + 20
    return struct.pack("<IIQ", MAGIC, reserved, len(content)) + name.ljust(reserved, b"\0") + content


def write_nd2(path, data, step=0.3, pixel=0.11, *, calibrated=True, bits=12):
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
