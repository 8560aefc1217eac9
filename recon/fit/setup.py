"""What images are computed from: the specimen, the microscope, what was recorded, and how it was recorded."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Shaped
from torch import Tensor

from torchdic import Acquisition, Fidelity, Grid, Microscope, Volume, image

# Terms of the lamp's surface.
TERMS = 5


@dataclass(frozen=True, eq=False)
class Setup:
    """The specimen, the microscope and the acquisition, as far as they are known, and what the recording did to them.

    volume: Δn, or an empty one where it is sought, see `empty_medium`. microscope, acquisition: as in `torchdic.image`.
    brightness: of each image (prism, focus), relative to what the model expects; None is 1.
    drift: of each image (prism, focus, 2), µm (y, x): a positive one moves the specimen's picture towards +y and +x.
    None is no drift.
    lamp: coefficients (prism, 5) of a curved surface s: each prism's images are lit by 1 + s. Its terms are y, x, y²,
    xy and x², each without its mean over the field; y and x run from −1 to 1. None is an even lamp.
    margin: voxels by which the volume is wider than the field of the images on each side. Where the specimen goes on
    beyond the field, a volume of the field's own size can't explain the images.

    Brightness, drift and lamp may be learned. Raises ValueError where a shape isn't the acquisition's, or the margin is
    below 0 or leaves no field.
    """

    volume: Volume
    microscope: Microscope
    acquisition: Acquisition
    brightness: Float[Tensor, "prism focus"] | None = None
    drift: Float[Tensor, "prism focus 2"] | None = None
    lamp: Float[Tensor, "prism 5"] | None = None
    margin: int = 0

    def __post_init__(self) -> None:
        images = len(self.acquisition.prisms), len(self.acquisition.focus)
        given = ("brightness", self.brightness, images), ("drift", self.drift, (*images, 2))
        for name, value, expected in (*given, ("lamp", self.lamp, (images[0], TERMS))):
            if value is not None and tuple(value.shape) != expected:
                raise ValueError(f"the {name} has shape {tuple(value.shape)}, the acquisition asks for {expected}")
        sides = self.volume.grid.shape[1:]
        if not (0 <= 2 * self.margin < min(sides)):
            raise ValueError(
                f"margin {self.margin} must be at least 0 and leave some of {sides[0]} × {sides[1]} voxels"
            )

    @property
    def field(self) -> Grid:
        """The volume's grid without the margin: the voxels behind the images."""
        return self.volume.grid.widened(-self.margin, -self.margin)

    @property
    def dilution(self) -> float:
        """Voxels of the volume for each of the field's.

        Priors are means over all voxels, misfits over the field's pixels: a weight means this many times as much
        without the margin.
        """
        return math.prod(self.volume.grid.shape[1:]) / math.prod(self.field.shape[1:])

    @property
    def sees_voxels(self) -> bool:
        """Whether the images' pixels are voxels, not those of a camera."""
        camera = self.microscope.camera
        return camera is None or camera.pixel_size is None

    @property
    def shape(self) -> tuple[int, int, int, int]:
        """The images' shape (prism, focus, y, x)."""
        _, rows, columns = self.pixels.shape
        return len(self.acquisition.prisms), len(self.acquisition.focus), rows, columns

    @property
    def pixels(self) -> Grid:
        """The images' pixels as a grid (z, y, x): those of the camera, or the field's voxels."""
        return pixels_of(self.field, self.microscope)

    def images(self, fidelity: Fidelity) -> Float[Tensor, "prism focus y x"]:
        """The images, relative to the empty bright field, as `torchdic.image`; differentiable."""
        if self.drift is None and self.margin == 0:
            return self._lit(image(self.volume, self.microscope, self.acquisition, fidelity))
        return self.recorded(self.formed(fidelity))

    def formed(self, fidelity: Fidelity) -> Float[Tensor, "prism focus y x"]:
        """The images that the microscope forms: on the voxels of the whole volume, without drift and brightness."""
        microscope = self.microscope if self.sees_voxels else replace(self.microscope, camera=None)
        return image(self.volume, microscope, self.acquisition, fidelity)

    def recorded(self, formed: Float[Tensor, "prism focus row column"]) -> Float[Tensor, "prism focus y x"]:
        """What is recorded of the images that the microscope forms: moved by the drift, within the field, lit."""
        _, dy, dx = self.volume.grid.spacing
        images = formed if self.drift is None else shifted(formed, self.drift, (dy, dx))
        camera = self.microscope.camera
        if camera is not None and not self.sees_voxels:
            _, ny, nx = self.field.shape
            images = camera.integrate(images, (dy, dx), (ny, nx))
        else:
            images = self.within_field(images)
        return self._lit(images)

    def within_field(self, values: Shaped[Tensor, "*axes row column"]) -> Shaped[Tensor, "*axes y x"]:
        """Values of the volume's pixels or voxels, without those of the margin."""
        within = slice(self.margin, -self.margin or None)
        return values[..., within, within]

    def at_rest(self, data: Float[Tensor, "prism focus row column"]) -> Float[Tensor, "prism focus y x"]:
        """Recorded images as they would be without the drift and of brightness 1, on the field's voxels."""
        _, dy, dx = self.pixels.spacing
        images = data if self.drift is None else shifted(data, -self.drift, (dy, dx))
        images = images if self.sees_voxels else on_voxels(images, self.pixels, self.field)
        for light in self._lights(images):
            images = images / light
        return images

    def _lit(self, images: Tensor) -> Tensor:
        for light in self._lights(images):
            images = images * light
        return images

    def _lights(self, images: Tensor) -> Iterator[Tensor]:
        """What multiplies the images' pixels, relative to an even and steady lamp."""
        if self.brightness is not None:
            yield self.brightness.to(images)[..., None, None]
        if self.lamp is not None:
            yield (1 + torch.einsum("pt,tyx->pyx", self.lamp.to(images), _surfaces(images)))[:, None]


def _surfaces(images: Tensor) -> Float[Tensor, "term y x"]:
    """The lamp's terms on the pixels of images."""
    ny, nx = images.shape[-2:]
    y = torch.linspace(-1, 1, ny, dtype=images.dtype, device=images.device)[:, None].expand(ny, nx)
    x = torch.linspace(-1, 1, nx, dtype=images.dtype, device=images.device).expand(ny, nx)
    terms = torch.stack((y, x, y.square(), x * y, x.square()))
    return terms - terms.mean((1, 2), keepdim=True)


def empty_medium(grid: Grid, background: float, like: Tensor) -> Volume:
    """A volume of Δn = 0 that takes no memory.

    grid: its voxels. background: the medium's index. like: gives the dtype and device, as the data do; of any shape.
    """
    return Volume(grid, like.new_zeros(()).expand(grid.shape), background)


def pixels_of(field: Grid, microscope: Microscope) -> Grid:
    """The pixels of a field's images as a grid (z, y, x): those of the camera, or the field's voxels.

    Raises ValueError where no pixel of the camera fits into the field.
    """
    camera = microscope.camera
    if camera is None or camera.pixel_size is None:
        return field
    (nz, ny, nx), (dz, dy, dx) = field.shape, field.spacing
    return Grid((nz, *camera.pixels((ny, nx), (dy, dx))), (dz, *camera.pixel_spacing((dy, dx))))


def on_voxels(
    images: Float[Tensor, "prism focus row column"], pixels: Grid, field: Grid
) -> Float[Tensor, "prism focus y x"]:
    """Images on a field's voxels by cubic interpolation; beyond their outermost pixels' centres they go on.

    pixels: theirs; both grids have the same centre. Images on finer pixels are sampled, not averaged.
    """
    rows, columns = (
        _cubic(field.coordinates(axis, dtype=torch.float64), pixels.shape[axis], pixels.spacing[axis]).to(images)
        for axis in (1, 2)
    )
    return rows @ images @ columns.mT


def _cubic(places: Float[Tensor, " place"], count: int, side: float) -> Float[Tensor, "place pixel"]:
    """The matrix that takes values at pixels' centres to values at places, µm (R. Keys, IEEE Trans. ASSP 29, 1153)."""
    at = (places / side + (count - 1) / 2).clamp(0, count - 1)
    matrix = places.new_zeros(len(places), count)
    for away in range(-1, 3):
        pixel = at.floor() + away
        t = (at - pixel).abs()
        weight = torch.where(t < 1, (1.5 * t - 2.5) * t**2 + 1, ((-0.5 * t + 2.5) * t - 4) * t + 2)
        weight = torch.where(t < 2, weight, 0)
        matrix.scatter_add_(1, pixel.clamp(0, count - 1).long()[:, None], weight[:, None])
    return matrix


def shifted(
    images: Float[Tensor, "prism focus y x"], by: Float[Tensor, "prism focus 2"], spacing: tuple[float, float]
) -> Float[Tensor, "prism focus y x"]:
    """Periodic images, each moved by its own distance (y, x) in µm: the trigonometric polynomial through its pixels.

    spacing: of the pixels (y, x), µm. Differentiable in both.
    """
    ny, nx = images.shape[-2:]
    by = by.to(images)
    rows = _ramp(torch.fft.fftfreq(ny, spacing[0], dtype=torch.float64), by[..., :1], ny)
    columns = _ramp(torch.fft.rfftfreq(nx, spacing[1], dtype=torch.float64), by[..., 1:], nx)
    spectrum = torch.fft.rfft2(images) * rows[..., None] * columns[..., None, :]
    return torch.fft.irfft2(spectrum, s=(ny, nx))


def _ramp(frequencies: Tensor, by: Tensor, number: int) -> Tensor:
    """exp(−2πi f·by) along one axis; at the Nyquist frequency its real part, the mean over f and −f."""
    phase = -2 * math.pi * frequencies.to(by) * by
    sine = phase.sin()
    if number % 2 == 0:
        known = torch.ones(len(frequencies), dtype=by.dtype, device=by.device)
        known[number // 2] = 0
        sine = sine * known
    return torch.complex(phase.cos(), sine)
