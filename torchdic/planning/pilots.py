"""A scene, and the smaller ones that stand for it: its busiest window, its hardest images, few of its sources."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from torchdic.errors import UnstableError
from torchdic.fidelity import Fidelity
from torchdic.forward.images import image
from torchdic.grid import Grid
from torchdic.instrument.condenser import Spectrum
from torchdic.instrument.microscope import Acquisition, Microscope
from torchdic.planning.comparisons import TRUTH
from torchdic.scalar import number
from torchdic.specimen.volume import Volume

# Voxels along each side of a pilot's window; the whole array if it isn't much wider.
WINDOW = 64

# Slabs at least of pilots that ask about something other than slabs.
COARSE = 4

# Slabs to a slice beyond which a pilot looks for nothing more, and for as many as carry the light at all.
MOST, MOST_UNSTABLE = 8, 32


@dataclass(frozen=True, eq=False)
class Scene:
    """A volume, the microscope and what is recorded; images that were computed once are kept."""

    volume: Volume
    microscope: Microscope
    acquisition: Acquisition
    _seen: dict[Fidelity, Tensor] = field(default_factory=dict, init=False)
    _unstable: set[Fidelity] = field(default_factory=set, init=False)

    def __call__(self, fidelity: Fidelity) -> Tensor:
        """Images, (prism, focus, y, x). Raises UnstableError as `image` does."""
        if fidelity not in self._seen:
            try:
                self._seen[fidelity] = image(self.volume, self.microscope, self.acquisition, fidelity)
            except UnstableError:
                self._unstable.add(fidelity)
                raise
        return self._seen[fidelity]

    @property
    def slices(self) -> int:
        """Slices of the volume."""
        return self.volume.grid.shape[0]

    def nothing(self) -> Tensor:
        """Images of nan, for what can't be computed; a pixel each, as wide as any others beside them."""
        return self.volume.delta.new_full((len(self.acquisition.prisms), len(self.acquisition.focus), 1, 1), math.nan)

    def coarse(self) -> Iterator[Fidelity]:
        """Fidelities for what has nothing to do with slabs, from the cheapest on: a strong specimen asks for a finer.

        The first has slabs half as deep as the objective's field or thinner.
        """
        grid, n0, objective = self.volume.grid, number(self.volume.background), self.microscope.objective
        na = n0 if objective is None else objective.na
        deepest = n0 * self.microscope.wavelength / (2 * na**2)
        steps = min(self.slices, max(COARSE, math.ceil(grid.extent[0] / deepest)))
        while steps < MOST_UNSTABLE * self.slices:
            yield Fidelity(TRUTH, steps=steps, order=1)
            yield Fidelity(TRUTH, steps=steps)  # often carries light where the first order makes energy
            steps *= 2
        yield Fidelity(TRUTH, steps=MOST_UNSTABLE * self.slices)

    def hardest(self) -> "Scene":
        """The scene with the hardest of its images, in two colours at most.

        They are those of the darkest, brightest and most sheared prism, at the farthest focus and the nearest.
        """
        prisms = self.acquisition.prisms
        levels = [1.0 if p is None else math.sin(number(p.bias) / 2) ** 2 for p in prisms]
        shears = [0.0 if p is None else math.hypot(*map(number, p.shear)) for p in prisms]
        picked = {levels.index(min(levels)), levels.index(max(levels)), shears.index(max(shears)), len(prisms) - 1}
        depths = [number(z) for z in self.acquisition.focus]
        plane = self.volume.mean_plane()
        away = [abs(z - plane) for z in depths]
        planes = {depths.index(min(depths)), away.index(min(away)), depths.index(max(depths))}
        focus = [self.acquisition.focus[i] for i in sorted(planes)]
        hardest = Acquisition([prisms[i] for i in sorted(picked)], focus)
        return replace(self, acquisition=hardest, microscope=_in_two_colours(self.microscope))

    def lit(self, sources: int) -> "Scene":
        """The scene with so many sources at most, a few of the condenser's own where it names them."""
        condenser = self.microscope.condenser
        if condenser is None:
            return self
        points, weights = self.microscope.sources(sources, dtype=torch.float64)
        points, weights = points[weights > 0], weights[weights > 0]
        if len(points) > sources:
            some = torch.linspace(0, len(points) - 1, sources).round().long()
            points, weights = points[some], weights[some]
        return replace(self, microscope=self.microscope.lit_from(points, weights))

    def halves(self) -> "list[Scene]":
        """Two scenes with every other of the condenser's own sources each; itself where it names fewer than two."""
        condenser = self.microscope.condenser
        if condenser is None or condenser.points is None or len(condenser.points) < 2:
            return [self]
        points, weights = self.microscope.sources(len(condenser.points))
        return [replace(self, microscope=self.microscope.lit_from(points[i::2], weights[i::2])) for i in (0, 1)]

    @property
    def strained(self) -> bool:
        """Whether some slabs that were tried don't carry its light."""
        return bool(self._unstable)

    def carries(self, fidelity: Fidelity) -> bool:
        """Whether a fidelity's slabs carry the light of all its sources."""
        one = Acquisition(self.acquisition.prisms[:1], self.acquisition.focus[:1])
        try:
            replace(self, acquisition=one)(replace(fidelity, padding=0))
        except UnstableError:
            return False
        return True

    def window(self, side: int = WINDOW) -> "Scene":
        """The scene in a part of its volume, about `side` voxels wide, where Δn varies most.

        Towards its own sides it fades into the mean along them, so that layers get no edges. An axis up to a quarter as
        long again is kept whole. Two of a camera's pixels fit in.
        """
        volume, camera = self.volume, self.microscope.camera
        shape, (dy, dx) = volume.grid.shape, volume.grid.spacing[1:]
        pixel = (dy, dx) if camera is None else camera.pixel_spacing((dy, dx))
        sides = [max(side, math.ceil(2 * p / d)) for p, d in zip(pixel, (dy, dx), strict=True)]
        size = [n if n <= 1.25 * most else most for n, most in zip(shape[1:], sides, strict=True)]
        if size == list(shape[1:]):
            return self
        strength = volume.delta if volume.absorption is None else volume.delta.abs() + volume.absorption
        busy = 1e-6 * strength.square().sum(0)
        for axis in (1, 2):
            busy = busy + (strength.roll(-1, axis) - strength.roll(1, axis)).square().sum(0) / 4
        fade = _fade(size, shape[1:]).to(strength)
        weight = torch.zeros_like(busy)
        weight[: size[0], : size[1]] = fade.square()
        # the array is periodic: a window may lie across its sides, where a specimen that reaches them has an edge
        sums = torch.fft.irfft2(torch.fft.rfft2(busy) * torch.fft.rfft2(weight).conj(), s=shape[1:])
        rows, columns = (n if length < n else 1 for length, n in zip(size, shape[1:], strict=True))
        row, column = divmod(int(sums[:rows, :columns].argmax()), columns)

        def cut(part: Tensor) -> Tensor:
            inside = part.roll((-row, -column), (1, 2))[:, : size[0], : size[1]]
            edges = inside[:, :1], inside[:, -1:], inside[:, :, :1], inside[:, :, -1:]
            rim = torch.cat([edge.flatten(1) for edge in edges], 1).mean(1)[:, None, None]
            return rim + (inside - rim) * fade

        delta, absorption = (None if part is None else cut(part) for part in (volume.delta, volume.absorption))
        assert delta is not None
        grid = Grid((shape[0], size[0], size[1]), volume.grid.spacing)
        return replace(self, volume=Volume(grid, delta, volume.background, absorption))


def _in_two_colours(microscope: Microscope) -> Microscope:
    """A microscope with two wavelengths at most: the shortest, which asks for the thinnest slabs, and a mean.

    They stand for the shorter and the longer half of those that are lit, with their shares.
    """
    spectrum = microscope.spectrum
    if spectrum is None or len(spectrum.wavelengths) <= 2:
        return microscope
    lit = sorted(pair for pair in zip(spectrum.wavelengths, spectrum.shares, strict=True) if pair[1] > 0)
    half = len(lit) // 2
    below, above = (sum(share for _, share in part) for part in (lit[:half], lit[half:]))
    shortest, mean = lit[0][0], sum(length * share for length, share in lit[half:]) / above
    nominal = min(max(microscope.wavelength, shortest), mean)
    return replace(microscope, wavelength=nominal, spectrum=Spectrum([shortest, mean], [below, above]))


def _fade(size: Sequence[int], full: Sequence[int]) -> Tensor:
    """A factor (y, x) that rises from the sides of a part of an array; 1 along whole axes."""
    ramps = []
    for length, whole in zip(size, full, strict=True):
        ramp = torch.ones(length)
        if length < whole:
            width = length // 8
            rise = torch.sin(math.pi / 2 * (torch.arange(width) + 0.5) / width).square()
            ramp[:width], ramp[-width:] = rise, rise.flip(0)
        ramps.append(ramp)
    return ramps[0][:, None] * ramps[1]
