"""The shear's length and the bias, of which images of an unknown specimen tell the product s·cot(b/2) alone.

A change of the product is shared by how well each of the two is known beforehand, as the most probable values would:
least (Δln s/σ_s)² + mean(Δb/σ_b)², with Δln cot(b/2) = −Δb/sin b.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

# What people know of their prism: lengths to within 15 %, biases to within 10°; as standard deviations of what may be
# anything within these.
LENGTH, BIAS = 0.15 / math.sqrt(3), math.radians(10) / math.sqrt(3)

# A bias whose sine is less has an image without a differential part, or without any other: it stays.
FLAT = 1e-3


@dataclass(frozen=True)
class Shared:
    """How a change of the product is shared.

    length: the logarithm of the length's factor. length_deviation: of that. biases, bias_deviations: of each prism, in
    rad.
    """

    length: float
    length_deviation: float
    biases: tuple[float, ...]
    bias_deviations: tuple[float, ...]


def shared(change: float, deviation: float, biases: Sequence[float]) -> Shared:
    """The length's and the biases' parts of a change of the product's logarithm.

    change, deviation: found by changing the length alone. biases: told, in rad.
    """
    sines = [math.sin(bias) if abs(math.sin(bias)) > FLAT else 0.0 for bias in biases]
    steep = [sine for sine in sines if sine]
    # of the product's logarithm, where the length is right: the inverse variance by what the biases may be off
    precision = sum(sine**2 for sine in steep) / len(steep) / BIAS**2 if steep else math.inf
    part = 1 / (1 + 1 / (precision * LENGTH**2))  # of the change, that is the length's
    rest = (1 - part) * change
    # what the product doesn't tell stays as uncertain as it was beforehand
    free = LENGTH * math.sqrt(1 - part)
    return Shared(
        part * change,
        math.hypot(part * deviation, free),
        tuple(_moved(bias, rest) if sine else bias for bias, sine in zip(biases, sines, strict=True)),
        tuple(abs(sine) * math.hypot((1 - part) * deviation, free) if sine else BIAS for sine in sines),
    )


def _moved(bias: float, change: float) -> float:
    """The bias whose cot(b/2) is greater by a factor, on the same side of 0 and in the same turn."""
    whole = math.remainder(bias, 2 * math.pi)
    moved = 2 * math.atan(math.tan(abs(whole) / 2) * math.exp(-change))
    return bias - whole + math.copysign(moved, whole)
