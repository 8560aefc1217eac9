"""The whole microscope: from a specimen to the images of its prisms and focus planes."""

import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F
from jaxtyping import Complex, Float
from torch import Tensor

from torchdic.camera import Camera
from torchdic.condenser import Condenser, Spectrum
from torchdic.fidelity import STANDARD, Defocus, Fidelity
from torchdic.grid import Grid
from torchdic.jones import Polarisation, unpolarised
from torchdic.jones_pupil import product, turn
from torchdic.landing import ray_field
from torchdic.objective import Objective
from torchdic.prism import Prism
from torchdic.projection import kept_by_projection, project
from torchdic.rays import kept_by_rays
from torchdic.recompute import sum_over_sources
from torchdic.space_variant import Levels, object_levels
from torchdic.volume import Volume
from torchdic.wave import (
    axial_difference,
    exp_i,
    kept_by_wave,
    paraxial_difference,
    split_step,
    to_field,
    to_spectrum,
)

# Values per source and pixel that autograd keeps of a pupil of Jones matrices, all of whose terms are learned.
KEPT_BY_MATRIX = 50
KEPT = {"projection": kept_by_projection, "rays": kept_by_rays, "wave": kept_by_wave}


class SamplingWarning(UserWarning):
    """The grid is coarser than the light that the microscope lets through."""


@dataclass(frozen=True, eq=False)
class Microscope:
    """What the microscope is.

    wavelength: in vacuum, µm. objective: None lets every propagating wave through. condenser: None is one axial plane
    wave. camera: what it records of an image; the images of `image` are noiseless all the same. spectrum: light of
    several wavelengths, among which `wavelength` is the nominal one; None is light of `wavelength` alone. polarisation:
    None is ideal crossed polarisers. condenser_prism: whether a second prism in front of the condenser makes up for
    each source's tilt, as in Nomarski's microscope; without it the beams of an oblique source differ by 2π f_s·s more,
    and a wide condenser washes the contrast out, by 2J1(a)/a with a = 2π|s|NA_c/λ.
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
        pupil = None if self.polarisation is None else self.polarisation.pupil
        if pupil is not None and pupil.strained and self.objective is None:
            raise ValueError("polarisation pupil: Zernike terms need the radius of a pupil, and objective is None")

    @property
    def vectorial(self) -> bool:
        """Whether lenses mix the beams' polarisations, so that they are no scalar pair."""
        return self.polarisation is not None and self.polarisation.vectorial

    @property
    def turns(self) -> bool:
        """Whether condenser and objective turn polarisation between pupil and specimen."""
        pupil = None if self.polarisation is None else self.polarisation.pupil
        return pupil is not None and pupil.depolarisation

    @property
    def reach(self) -> float:
        """The largest transverse momentum that an image's envelope can hold, NA_o + NA_c."""
        condenser = 0.0 if self.condenser is None else self.condenser.na
        return condenser + (0.0 if self.objective is None else self.objective.na)

    def colours(self) -> list[tuple["Microscope", float]]:
        """A microscope of one wavelength for each of the light's, with its share; the shares sum to 1."""
        if self.spectrum is None:
            return [(self, 1.0)]
        return [
            (replace(self, wavelength=wavelength, spectrum=None), share)
            for wavelength, share in zip(self.spectrum.wavelengths, self.spectrum.shares, strict=True)
        ]

    def sources(
        self, fidelity: Fidelity, *, dtype: torch.dtype, device: torch.device
    ) -> tuple[Float[Tensor, "source 2"], Float[Tensor, " source"]]:
        """Directions n·sinθ (source, 2) of the illumination and their weights (source,), which sum to 1."""
        condenser = self.condenser or Condenser(0.0)
        return condenser.sources(fidelity.sources, dtype=dtype, device=device)


@dataclass(frozen=True, eq=False)
class Acquisition:
    """What was recorded: an image for each prism and each focus plane.

    prisms: Prism settings; None is bright field. focus: depths z_f in µm that are sharp, numbers or 0-d tensors, which
    are learned. Raises ValueError where either is empty or a focus isn't finite.
    """

    prisms: Sequence[Prism | None] = (None,)
    focus: Sequence[float | Tensor] = (0.0,)

    def __post_init__(self) -> None:
        if len(self.prisms) == 0 or len(self.focus) == 0:
            raise ValueError("an acquisition needs at least one prism (or None for bright field) and one focus plane")
        for focus in self.focus:
            depth = float(torch.as_tensor(focus, dtype=torch.float64).detach())
            if not math.isfinite(depth):
                raise ValueError(f"focus {depth} must be a finite depth in µm")
        object.__setattr__(self, "prisms", tuple(self.prisms))
        object.__setattr__(self, "focus", tuple(self.focus))


def image(
    volume: Volume, microscope: Microscope, acquisition: Acquisition, fidelity: Fidelity = STANDARD
) -> Float[Tensor, "prism focus y x"]:
    """Images of a volume, relative to the empty bright field.

    Pixels are the volume's (y, x) voxel centres, or those of a camera that has a pixel size. Raises ValueError where an
    aperture exceeds the medium's index; warns with SamplingWarning where the voxels are coarser than the light.
    """
    check_apertures(microscope, float(volume.background.detach()))
    _check_sampling(microscope, volume.grid)
    if microscope.spectrum is None:
        return _image(volume, microscope, acquisition, fidelity)
    colours = microscope.colours()
    fidelity = replace(fidelity, memory=max(1, fidelity.memory // len(colours)))
    images = [share * _image(volume, part, acquisition, fidelity) for part, share in colours]
    return images[0] if len(images) == 1 else torch.stack(images).sum(0)


def _image(
    volume: Volume, microscope: Microscope, acquisition: Acquisition, fidelity: Fidelity
) -> Float[Tensor, "prism focus y x"]:
    """`image` in light of one wavelength."""
    pad = fidelity.padding
    volume = _padded(volume, pad)
    momentum, weights = microscope.sources(fidelity, dtype=volume.delta.dtype, device=volume.delta.device)
    plane = fidelity.reference_plane
    if fidelity.propagation == "wave":
        plane = volume.grid.extent[0] / 2
    elif plane is None:
        plane = volume.mean_plane()

    levels = None
    if fidelity.object_aberration is not None:
        parts = microscope.wavelength, microscope.objective, microscope.condenser
        levels = object_levels(volume, plane, *parts, momentum, fidelity)

    def intensity(momentum: Tensor, weights: Tensor) -> Tensor:
        spectrum = propagate(volume, microscope.wavelength, momentum, plane, fidelity, levels, turned=microscope.turns)
        return form_image(
            spectrum,
            volume.grid,
            volume.background,
            plane,
            momentum,
            weights,
            microscope,
            acquisition,
            fidelity.defocus,
        )

    components = 2 if microscope.turns and fidelity.propagation == "rays" else 1
    kept = KEPT[fidelity.propagation](volume.grid, fidelity) + _kept_by_imaging(microscope, acquisition, components)
    kept += 0 if levels is None else components * levels.kept
    total = sum_over_sources(intensity, (momentum, weights), volume.delta[0].numel(), kept, fidelity.memory)
    return _seen(total, volume.grid, pad, microscope.camera)


def propagate(
    volume: Volume,
    wavelength: float,
    momentum: Float[Tensor, "source 2"],
    plane: float,
    fidelity: Fidelity,
    levels: Levels | None = None,
    *,
    turned: bool = False,
) -> Complex[Tensor, "source *component y x"]:
    """Spectrum of each source's envelope behind the specimen, referred to depth `plane` (the last face for a wave).

    levels: of the defocus with which each point of a field that rays make spreads. turned: whether bent rays carry
    their polarisation. Theirs is then (source, 2, y, x), the components along +x and +y of light that comes in along
    +x; the other ways across the specimen stay scalar.
    """
    if fidelity.propagation == "wave":
        return split_step(volume, wavelength, momentum, fidelity)
    if fidelity.propagation == "projection":
        field = project(volume, wavelength, momentum, plane, fidelity)
    else:
        field = ray_field(volume, wavelength, momentum, plane, fidelity, turned=turned)
    if levels is None:
        return to_spectrum(field)
    if fidelity.defocus == "paraxial":
        difference = paraxial_difference(volume.grid, wavelength, volume.background, momentum)
    else:
        difference, _ = axial_difference(volume.grid, wavelength, volume.background, momentum)
    return levels.spread(field, wavelength, difference)


def image_field(
    transmission: Tensor,
    grid: Grid,
    microscope: Microscope,
    acquisition: Acquisition,
    *,
    background: float | Tensor,
    fidelity: Fidelity = STANDARD,
) -> Float[Tensor, "prism focus y x"]:
    """Images of a thin complex transmission at z = 0, relative to the empty bright field.

    transmission: (y, x), the same for every source, or (source, y, x), each source's own envelope (its tilt removed) in
    the order of the microscope's sources. grid: its pixels (the number of slices plays no part). background: index of
    the medium. Raises ValueError as `image` does, where a shape is not the grid's, and for light of a spectrum, in each
    of whose wavelengths a transmission is another one.
    """
    if microscope.spectrum is not None:
        raise ValueError(
            f"a transmission belongs to one wavelength, the spectrum has {len(microscope.spectrum.wavelengths)}: "
            "sum the images over Microscope.colours()"
        )
    check_apertures(microscope, float(torch.as_tensor(background, dtype=torch.float64).detach()))
    _check_sampling(microscope, grid)
    if not transmission.is_complex():
        transmission = torch.complex(transmission, torch.zeros_like(transmission))
    real = transmission.real
    momentum, weights = microscope.sources(fidelity, dtype=real.dtype, device=real.device)
    expected = (*((len(weights),) if transmission.ndim == 3 else ()), *grid.shape[1:])
    if tuple(transmission.shape) != expected:
        raise ValueError(f"transmission has shape {tuple(transmission.shape)}, the grid and sources ask for {expected}")
    n0 = torch.as_tensor(background, dtype=real.dtype, device=real.device)
    pad = fidelity.padding
    grid = grid.widened(pad, pad)
    spectra = to_spectrum(F.pad(transmission, (pad,) * 4, value=1.0))

    def intensity(momentum: Tensor, weights: Tensor, spectra: Tensor) -> Tensor:
        return form_image(spectra, grid, n0, 0.0, momentum, weights, microscope, acquisition, fidelity.defocus)

    own = spectra if spectra.ndim == 3 else spectra.expand(len(weights), -1, -1)
    kept = _kept_by_imaging(microscope, acquisition)
    total = sum_over_sources(intensity, (momentum, weights, own), own[0].numel(), kept, fidelity.memory)
    return _seen(total, grid, pad, microscope.camera)


def form_image(
    spectrum: Complex[Tensor, "source *component y x"],
    grid: Grid,
    background: Tensor,
    plane: float,
    momentum: Float[Tensor, "source 2"],
    weights: Float[Tensor, " source"],
    microscope: Microscope,
    acquisition: Acquisition,
    defocus: Defocus = "exact",
) -> Float[Tensor, "prism focus y x"]:
    """Σ over sources of weight·|F⁻¹[D·pupil·defocus·S]|², the spectra S referred to depth `plane` (µm).

    Pupil and defocus act on the field's frequency f + f_s, the prism's shear on the envelope's f if a condenser prism
    makes up for the tilt. Behind a pupil of Jones matrices it is the sum over pure states of the light, each with a D
    of its own, see `Polarisation.transfers`. spectrum: with the components of `propagate` where rays are turned.
    """
    k0 = 2 * math.pi / microscope.wavelength
    frequencies = grid.frequencies(dtype=momentum.dtype, device=momentum.device)
    difference, pz = axial_difference(grid, microscope.wavelength, background, momentum)
    passes = pz > 0
    if defocus == "paraxial":
        difference = paraxial_difference(grid, microscope.wavelength, background, momentum)
    turned = spectrum.ndim == 4
    if turned:
        spectrum = spectrum.movedim(1, 0)
    if microscope.objective is not None:
        waves = momentum[:, :, None, None] + microscope.wavelength * frequencies
        passes = passes & microscope.objective.aperture(waves)
        pupil = microscope.objective.transfer(waves, momentum, microscope.wavelength, background)
        if pupil is not None:
            spectrum = spectrum * pupil
    spectrum = torch.where(passes, spectrum, 0)
    if not microscope.condenser_prism or microscope.vectorial:
        frequencies = frequencies + momentum[:, :, None, None] / microscope.wavelength

    def sharp(focus: float | Tensor) -> Tensor:
        depth = torch.as_tensor(focus, dtype=difference.dtype, device=difference.device)
        return spectrum * exp_i(k0 * (depth - plane) * difference)

    if microscope.vectorial:
        transfers = _state_transfers(frequencies, passes, momentum, background, microscope, acquisition, turned)
        images = []
        for focus in acquisition.focus:
            wave = sharp(focus)
            for shares, transfer in transfers:
                field = to_field((transfer * wave).sum(1))
                images.append(torch.einsum("tsyxc,s,t->yx", torch.view_as_real(field).square(), weights, shares))
    else:
        images = _scalar_images(sharp, frequencies, weights, microscope, acquisition)
    shape = (len(acquisition.focus), len(acquisition.prisms), *grid.shape[1:])
    return torch.stack(images).reshape(shape).transpose(0, 1)


def _scalar_images(
    sharp: Callable[[float | Tensor], Tensor],
    frequencies: Tensor,
    weights: Tensor,
    microscope: Microscope,
    acquisition: Acquisition,
) -> list[Tensor]:
    """The images of each focus and prism where lenses leave polarisation alone, so that the beams are a scalar pair."""
    polarisation = microscope.polarisation
    if polarisation is not None and polarisation.ideal:
        polarisation = None
    transfers = [None if prism is None else prism.transfer(frequencies) for prism in acquisition.prisms]
    images = []
    for focus in acquisition.focus:
        wave = sharp(focus)
        for prism, transfer in zip(acquisition.prisms, transfers, strict=True):
            field = to_field(wave if transfer is None else wave * transfer)
            if prism is None or polarisation is None:
                # over the sources first: a sum over two neighbours in memory is slow
                images.append(torch.tensordot(weights, torch.view_as_real(field).square(), 1).sum(-1))
            else:
                stopped = to_field(wave * prism.parallel(frequencies))
                images.append(torch.einsum("syx,s->yx", polarisation.intensity(field, stopped, prism.bias), weights))
    return images


def _state_transfers(
    frequencies: Tensor,
    passes: Tensor,
    momentum: Tensor,
    background: Tensor,
    microscope: Microscope,
    acquisition: Acquisition,
    turned: bool,
) -> list[tuple[Tensor, Tensor]]:
    """For each prism the shares of the light's pure states and what multiplies the spectrum for each of them.

    frequencies: the field's f + f_s.
    """
    polarisation, objective = microscope.polarisation, microscope.objective
    assert polarisation is not None
    assert polarisation.pupil is not None
    # what the aperture stops would overflow, far outside it, in the polynomials and what is made of them
    waves = torch.where(passes[:, None], microscope.wavelength * frequencies, 0)
    matrix = None if objective is None else polarisation.pupil.lenses(waves / objective.na)
    if polarisation.pupil.depolarisation and not turned:
        tilted = turn(waves, momentum, background)
        matrix = tilted if matrix is None else product(matrix, tilted)
    if matrix is None:  # bent rays through plain lenses
        matrix = torch.eye(2, dtype=momentum.dtype, device=momentum.device)[None, :, :, None, None]
    direct = momentum[:, :, None, None] / microscope.wavelength
    transfers = []
    for prism in acquisition.prisms:
        if prism is None:
            transfers.append(unpolarised(matrix, turned=turned))
            continue
        tilt = prism.shear_phase(direct)[:, 0, 0] if microscope.condenser_prism else None
        half, axis = prism.shear_phase(frequencies), prism.polarised_along(momentum)
        transfers.append(polarisation.transfers(matrix, half, tilt, axis, prism.bias, turned=turned))
    return transfers


def _kept_by_imaging(microscope: Microscope, acquisition: Acquisition, components: int = 1) -> int:
    if microscope.vectorial:
        assert microscope.polarisation is not None
        states = sum(4 if prism is None else microscope.polarisation.states for prism in acquisition.prisms)
        per_focus = 4 * components + 2 * states
        return (
            KEPT_BY_MATRIX
            + (4 * states + 10 * len(acquisition.prisms)) * components
            + per_focus * len(acquisition.focus)
        )
    fields = 1 if microscope.polarisation is None or microscope.polarisation.ideal else 2
    per_source = 0 if microscope.condenser_prism else 2 * fields * len(acquisition.prisms)
    return len(acquisition.focus) * (2 + 2 * fields * len(acquisition.prisms)) + per_source


def check_apertures(microscope: Microscope, background: float) -> None:
    """Raise ValueError where an aperture asks for light that the medium's index does not carry."""
    condenser = microscope.condenser
    apertures = {"objective": microscope.objective, "condenser": condenser}
    for name, part in apertures.items():
        if part is not None and part.na > background:
            raise ValueError(f"{name} NA {part.na:g} exceeds the medium's index {background:g}")
    if condenser is not None:
        largest = condenser.na if condenser.points is None else float(condenser.points.detach().norm(dim=-1).max())
        if largest >= background:
            raise ValueError(
                f"condenser direction n·sinθ {largest:g} must stay below the medium's index {background:g}"
            )


def _check_sampling(microscope: Microscope, grid: Grid) -> None:
    reach = microscope.reach
    coarsest = max((d for n, d in zip(grid.shape[1:], grid.spacing[1:], strict=True) if n > 1), default=0.0)
    shortest = min(part.wavelength for part, _ in microscope.colours())
    if reach > 0 and coarsest > shortest / (2 * reach):
        warnings.warn(
            f"voxels of {coarsest:g} µm are coarser than λ/(2(NA_o + NA_c)) = "
            f"{shortest / (2 * reach):.3g} µm: the finest detail is lost",
            SamplingWarning,
            stacklevel=3,
        )


def _padded(volume: Volume, pad: int) -> Volume:
    if pad == 0:
        return volume
    fields = [None if f is None else F.pad(f, (pad,) * 4) for f in (volume.delta, volume.absorption)]
    assert fields[0] is not None
    return Volume(volume.grid.widened(pad, pad), fields[0], volume.background, fields[1])


def _seen(images: Tensor, grid: Grid, pad: int, camera: Camera | None) -> Tensor:
    """The images without their padding, on the camera's pixels if it has any."""
    if camera is not None and camera.pixel_size is not None:
        _, ny, nx = grid.shape
        return camera.integrate(images, grid.spacing[1:], (ny - 2 * pad, nx - 2 * pad))
    return images if pad == 0 else images[..., pad:-pad, pad:-pad]
