"""The microscope, and what was recorded with it."""

import math
import warnings
from collections.abc import Sequence, Sized
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from torchdic.errors import ApertureWarning, SamplingWarning
from torchdic.grid import Grid
from torchdic.instrument.camera import Camera
from torchdic.instrument.condenser import Condenser, Spectrum
from torchdic.instrument.objective import Objective
from torchdic.instrument.polarisation import Polarisation
from torchdic.instrument.polarised_lenses import JonesPupil
from torchdic.instrument.prism import Prism
from torchdic.scalar import number

# No lens has a larger aperture: the densest immersion has the index 1.78. A denser medium permits a larger one.
LARGEST_NA = 1.8

# Apertures and indices closer than this are the same, relatively.
_ROUNDING = 1e-6


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
    polarisation's pupil without an objective; TypeError for a part that is no such part, as a bare aperture is none.
    """

    wavelength: float
    objective: Objective | None = None
    condenser: Condenser | None = None
    camera: Camera | None = None
    spectrum: Spectrum | None = None
    polarisation: Polarisation | None = None
    condenser_prism: bool = True

    def __post_init__(self) -> None:
        for name, value, kind in (
            ("objective", self.objective, Objective),
            ("condenser", self.condenser, Condenser),
            ("camera", self.camera, Camera),
        ):
            if value is not None and not isinstance(value, kind):
                raise TypeError(f"{name} {value} must be {kind.__name__}(…) or None")
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

    def reach(self, background: float) -> float:
        """The largest transverse momentum n·sinθ in the image of an oblique source's envelope, NA_o + NA_c.

        background: refractive index of the medium; no aperture counts beyond it.
        """
        condenser = 0.0 if self.condenser is None else min(self.condenser.na, background)
        return condenser + (0.0 if self.objective is None else self.objective.reach(background))

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
        pupil = None if self.objective is None else self.objective.reach()
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
        for name, value, such in (("prisms", self.prisms, "[Prism(…)]"), ("focus", self.focus, "[0.0]")):
            if not isinstance(value, Sized):
                raise TypeError(f"{name} {value} must be a sequence, such as {such}")
        if len(self.prisms) == 0 or len(self.focus) == 0:
            raise ValueError("an acquisition needs at least one prism (or None for bright field) and one focus plane")
        for focus in self.focus:
            depth = number(focus)
            if not math.isfinite(depth):
                raise ValueError(f"focus {depth} must be a finite depth in µm")
        object.__setattr__(self, "prisms", tuple(self.prisms))
        object.__setattr__(self, "focus", tuple(self.focus))


def check_apertures(microscope: Microscope, background: float, dtype: torch.dtype = torch.float64) -> None:
    """Raise ValueError for an aperture that no lens has, and where a condenser lights the specimen with no wave.

    background: refractive index of the medium.
    dtype: precision in which p_z = √(n² − |p|²) of each condenser direction must stay above 0 in spite of rounding.
    """
    condenser, largest = microscope.condenser, max(background, LARGEST_NA)
    for name, part in (("objective", microscope.objective), ("condenser", condenser)):
        if part is not None and part.na > largest:
            raise ValueError(f"{name} NA {part.na:g} must be at most {largest:g}: no immersion has a higher index")
    if condenser is None:
        return
    if condenser.points is not None:
        steepest = float(condenser.points.detach().norm(dim=-1).max())
        if steepest >= background * (1 - 4 * torch.finfo(dtype).eps):
            raise ValueError(
                f"condenser direction n·sinθ {steepest:g} must stay below the medium's index {background:g}"
            )
    elif (condenser.inner_na or 0.0) > _below(background, dtype):
        raise ValueError(
            f"condenser inner NA {condenser.inner_na:g} must stay below the medium's index {background:g}: "
            "no light enters the medium"
        )


def limited(microscope: Microscope, background: float, dtype: torch.dtype = torch.float64) -> Microscope:
    """The microscope whose condenser ends at the medium's index, beyond which its light doesn't enter the medium.

    background: refractive index of the medium. A learned index gives the directions no gradient: they stay as they are.
    dtype: precision in which each direction must stay below the index.

    The objective keeps its aperture, in which its aberrations are declared: its pupil passes no evanescent wave.
    """
    if microscope.condenser is None:
        return microscope
    return replace(microscope, condenser=microscope.condenser.limited(_below(background, dtype)))


def in_medium(microscope: Microscope, background: float, dtype: torch.dtype = torch.float64) -> Microscope:
    """The microscope as `limited`, after `check_apertures`; warns with ApertureWarning of apertures beyond the index.

    Arguments and errors as of these. The warning names the line of code two calls further out.
    """
    check_apertures(microscope, background, dtype)
    objective, condenser = microscope.objective, microscope.condenser
    beyond, hint = [], ""
    # an index that float32 has rounded is still the same
    if objective is not None and objective.na > objective.reach(background) * (1 + _ROUNDING):
        lowest = objective.reach(background)
        owner = "medium's" if math.isclose(lowest, background, rel_tol=_ROUNDING) else "layer's"
        beyond.append(f"objective NA {objective.na:g} exceeds the {owner} index {lowest:g}")
        if objective.layer is None:
            hint = "; declare a mismatch of oil, glass and specimen as the objective's layer (Layer)"
    if condenser is not None and condenser.na > background * (1 + _ROUNDING):
        beyond.append(f"condenser NA {condenser.na:g} exceeds the medium's index {background:g}")
    if beyond:
        warnings.warn(f"{' and '.join(beyond)}: light beyond the index is dark{hint}", ApertureWarning, stacklevel=3)
    return limited(microscope, background, dtype)


def _below(background: float, dtype: torch.dtype) -> float:
    """The largest aperture whose directions all have a p_z above 0 in spite of rounding."""
    return background * (1 - 8 * torch.finfo(dtype).eps)


def check_sampling(microscope: Microscope, grid: Grid, background: float) -> None:
    """Warn with SamplingWarning where voxels are too coarse for the light, or the array too small for the objective.

    background: refractive index of the medium.
    The warnings name the line of code that called `image` or another function that checks: two calls further out.
    """
    reach = microscope.reach(background)
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
