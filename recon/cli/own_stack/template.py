"""The text of a configuration for a stack."""

import math

from recon.cli.own_stack.settled import Settled
from recon.config.commented import Line, Sourced, commented
from recon.recording.survey.survey import Survey, shows_edges
from torchdic import __version__
from torchdic.files.gathered import Gathered


def template(gathered: Gathered, found: Survey, settled: Settled, path: str, series: int | None) -> str:
    """The commented TOML; what only the user can say stands first.

    path: of the stack as the file names it. series: of the file, None for its only one.
    """
    head = [
        f"Written by torchdic new ({__version__}) for {gathered.stack.source}.",
        "Each value says where it comes from: given, file, measured, or assumed because nothing tells it.",
        "Lengths are in µm, indices and apertures have no unit.",
    ]
    top = []
    if settled.assumed:
        head += [
            "",
            "Correct what is assumed, and take its name out of this list; a reconstruction warns of the others.",
        ]
        top = [Line("assumed", settled.assumed)]
    tables = {
        "acquisition": _acquisition(gathered, found, settled),
        "microscope": _microscope(settled),
        "volume": _volume(gathered, settled),
        "data": _data(gathered, found, settled, path, series),
        "reconstruction": _reconstruction(gathered, settled),
    }
    return commented(head, top, tables)


def _line(key: str, value: Sourced) -> Line:
    return Line(key, value.value, value.comment)


def _short(value: float) -> float:
    return float(f"{value:.6g}")


def name_of_setting(gathered: Gathered, number: int) -> str:
    """The file, or the file's channel, that a setting is, counted from 0; "" where it has no name of its own."""
    names = gathered.stack.names
    if not names or names[number] in ("", f"setting {number + 1}"):
        return ""
    return f'channel "{names[number]}"' if gathered.one_file else names[number]


def _acquisition(gathered: Gathered, found: Survey, settled: Settled) -> list[Line]:
    """Prisms and focus planes; only the user knows most of them."""
    prisms = []
    for number, (length, angle, bias) in enumerate(settled.prisms):
        value = {"shear": {"length": length.value, "angle_degrees": angle.value}, "bias_degrees": bias.value}
        name = name_of_setting(gathered, number)
        setting = f"setting {number + 1}{f', {name}' if name else ''}"
        words = [each.origin if number and each.origin != "measured" else each.comment for each in (length, bias)]
        prisms.append(Line("", value, f"{setting}: length {words[0]}; angle {angle.comment}; bias {words[1]}"))
    planes = gathered.stack.data.shape[1]
    depth = f"{settled.first + found.sharpest * settled.step.value:.3g}"
    sharpest = f"; measured: the sharpest is number {found.sharpest + 1}, at {depth}" if shows_edges(found) else ""
    comment = (
        f"step {settled.step.comment}; assumed: the first plane is where light enters, else make step and first "
        f"change their signs{sharpest}"
    )
    focus = {"first": settled.first, "step": settled.step.value, "count": planes}
    return [
        Line("prisms", tuple(prisms), "angle: from right towards down, to where a rising path is bright"),
        Line("focus", focus if planes > 1 else [0.0], comment if planes > 1 else "one plane, in the middle"),
    ]


def _microscope(settled: Settled) -> list[Line]:
    return [
        Line("objective", {"na": settled.na.value}, settled.na.comment),
        Line("condenser", {"na": settled.condenser_na.value}, settled.condenser_na.comment),
        _line("wavelength", settled.wavelength),
    ]


def _volume(gathered: Gathered, settled: Settled) -> list[Line]:
    _, planes, height, width = gathered.stack.data.shape
    (number, thickness), pixel = settled.slices, settled.pixel_size
    why = "one plane shows no depth" if planes == 1 else "they fill the focus range and go on beyond it"
    if planes > 1 and thickness == settled.step.value:
        size = "the focus step"
    else:
        size = "half the depth of field, at least a pixel, at most 1 µm"
    return [
        _line("background", settled.background),
        Line("shape", [number, height, width], f"slices: {why}; (y, x): the file's pixels"),
        Line("pixel_size", pixel.value if settled.square else [settled.pixel_height, pixel.value], pixel.comment),
        Line("slice_thickness", thickness, f"chosen: {size}"),
    ]


def _data(gathered: Gathered, found: Survey, settled: Settled, path: str, series: int | None) -> list[Line]:
    lines = [Line("path", path, "given" if gathered.one_file else f"given: {len(gathered.files)} files, joined")]
    if series is not None:
        lines.append(Line("series", series, "given"))
    stack, camera = gathered.stack, found.camera
    if settled.offset is not None:
        lines.append(_line("offset", settled.offset))
    if not stack.is_integer:
        lines.append(Line("scale", "background", "chosen: floats, whose empty field is taken as the model's"))
        lines.append(Line("flatten", True, "chosen: the lamp's light is divided out, as of counts"))
        return lines
    if camera is not None:
        sure = f"measured: ± {camera.gain_error / camera.gain:.0%}, counts per electron"
        lines.append(Line("gain", _short(camera.gain), sure))
        lines.append(Line("read_noise", _short(camera.read), "chosen: 2 electrons in counts, as is usual"))
    return lines


def _reconstruction(gathered: Gathered, settled: Settled) -> list[Line]:
    bounds = {"lower": "none", "upper": 0.0} if settled.lower else {"lower": 0.0}
    said = "given" if settled.lower else "assumed"
    lines = [Line("bounds", bounds, f"{said}: Δn is {'below' if settled.lower else 'above'} 0")]
    learned: dict[str, str] = {}
    if gathered.stack.data.shape[1] > 1:
        learned["drift"] = "a slow drift can't be told from a change of focus beforehand"
    learned["lamp"] = "the background that is divided out is fitted around the specimen"
    return [*lines, Line("learn", list(learned), f"chosen: {', and '.join(learned.values())}")]


def angle_in_words(degrees: float) -> str:
    """An angle from right towards down, as one sees it on a screen."""
    eighths = ("right", "right and down", "down", "left and down", "left", "left and up", "up", "right and up")
    return eighths[math.floor(((degrees % 360) + 22.5) / 45) % 8]
