"""Errors and warnings. Each message is one line with the numbers and the law."""

from jaxtyping import Bool
from torch import Tensor


class BatchWarning(UserWarning):
    """A warning about one batch of sources. An image gives only the worst of its batches' warnings.

    severity: how bad it is; the larger, the worse.
    """

    def __init__(self, message: str, severity: float = 0.0) -> None:
        super().__init__(message)
        self.severity = severity


class SamplingWarning(UserWarning):
    """The grid is too coarse, or too narrow, for the light that the microscope lets through."""


class ApertureWarning(UserWarning):
    """An aperture exceeds the index of the medium, in which no light runs at so high an n·sinθ: that part is dark."""


class UnstableError(ValueError):
    """The wave can't be computed in slabs: they make energy, or the index falls too low for light to go on toward +z.

    The message states the energy and the number of slabs, or the index.
    """


class SlabWarning(BatchWarning):
    """Slabs are too thick for the specimen's contrast, so the wave loses energy in them."""


class TurnedRaysError(ValueError):
    """Rays can't go on toward +z, because the index falls to their transverse momentum.

    The message states how many rays, and the law.
    """

    @classmethod
    def of(cls, stopped: Bool[Tensor, " *ray"], where: str = "inside the volume") -> "TurnedRaysError":
        """The error for a set of rays.

        stopped: (ray), True for each ray that has stopped.
        where: the place that the message names.
        """
        return cls(
            f"{int(stopped.sum())} of {stopped.numel()} rays can't go on toward +z: "
            f"{where} the index falls to their transverse momentum"
        )


class SidewaysError(ValueError):
    """Rays leave the volume sideways. The message states how far they are displaced, and the limit."""


class WrapAroundWarning(BatchWarning):
    """The focus is so far from the specimen that its light leaves the array, to wrap around or to be cut."""


class ShortOfMemoryError(MemoryError):
    """A computation needs more memory than the device has free.

    The message states the memory that it needs, the memory that is free, and what helps.
    """


class ShortageWarning(UserWarning):
    """A GPU's memory ran out although there seemed to be room; the computation goes on in smaller batches."""


class LostRankError(RuntimeError):
    """Another of the processes that compute together has ended, without which they can't go on."""


class ToleranceWarning(UserWarning):
    """No fidelity that was tried meets the tolerance. The message says by how much the best one misses it, and why."""


class StackError(ValueError):
    """A TIFF file can't be read as a stack or a volume. The message states the file, the value and the law."""


class StackWarning(UserWarning):
    """A stack has a flaw that the reader works around, and that the stack's owner should know."""
