"""What is known of the optics beforehand, against which that is weighed which images tell of them."""

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class Foreknowledge:
    """One standard deviation of what is known of the prisms beforehand.

    length: of the logarithm of the shear's length. bias: of each bias, in rad. angle: of the shear's direction, in rad.
    """

    length: float
    bias: float
    angle: float

    @classmethod
    def within(cls, length: float, bias: float, angle: float) -> "Foreknowledge":
        """Of what may be anything within these, the length within a share of it."""
        return cls(*(width / math.sqrt(3) for width in (length, bias, angle)))

    @property
    def limits(self) -> tuple[float, float, float]:
        """Within which `within` takes length, bias and angle to lie."""
        return self.length * math.sqrt(3), self.bias * math.sqrt(3), self.angle * math.sqrt(3)


def most_probable(change: float, deviation: float, before: float) -> tuple[float, float]:
    """The most probable change of a value from what was told, and one standard deviation of it.

    change, deviation: as the images tell it. before: one standard deviation of what was told.
    """
    if before == 0 or math.isinf(deviation):
        return 0.0, before
    believed = before**2 / (before**2 + deviation**2)
    return believed * change, math.sqrt(believed) * deviation
