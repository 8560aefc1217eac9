"""What a user tells of a recording: what she knows, as well as she knows it."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from data_synthetic.recorder.record import Recording
from torchdic.instrument.prism import Prism


@dataclass(frozen=True)
class Mistakes:
    """How what is told differs from the truth.

    bias: rad by which the size of each bias is told too large.
    length: factor on the shear's length. turn: rad by which the shear's axis is told turned, from +x towards +y.
    reversed_shear: whether the shear is told with the opposite sign.
    reversed_focus: whether the planes are told in the opposite order.
    """

    bias: float = 0.0
    length: float = 1.0
    turn: float = 0.0
    reversed_shear: bool = False
    reversed_focus: bool = False


@dataclass(frozen=True)
class Told:
    """What a user says of a recording; all else is in its file, or in its images.

    shears: (y, x) in µm, and biases: in rad, one for each prism setting. focus: of each plane of the file, µm.
    wavelength: in µm. na, condenser_na: of objective and condenser. background: index of the medium.
    pixel_size: in µm. lower: whether the specimen's index is below its medium's. mistakes: how shears, biases and focus
    differ from the truth.
    """

    shears: tuple[tuple[float, float], ...]
    biases: tuple[float, ...]
    focus: tuple[float, ...]
    wavelength: float
    na: float
    condenser_na: float
    background: float
    pixel_size: float
    lower: bool = False
    mistakes: Mistakes = field(default_factory=Mistakes)

    def config(self, path: str, slices: tuple[int, float], pixels: tuple[int, int]) -> dict[str, Any]:
        """A configuration of torchdic, as plain values that tomli_w writes.

        path: of the stack. slices: of the volume, their number and their spacing in µm. pixels: of the stack, (y, x).
        """
        number, spacing = slices
        prisms = [{"shear": list(s), "bias": b} for s, b in zip(self.shears, self.biases, strict=True)]
        return {
            "volume": {
                "shape": [number, *pixels],
                "spacing": [spacing, self.pixel_size, self.pixel_size],
                "background": self.background,
            },
            "microscope": {
                "wavelength": self.wavelength,
                "objective": {"na": self.na},
                "condenser": {"na": self.condenser_na},
            },
            "acquisition": {"focus": list(self.focus), "prisms": prisms},
            "data": {"path": path},
            "reconstruction": {"bounds": {"lower": "none", "upper": 0.0} if self.lower else {"lower": 0.0}},
        }


def tell(recording: Recording, mistakes: Mistakes | None = None) -> Told:
    """What a user who makes these mistakes tells of a recording; None makes none.

    Raises ValueError for a recording in bright field, or without an objective or a condenser.
    """
    mistakes = mistakes or Mistakes()
    microscope, prisms = recording.microscope, _sheared(recording.acquisition.prisms)
    if microscope.objective is None or microscope.condenser is None:
        raise ValueError("a user tells of an objective and a condenser; this microscope lacks one")
    sign = -1.0 if mistakes.reversed_shear else 1.0
    cosine, sine = (sign * mistakes.length * turned(mistakes.turn) for turned in (math.cos, math.sin))
    shears, biases = [], []
    for prism in prisms:
        y, x = (float(component) for component in prism.shear)
        bias = float(prism.bias)
        shears.append((cosine * y + sine * x, cosine * x - sine * y))
        biases.append(math.copysign(abs(bias) + mistakes.bias, bias))
    focus = [float(depth) for depth in recording.acquisition.focus]
    return Told(
        shears=tuple(shears),
        biases=tuple(biases),
        focus=tuple(reversed(focus) if mistakes.reversed_focus else focus),
        wavelength=microscope.wavelength,
        na=float(microscope.objective.na),
        condenser_na=float(microscope.condenser.na),
        background=recording.background,
        pixel_size=recording.field.spacing[1],
        lower=float(recording.truth.sum()) < 0,
        mistakes=mistakes,
    )


def _sheared(prisms: Sequence[Prism | None]) -> list[Prism]:
    found = [prism for prism in prisms if prism is not None]
    if len(found) < len(prisms):
        raise ValueError(f"{len(prisms) - len(found)} settings are bright field, which has no shear to tell")
    return found
