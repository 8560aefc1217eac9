"""What a configuration lists as assumed: it is hardly known, and once it has been corrected, it is told."""

import math
import re
from collections.abc import Collection, Iterator, Mapping

from recon.calibration.foreknowledge import Foreknowledge
from recon.config.schema import Config

# Within what `torchdic new` guesses right: a length as a share of it, a bias and a direction in rad.
GUESSED = (0.5, math.radians(40), math.radians(45))

# What `torchdic new` lists as assumed, by the key whose comment says so.
_OF_KEYS = {
    "microscope.objective": "objective's NA",
    "microscope.condenser": "condenser's NA",
    "microscope.wavelength": "wavelength",
    "volume.background": "medium's index",
    "volume.pixel_size": "pixel size",
    "data.offset": "camera's offset",
    "reconstruction.bounds": "sign of Δn",
}

# And by the word before it, in the comments of prisms and planes, which say where several parts come from.
_OF_PARTS = {"length": "shear's length", "angle": "shear's angle", "bias": "bias", "step": "focus step"}

# An origin reaches to the next part, or to the end of the comment.
_PART = re.compile(rf"\b(?P<part>{'|'.join(_OF_PARTS)}) assumed.*?(?=; (?:{'|'.join(_OF_PARTS)}|assumed|measured)\b|$)")


def foreknowledge(config: Config) -> Foreknowledge:
    """How closely the prisms are known beforehand: as the configuration says, or what it lists as assumed, hardly."""
    told = config.calibration
    said = (told.length_within, told.bias_within, told.angle_within)
    names = ("shear's length", "bias", "shear's angle")
    return Foreknowledge.within(
        *(
            max(each, guess) if name in config.assumed else each
            for each, guess, name in zip(said, GUESSED, names, strict=True)
        )
    )


def corrected(comments: Mapping[str, str], assumed: Collection[str]) -> dict[str, str]:
    """The comments, in which what is no longer assumed is told.

    comments: of a configuration's file, by their keys. assumed: what the file still lists.
    """
    return dict(_corrected(comments, assumed))


def _corrected(comments: Mapping[str, str], assumed: Collection[str]) -> Iterator[tuple[str, str]]:
    for key, comment in comments.items():
        name = next((name for place, name in _OF_KEYS.items() if key == place or key.startswith(f"{place}.")), None)
        if name is not None and comment.startswith("assumed") and name not in assumed:
            yield key, "told"
        elif key.startswith(("acquisition.prisms[", "acquisition.focus")):
            yield (
                key,
                _PART.sub(lambda found: found[0] if _named(found) in assumed else f"{found['part']} told", comment),
            )
        else:
            yield key, comment


def _named(found: re.Match[str]) -> str:
    return _OF_PARTS[found["part"]]
