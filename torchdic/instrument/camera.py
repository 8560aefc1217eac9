"""The camera: its pixels, and the noise and counts with which it records an intensity."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Real
from torch import Tensor

# An image may fall short of a whole number of pixels by this part of a pixel, because of rounding.
_ROUNDING = 1e-6


@dataclass(frozen=True)
class Camera:
    """A camera that counts photoelectrons.

    `torchdic.image` gives the noiseless intensity: on the camera's pixels where it has a `pixel_size`, and on the
    volume's voxel centres where it has none. `record` draws a noisy recording from that intensity.

    photons: electrons per pixel in the empty bright field; None is a camera without shot noise.
    read_noise: standard deviation in electrons; None is a camera without read noise.
    gain: counts per electron, or of the empty bright field where `photons` is None; None is 1 count per electron.
    offset: dark counts; None is no offset.
    bits: bit depth, 1 to 16; None records intensities relative to the empty bright field instead of counts.
    pixel_size: side in µm of a square pixel, which averages over its whole area; None is the volume's voxels.
    magnification: between specimen and camera; None where `pixel_size` is measured in the specimen.

    Raises ValueError where a number isn't positive, for read noise without photons, gain or offset without bits, bits
    with neither photons nor gain, and a magnification without a pixel size.
    """

    photons: float | None = None
    read_noise: float | None = None
    gain: float | None = None
    offset: float | None = None
    bits: int | None = None
    pixel_size: float | None = None
    magnification: float | None = None

    def __post_init__(self) -> None:
        if self.photons is not None and not (0 < self.photons < math.inf):
            raise ValueError(f"photons {self.photons} per pixel of the empty bright field must be above 0")
        if self.read_noise is not None and not (0 <= self.read_noise < math.inf):
            raise ValueError(f"read_noise {self.read_noise} electrons must be at least 0")
        if self.read_noise is not None and self.photons is None:
            raise ValueError(f"read_noise {self.read_noise} electrons needs photons to be compared with")
        if self.gain is not None and not (0 < self.gain < math.inf):
            raise ValueError(f"gain {self.gain} counts per electron must be above 0")
        if self.offset is not None and not math.isfinite(self.offset):
            raise ValueError(f"offset {self.offset} counts must be finite")
        if self.bits is None:
            for name, value in (("gain", self.gain), ("offset", self.offset)):
                if value is not None:
                    raise ValueError(f"{name} {value} is in counts, of which there are none without bits")
        elif isinstance(self.bits, bool) or not (1 <= self.bits <= 16):
            raise ValueError(f"bits {self.bits} must be from 1 to 16")
        elif self.photons is None and self.gain is None:
            raise ValueError(f"bits {self.bits} needs photons, or a gain in counts of the empty bright field")
        for name, value in (("pixel_size", self.pixel_size), ("magnification", self.magnification)):
            if value is not None and not (0 < value < math.inf):
                raise ValueError(f"{name} {value} must be above 0")
        if self.magnification is not None and self.pixel_size is None:
            raise ValueError(f"magnification {self.magnification} needs the pixel_size that it makes smaller")

    def pixel_spacing(self, spacing: tuple[float, float]) -> tuple[float, float]:
        """Sides (y, x) in µm of a pixel, measured in the specimen.

        spacing: of the voxels (y, x) in µm; the result where the camera has no pixel size.
        """
        if self.pixel_size is None:
            return spacing
        side = self.pixel_size / (self.magnification or 1)
        return side, side

    def pixels(self, shape: tuple[int, int], spacing: tuple[float, float]) -> tuple[int, int]:
        """How many whole pixels (y, x) fit into an image. Raises ValueError where none fits.

        shape: of the image in voxels (y, x). spacing: of the voxels (y, x) in µm.
        """
        count = [
            int(n * d / side + _ROUNDING)
            for n, d, side in zip(shape, spacing, self.pixel_spacing(spacing), strict=True)
        ]
        if min(count) == 0:
            extent = " × ".join(f"{n * d:g}" for n, d in zip(shape, spacing, strict=True))
            side = self.pixel_spacing(spacing)[0]
            raise ValueError(f"a pixel of {side:g} µm doesn't fit into an image of {extent} µm")
        return count[0], count[1]

    def passed(
        self, shape: tuple[int, int], spacing: tuple[float, float], dtype: torch.dtype = torch.float64
    ) -> Float[Tensor, "y half"]:
        """What a pixel's mean leaves of each wave of an image: sinc(f_y·side)·sinc(f_x·side), 1 without a pixel size.

        shape, spacing: of the image's voxels (y, x), µm. The waves are those of `torch.fft.rfft2`.
        """
        (ny, nx), (dy, dx) = shape, spacing
        if self.pixel_size is None:
            return torch.ones(ny, nx // 2 + 1, dtype=dtype)
        side_y, side_x = self.pixel_spacing(spacing)
        along_y = torch.sinc(side_y * torch.fft.fftfreq(ny, dy, dtype=torch.float64))
        along_x = torch.sinc(side_x * torch.fft.rfftfreq(nx, dx, dtype=torch.float64))
        return (along_y[:, None] * along_x).to(dtype)

    def integrate(
        self, intensity: Float[Tensor, "*image y x"], spacing: tuple[float, float], seen: tuple[int, int] | None = None
    ) -> Float[Tensor, "*image row column"]:
        """The mean of the intensity over each pixel's area; the intensity itself where there is no pixel size.

        intensity: at voxel centres (…, y, x), periodic as the microscope's images are.
        spacing: of the voxels (y, x) in µm.
        seen: how many voxels (y, x) about the centre the camera looks at; None is all.

        Pixels are centred as voxels are: pixel j has its centre at (j − (N−1)/2)·side. At the edges, whatever is no
        whole pixel is left out.

        Between voxels the intensity is the trigonometric polynomial through them, Σ_f c(f)·exp(2πi f·x). A pixel of
        side w sees Σ_f sinc(f·w)·c(f)·exp(2πi f·x_j) of it, which is a matrix product along each axis. This is exact,
        and pixels may have any size, whole voxels or not.
        """
        if self.pixel_size is None:
            return intensity
        full = (intensity.shape[-2], intensity.shape[-1])
        side, counts = self.pixel_spacing(spacing), self.pixels(seen or full, spacing)
        rows, columns = (
            _pixel_means(n, d, count, w).to(intensity.device, intensity.dtype)
            for n, d, count, w in zip(full, spacing, counts, side, strict=True)
        )
        return rows @ intensity @ columns.T

    def record(self, intensity: Float[Tensor, "*image"], generator: torch.Generator) -> Real[Tensor, "*image"]:
        """One noisy recording, of the same shape and on the same device.

        intensity: relative to the empty bright field.
        generator: of the random numbers, on the intensity's device.

        With `bits` the recording is in counts, rounded and clipped to 0 … 2^bits − 1; uint8 up to 8 bits, uint16 above.
        Without `bits` it is relative to the empty bright field, in the intensity's dtype.
        """
        signal = intensity
        if self.photons is not None:
            # between voxels the trigonometric polynomial may fall below 0
            signal = torch.poisson(intensity.clamp_min(0) * self.photons, generator=generator)
            if self.read_noise is not None:
                noise = torch.randn(
                    intensity.shape, generator=generator, dtype=intensity.dtype, device=intensity.device
                )
                signal = signal + self.read_noise * noise
        if self.bits is None:
            return signal if self.photons is None else signal / self.photons
        counts = signal if self.gain is None else self.gain * signal
        if self.offset is not None:
            counts = counts + self.offset
        dtype = torch.uint8 if self.bits <= 8 else torch.uint16
        return counts.detach().round().clamp(0, 2**self.bits - 1).to(dtype)


def _pixel_means(voxels: int, spacing: float, pixels: int, side: float) -> Float[Tensor, "pixel voxel"]:
    """The matrix that takes values at voxel centres to means over pixels, along one axis; float64."""
    f = torch.fft.fftfreq(voxels, spacing, dtype=torch.float64)
    voxel = (torch.arange(voxels, dtype=torch.float64) - (voxels - 1) / 2) * spacing
    pixel = (torch.arange(pixels, dtype=torch.float64) - (pixels - 1) / 2) * side
    at_pixel, at_voxel = (2 * math.pi * x[:, None] * f for x in (pixel, voxel))
    seen = torch.sinc(f * side) / voxels
    # the cosine of a difference; the sine cancels, because it is odd in f
    return (seen * at_pixel.cos()) @ at_voxel.cos().T + (seen * at_pixel.sin()) @ at_voxel.sin().T
