"""What can go wrong, and what users are warned about: each is one line with the numbers and the law."""

from jaxtyping import Bool
from torch import Tensor


class BatchWarning(UserWarning):
    """A warning about a batch of sources, of which the worst of an image's batches speaks for all.

    severity: the larger, the worse.
    """

    def __init__(self, message: str, severity: float = 0.0) -> None:
        super().__init__(message)
        self.severity = severity


class SamplingWarning(UserWarning):
    """The grid is coarser than the light that the microscope lets through."""


class UnstableError(ValueError):
    """Light that slabs can't carry: one line with the energy they make and their number, or with the index's fall."""


class SlabWarning(BatchWarning):
    """Slabs too thick for a specimen's contrast: they lose energy."""


class TurnedRaysError(ValueError):
    """Rays that can't go on toward +z: one line with their number and the law."""

    @classmethod
    def of(cls, stopped: Bool[Tensor, " *ray"], where: str = "inside the volume") -> "TurnedRaysError":
        """For rays of which some have stopped, where the index falls to what they carry."""
        return cls(
            f"{int(stopped.sum())} of {stopped.numel()} rays can't go on toward +z: "
            f"{where} the index falls to their transverse momentum"
        )


class SidewaysError(ValueError):
    """Rays that leave the volume sideways: one line with how far they are displaced, and what they may be."""


class WrapAroundWarning(BatchWarning):
    """A focus so far from the specimen that its light leaves the array, to wrap around or to be cut."""


class ShortOfMemoryError(MemoryError):
    """A computation that the device has no room for: one line with the bytes wanted, those free, and what helps."""


class ToleranceWarning(UserWarning):
    """No fidelity that was tried meets the tolerance; its message says by how much the best one misses it, and why."""


class StackError(ValueError):
    """A TIFF that cannot be taken for a stack or a volume: one line with the file, the value and the law."""


class StackWarning(UserWarning):
    """Something in a stack that is worked around and that its owner should know: one line."""
