"""The microscope, and what was recorded with it."""

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from torchdic.errors import SamplingWarning
from torchdic.grid import Grid
from torchdic.instrument.camera import Camera
from torchdic.instrument.condenser import Condenser, Spectrum
from torchdic.instrument.objective import Objective
from torchdic.instrument.polarisation import Polarisation
from torchdic.instrument.polarised_lenses import JonesPupil
from torchdic.instrument.prism import Prism
from torchdic.scalar import number


@dataclass(frozen=True, eq=False)
class Microscope:
    """A microscope: what exists, whatever is recorded with it.

    wavelength: in vacuum, µm.
    objective: None lets every propagating wave through.
    condenser: None is one axial plane wave.
    camera: its pixels and its noise; the images of `image` are noiseless all the same.
    spectrum: light of several wavelengths, of which `wavelength` is the nominal one; None is `wavelength` alone.
    polarisation: errors of the polarising optics; None is ideal crossed polarisers.
    condenser_prism: whether a second prism in front of the condenser cancels each source's tilt, as in Nomarski's
    microscope. Without it the phase between the beams of an oblique source changes by 2π f_s·s, and a wide condenser
    reduces the contrast by the factor 2J1(a)/a with a = 2π|s|NA_c/λ.

    Raises ValueError for a wavelength that isn't positive or lies outside the spectrum, and for Zernike terms of the
    polarisation's pupil without an objective.
    """

    wavelength: float
    objective: Objective | None = None
    condenser: Condenser | None = None
    camera: Camera | None = None
    spectrum: Spectrum | None = None
    polarisation: Polarisation | None = None
    condenser_prism: bool = True

    def __post_init__(self) -> None:
        if not (0 < self.wavelength < float("inf")):
            raise ValueError(f"wavelength {self.wavelength} µm must be above 0")
        if self.spectrum is not None:
            low, high = min(self.spectrum.wavelengths), max(self.spectrum.wavelengths)
            if not (low <= self.wavelength <= high):
                raise ValueError(f"wavelength {self.wavelength} µm lies outside its spectrum, {low} to {high} µm")
        if self.lenses is not None and self.lenses.strained and self.objective is None:
            raise ValueError("polarisation pupil: Zernike terms need the radius of a pupil, and objective is None")

    @property
    def polarisers(self) -> Polarisation | None:
        """Polariser, analyser and compensator's plate; None where they are ideal."""
        polarisation = self.polarisation
        return polarisation if polarisation is not None and polarisation.declared else None

    @property
    def lenses(self) -> JonesPupil | None:
        """What the lenses do to polarisation; None where they leave it alone, so that the two beams are scalar."""
        pupil = None if self.polarisation is None else self.polarisation.pupil
        return pupil if pupil is not None and (pupil.strained or pupil.depolarisation) else None

    @property
    def turns_polarisation(self) -> bool:
        """Whether lenses turn polarisation between pupil and specimen; bent rays then carry their polarisation."""
        return self.lenses is not None and self.lenses.depolarisation

    @property
    def reach(self) -> float:
        """The largest transverse momentum n·sinθ in the image of an oblique source's envelope, NA_o + NA_c."""
        condenser = 0.0 if self.condenser is None else self.condenser.na
        return condenser + (0.0 if self.objective is None else self.objective.na)

    def colours(self) -> list[tuple["Microscope", float]]:
        """For each wavelength of the light, a microscope of that wavelength and its share; the shares sum to 1."""
        if self.spectrum is None:
            return [(self, 1.0)]
        return [
            (replace(self, wavelength=wavelength, spectrum=None), share)
            for wavelength, share in zip(self.spectrum.wavelengths, self.spectrum.shares, strict=True)
        ]

    def sources(
        self, count: int, *, dtype: torch.dtype | None = None, device: torch.device | str | None = None
    ) -> tuple[Float[Tensor, "source 2"], Float[Tensor, " source"]]:
        """Directions n·sinθ (source, 2) of the illumination and their weights (source,), see `Condenser.sources`."""
        condenser = self.condenser or Condenser(0.0)
        pupil = None if self.objective is None else self.objective.na
        return condenser.sources(count, pupil=pupil, dtype=dtype, device=device)

    def lit_from(
        self, points: Float[Tensor, "source 2"], weights: Float[Tensor, " source"] | None = None
    ) -> "Microscope":
        """The same microscope with these directions of the condenser only, see `Condenser`."""
        na = 0.0 if self.condenser is None else self.condenser.na
        return replace(self, condenser=Condenser(na, points, weights))


@dataclass(frozen=True, eq=False)
class Acquisition:
    """What was recorded: an image for each prism and each focus plane.

    prisms: the prism's settings; None is bright field.
    focus: depths z_f in µm that are sharp, numbers or 0-d tensors; tensors are learned.

    Raises ValueError where either is empty, or a focus isn't finite.
    """

    prisms: Sequence[Prism | None] = (None,)
    focus: Sequence[float | Tensor] = (0.0,)

    def __post_init__(self) -> None:
        if len(self.prisms) == 0 or len(self.focus) == 0:
            raise ValueError("an acquisition needs at least one prism (or None for bright field) and one focus plane")
        for focus in self.focus:
            depth = number(focus)
            if not math.isfinite(depth):
                raise ValueError(f"focus {depth} must be a finite depth in µm")
        object.__setattr__(self, "prisms", tuple(self.prisms))
        object.__setattr__(self, "focus", tuple(self.focus))


def check_apertures(microscope: Microscope, background: float, dtype: torch.dtype = torch.float64) -> None:
    """Raise ValueError where an aperture exceeds the medium's index, so that no wave fills it.

    background: refractive index of the medium.
    dtype: precision in which p_z = √(n² − |p|²) of each condenser direction must stay above 0 in spite of rounding.
    """
    condenser = microscope.condenser
    apertures = {"objective": microscope.objective, "condenser": condenser}
    for name, part in apertures.items():
        if part is not None and part.na > background:
            raise ValueError(f"{name} NA {part.na:g} exceeds the medium's index {background:g}")
    if condenser is not None:
        largest = condenser.na if condenser.points is None else float(condenser.points.detach().norm(dim=-1).max())
        if largest >= background * (1 - 4 * torch.finfo(dtype).eps):
            raise ValueError(
                f"condenser direction n·sinθ {largest:g} must stay below the medium's index {background:g}"
            )


def check_sampling(microscope: Microscope, grid: Grid) -> None:
    """Warn with SamplingWarning where voxels are too coarse for the light, or the array too small for the objective.

    The warnings name the line of code that called `image` or another function that checks: two calls further out.
    """
    reach = microscope.reach
    sides = [(n, d) for n, d in zip(grid.shape[1:], grid.spacing[1:], strict=True) if n > 1]
    coarsest = max((d for _, d in sides), default=0.0)
    shortest = min(part.wavelength for part, _ in microscope.colours())
    if reach > 0 and coarsest > shortest / (2 * reach):
        warnings.warn(
            f"voxels of {coarsest:g} µm are coarser than λ/(2(NA_o + NA_c)) = "
            f"{shortest / (2 * reach):.3g} µm: the finest detail is lost",
            SamplingWarning,
            stacklevel=3,
        )
    widest = max((n * d for n, d in sides), default=math.inf)
    if microscope.objective is not None and microscope.objective.na < shortest / widest:
        warnings.warn(
            f"objective NA {microscope.objective.na:g} is narrower than one frequency of the array, λ/L = "
            f"{shortest / widest:.3g}: no detail of the specimen passes; a side L above "
            f"{shortest / microscope.objective.na:.3g} µm holds the first",
            SamplingWarning,
            stacklevel=3,
        )
