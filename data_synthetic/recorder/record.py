"""A specimen and a microscope become a stack as a camera stores it."""

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Integer
from torch import Tensor

from data_synthetic.recorder.faults import Faults
from data_synthetic.specimen import Specimen
from torchdic.fidelity import Fidelity
from torchdic.forward.images import image
from torchdic.grid import Grid
from torchdic.instrument.camera import Camera
from torchdic.instrument.microscope import Acquisition, Microscope
from torchdic.specimen.volume import Volume

_ROUNDING = 1e-6


@dataclass(frozen=True)
class Finer:
    """How much finer than a recording its light is computed.

    parts: of a voxel along (z, y, x).
    margin: pixels on each side by which the computed field is wider, so that no light comes back in at the other side.
    sources: condenser directions, on other rings than those of a reconstruction.
    Raises ValueError for parts or sources below 1, and a margin below 0.
    """

    parts: tuple[int, int, int] = (2, 2, 2)
    margin: int = 24
    sources: int = 112

    def __post_init__(self) -> None:
        for name, value, least in (
            *(("parts", part, 1) for part in self.parts),
            ("margin", self.margin, 0),
            ("sources", self.sources, 1),
        ):
            if isinstance(value, bool) or int(value) != value or value < least:
                raise ValueError(f"{name} {value} must be a whole number of at least {least}")

    def grid(self, field: Grid) -> Grid:
        """The finer voxels of a field and its margin."""
        shape = tuple(n * k for n, k in zip(field.shape, self.parts, strict=True))
        spacing = tuple(d / k for d, k in zip(field.spacing, self.parts, strict=True))
        fine = Grid((shape[0], shape[1], shape[2]), (spacing[0], spacing[1], spacing[2]))
        return fine.widened(self.margin * self.parts[1], self.margin * self.parts[2])


@dataclass(frozen=True, eq=False)
class Recording:
    """A stack as a camera stored it, and all that is true of it.

    data: (prism, focus, y, x), the camera's counts, uint8 or uint16.
    light: of each pixel of each image, relative to an even lamp's empty bright field: what the camera counted.
    truth: Δn (z, y, x) on `field`, the mean over each voxel. background: index of the medium.
    field: the pixels and the slices.
    microscope, acquisition: with which it was recorded; the acquisition's focus is in the order of the stack's planes.
    faults: of the recording. lamp: (y, x). brightness: (prism, focus). shifts: (focus, 2), (y, x) in µm.
    hot, dead: the pixels (True) that are.
    """

    data: Integer[np.ndarray, "prism focus y x"]
    light: Float[Tensor, "prism focus y x"]
    truth: Float[Tensor, "z y x"]
    background: float
    field: Grid
    microscope: Microscope
    acquisition: Acquisition
    faults: Faults
    lamp: Float[Tensor, "y x"]
    brightness: Float[Tensor, "prism focus"]
    shifts: Float[Tensor, "focus 2"]
    hot: Bool[Tensor, "y x"]
    dead: Bool[Tensor, "y x"]

    @property
    def camera(self) -> Camera:
        """The camera, which there is."""
        assert self.microscope.camera is not None
        return self.microscope.camera

    @property
    def focus_step(self) -> float | None:
        """Distance in µm between planes; None for one plane."""
        focus = [float(depth) for depth in self.acquisition.focus]
        return abs(focus[1] - focus[0]) if len(focus) > 1 else None

    @property
    def mean(self) -> Float[Tensor, "prism focus y x"]:
        """The counts that each pixel has on average, before they are rounded and clipped."""
        gain, photons, offset = _camera_numbers(self.camera)
        return offset + gain * photons * self.light

    @property
    def variance(self) -> Float[Tensor, "prism focus y x"]:
        """The variance of each pixel's counts; their rounding adds 1/12."""
        gain, photons, _ = _camera_numbers(self.camera)
        return gain**2 * (photons * self.light + (self.camera.read_noise or 0.0) ** 2)


@torch.no_grad()
def record(
    specimen: Specimen | Volume,
    field: Grid,
    microscope: Microscope,
    acquisition: Acquisition,
    faults: Faults | None = None,
    finer: Finer | None = None,
    seed: int = 0,
) -> Recording:
    """Record a stack of a specimen as a camera stores it; the same seed gives the same stack.

    specimen: known everywhere; or a volume of voxels that are whole parts of the field's, with its own margin.
    field: the camera's pixels (y, x), which are square, and the slices of the truth.
    microscope: with a camera that has photons and bits; its pixels are the field's.
    acquisition: its focus in the order of the stack's planes.
    faults: of lamp, stage and pixels; None is none.
    finer: how much finer the light is computed; None is `Finer()`. Of a volume only `sources` matters.

    A pixel integrates the light over its area (`Camera.integrate`), with the lamp's at its centre. The drift moves the
    specimen's image, by a shift of its spectrum, not the lamp's or the camera's pixels. Photons are drawn by Poisson's
    law, hot pixels' electrons too; then come read noise, gain, offset, rounding, and the clip at 0 and 2^bits − 1.
    Raises ValueError for a camera without photons or bits, pixels that aren't square, and voxels that are no whole
    parts of the field's.
    """
    faults, finer = faults or Faults(), finer or Finer()
    camera = _camera(microscope, field)
    volume, truth = _volume(specimen, field, finer)
    plain = replace(microscope, camera=None)
    fine = image(volume, plain, acquisition, Fidelity("wave", sources=finer.sources, order=2)).double()
    spacing = volume.grid.spacing[1:]
    shifts = faults.shifts(len(acquisition.focus))
    seen = tuple(round(n * d / s) for n, d, s in zip(field.shape[1:], field.spacing[1:], spacing, strict=True))
    light = camera.integrate(_shifted(fine, shifts, spacing), spacing, (seen[0], seen[1])).clamp_min(0)
    random = torch.Generator().manual_seed(seed)
    brightness = faults.brightness((len(light), len(shifts)), random)
    lamp = faults.lamp(field.shape[1:])
    current, dead = faults.stuck(field.shape[1:], random)
    light = torch.where(dead, 0.0, light * lamp * brightness[..., None, None] + current)
    return Recording(
        data=camera.record(light, random).numpy(),
        light=light,
        truth=truth.float(),
        background=float(specimen.background),
        field=field,
        microscope=replace(microscope, camera=camera),
        acquisition=acquisition,
        faults=faults,
        lamp=lamp,
        brightness=brightness,
        shifts=shifts,
        hot=current > 0,
        dead=dead,
    )


def _camera(microscope: Microscope, field: Grid) -> Camera:
    """The microscope's camera, whose pixels are the field's."""
    camera, (_, dy, dx) = microscope.camera, field.spacing
    if camera is None or camera.photons is None or camera.bits is None:
        raise ValueError("a recording needs a camera with photons and bits")
    if abs(dy - dx) > _ROUNDING * dx:
        raise ValueError(f"a camera's pixels are square, the field's are {dy:g} × {dx:g} µm")
    if camera.pixel_size is not None and abs(camera.pixel_spacing((dy, dx))[0] - dx) > _ROUNDING * dx:
        raise ValueError(f"the camera's pixels have {camera.pixel_spacing((dy, dx))[0]:g} µm, the field's {dx:g} µm")
    return replace(camera, pixel_size=dx, magnification=None)


def _volume(specimen: Specimen | Volume, field: Grid, finer: Finer) -> tuple[Volume, Float[Tensor, "z y x"]]:
    """The finer voxels that are imaged, and the mean of theirs in each voxel of the field."""
    if isinstance(specimen, Volume):
        volume = specimen
    else:
        grid = finer.grid(field)
        volume = Volume(grid, specimen.delta(grid, dtype=torch.float32), specimen.background)
    parts, margins = [], []
    for axis, (fine, coarse) in enumerate(zip(volume.grid.spacing, field.spacing, strict=True)):
        part = max(round(coarse / fine), 1)
        beyond = volume.grid.shape[axis] - part * field.shape[axis]
        if abs(part * fine - coarse) > _ROUNDING * coarse or beyond < 0 or beyond % 2 or (axis == 0 and beyond):
            raise ValueError(
                f"{volume.grid.shape[axis]} voxels of {fine:g} µm along {'zyx'[axis]} are no whole parts of the "
                f"field's {field.shape[axis]} of {coarse:g} µm, with as many more on both sides"
            )
        parts.append(part)
        margins.append(beyond // 2)
    inner = volume.delta[tuple(slice(m, volume.grid.shape[a] - m) for a, m in enumerate(margins))]
    (nz, ny, nx), (kz, ky, kx) = field.shape, parts
    return volume, inner.detach().double().reshape(nz, kz, ny, ky, nx, kx).mean((1, 3, 5))


def _shifted(
    images: Float[Tensor, "prism focus y x"], shifts: Float[Tensor, "focus 2"], spacing: tuple[float, float]
) -> Float[Tensor, "prism focus y x"]:
    """Periodic images moved by (y, x) in µm in each plane, exactly, by the phase of their spectrum."""
    if not bool(shifts.any()):
        return images
    fy, fx = (torch.fft.fftfreq(n, d, dtype=torch.float64) for n, d in zip(images.shape[2:], spacing, strict=True))
    turns = shifts[:, 0, None, None] * fy[:, None] + shifts[:, 1, None, None] * fx
    return torch.fft.ifft2(torch.fft.fft2(images) * torch.exp(-2j * math.pi * turns)).real


def _camera_numbers(camera: Camera) -> tuple[float, float, float]:
    """Gain, photons and offset."""
    assert camera.photons is not None
    return (1.0 if camera.gain is None else camera.gain), camera.photons, camera.offset or 0.0
