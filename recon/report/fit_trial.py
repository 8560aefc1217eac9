"""A fit that is tried, and what it came to: the rows of a table of work and precision."""

from dataclasses import dataclass


@dataclass(frozen=True)
class FitCandidate:
    """A way to reconstruct that is to be tried.

    method: of `recon.fit.problem.Recipe`. propagation: of the images that are fitted; None where the method has none of
    its own. directions: of the condenser; None likewise. planes: how many of the stack's focus planes are fitted.
    """

    method: str
    propagation: str | None
    directions: int | None
    planes: int

    @property
    def label(self) -> str:
        """The candidate in a few words."""
        how = " ".join(str(part) for part in (self.propagation, self.directions) if part is not None)
        planes = f"{self.planes} plane{'s' if self.planes != 1 else ''}"
        return ", ".join(part for part in (self.method, how, planes) if part)


@dataclass(frozen=True)
class FitTrial:
    """What a fit costs and how near it comes. A number is None where it isn't known.

    candidate: what was tried.
    volume_error: relative L2 error of Δn over the volume; None where the truth isn't known.
    mass: sum of Δn over the true one; None likewise.
    misfit: of the fitted planes, by the candidate's own images. whole_misfit: of all planes of the stack, by the images
    of the most careful wave, each of its best brightness; None where drift or focus were learned, which aren't known of
    planes that weren't fitted, or where the wave can't cross the volume.
    noise_misfit, whole_noise_misfit: what noise alone leaves of them; None where the noise isn't known.
    steps: of the descent. weight: of the priors at last. seconds: of the fit. peak_bytes: most bytes of tensors in use
    at once during its first steps.
    failure: why there is no fit.
    """

    candidate: FitCandidate
    volume_error: float | None = None
    mass: float | None = None
    misfit: float | None = None
    noise_misfit: float | None = None
    whole_misfit: float | None = None
    whole_noise_misfit: float | None = None
    steps: int | None = None
    weight: float | None = None
    seconds: float | None = None
    peak_bytes: int | None = None
    failure: str | None = None

    @property
    def over_noise(self) -> float | None:
        """The misfit of the fitted planes over what noise leaves of it; None without noise."""
        return _ratio(self.misfit, self.noise_misfit)

    @property
    def whole_over_noise(self) -> float | None:
        """The misfit of all planes over what noise leaves of it; None without noise."""
        return _ratio(self.whole_misfit, self.whole_noise_misfit)


def _ratio(misfit: float | None, noise: float | None) -> float | None:
    return None if misfit is None or not noise else misfit / noise
