"""Media and glasses around a specimen, and between it and the objective, by their names."""

from typing import Any

# Refractive index at 546.1 nm (the e-line), near room temperature.
MEDIA = {
    "air": 1.0003,  # P. E. Ciddor, Appl. Opt. 35, 1566 (1996)
    "water": 1.3345,  # 20 °C, A. H. Harvey et al., J. Phys. Chem. Ref. Data 27, 761 (1998)
    "glycerol": 1.4740,  # 22 °C, pure, J. Rheims et al., Meas. Sci. Technol. 8, 601 (1997)
    "oil": 1.5180,  # 23 °C, immersion oil, ISO 8036
    "glass": 1.5255,  # cover glass, ISO 8255-1
}

# Its wavelength, for messages.
E_LINE = "546 nm"


def index_of(value: Any, key: str) -> float:
    """The refractive index of a medium, given by its name in MEDIA or as a number.

    key: for messages. Raises ValueError for another name, with those that are known, and TypeError for anything else.
    """
    if isinstance(value, str):
        if value not in MEDIA:
            known = ", ".join(f"{name!r} ({index:g})" for name, index in MEDIA.items())
            raise ValueError(f"{key}: {value!r} must be one of {known}, or an index; these are at {E_LINE}")
        return MEDIA[value]
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise TypeError(f"{key}: {value!r} must be the name of a medium, or its index")
    return float(value)
