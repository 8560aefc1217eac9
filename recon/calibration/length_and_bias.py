"""The shear's length and the bias, of which images of an unknown specimen tell the product s·cot(b/2) alone.

What the images tell of the product's change is weighed against what is known of the two beforehand, and they share it,
as the most probable values do: least (change − Δln s − mean(Δln cot(b/2)))²/σ² + (Δln s/σ_s)² + mean(Δb)²/σ_b², with
Δln cot(b/2) = −Δb/sin b.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from recon.calibration.foreknowledge import Foreknowledge, most_probable

# A bias whose sine is less has an image without a differential part, or without any other: it stays.
FLAT = 1e-3


@dataclass(frozen=True)
class Shared:
    """The most probable length and biases.

    change: of the product's logarithm. length: the logarithm of the length's factor. length_deviation: of that.
    biases, bias_deviations: of each prism, in rad.
    """

    change: float
    length: float
    length_deviation: float
    biases: tuple[float, ...]
    bias_deviations: tuple[float, ...]


def shared(change: float, deviation: float, biases: Sequence[float], known: Foreknowledge) -> Shared:
    """The most probable length and biases, by what the images tell of the product.

    change: of the product's logarithm, as the images tell it. deviation: one standard deviation of that.
    biases: told, in rad. known: beforehand.
    """
    sines = [math.sin(bias) if abs(math.sin(bias)) > FLAT else 0.0 for bias in biases]
    steep = [sine for sine in sines if sine]
    of_length = known.length**2
    # of the product's logarithm, by what the biases may be off
    of_bias = known.bias**2 * len(steep) / sum(sine**2 for sine in steep) if steep else 0.0
    before = of_length + of_bias
    probable, unsure = most_probable(change, deviation, math.sqrt(before))
    part = of_length / before if before else 1.0  # of the change, that is the length's
    rest = (1 - part) * probable
    # what the product doesn't tell stays as uncertain as it was beforehand
    free = known.length * math.sqrt(1 - part)
    return Shared(
        probable,
        part * probable,
        math.hypot(part * unsure, free),
        tuple(_moved(bias, rest) if sine else bias for bias, sine in zip(biases, sines, strict=True)),
        tuple(abs(sine) * math.hypot((1 - part) * unsure, free) if sine else known.bias for sine in sines),
    )


def _moved(bias: float, change: float) -> float:
    """The bias whose cot(b/2) is greater by a factor, on the same side of 0 and in the same turn."""
    if change == 0:
        return bias
    whole = math.remainder(bias, 2 * math.pi)
    moved = 2 * math.atan(math.tan(abs(whole) / 2) * math.exp(-change))
    return bias - whole + math.copysign(moved, whole)
