"""A scene, and smaller ones (pilots) that stand for it: its busiest window, its hardest images, few of its sources."""

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
from torchdic.planning.comparisons import CANNOT_CROSS, TRUTH
from torchdic.planning.cost import work
from torchdic.scalar import number
from torchdic.specimen.volume import Volume

# Voxels along each side of a pilot's window. An array that isn't much wider is taken whole.
WINDOW = 64

# The least number of slabs in a pilot that answers a question about something other than slabs.
COARSE = 4

# The most slabs for each slice that a pilot tries: to see whether its image still changes; and to find slabs thin
# enough to carry the light at all.
MOST, MOST_UNSTABLE = 8, 32


@dataclass(frozen=True, eq=False)
class Scene:
    """A volume, the microscope and what is recorded. Each image is computed once and kept."""

    volume: Volume
    microscope: Microscope
    acquisition: Acquisition
    _seen: dict[Fidelity, Tensor] = field(default_factory=dict, init=False)
    _unstable: set[Fidelity] = field(default_factory=set, init=False)

    def __call__(self, fidelity: Fidelity) -> Tensor:
        """Images, (prism, focus, y, x). Raises what `image` raises, UnstableError where slabs don't carry the light."""
        if fidelity not in self._seen:
            try:
                self._seen[fidelity] = image(self.volume, self.microscope, self.acquisition, fidelity)
            except UnstableError:
                self._unstable.add(fidelity)
                raise
        return self._seen[fidelity]

    @property
    def slices(self) -> int:
        """The number of slices of the volume."""
        return self.volume.grid.shape[0]

    def work(self, fidelity: Fidelity) -> float:
        """What the scene's images cost with a fidelity, see `torchdic.planning.cost.work`."""
        return work(fidelity, self.volume, self.microscope, self.acquisition)

    def changed(self, **parts: float | None) -> "Scene":
        """The scene with some parts of its microscope changed; None takes a part away."""
        return replace(self, microscope=replace(self.microscope, **parts))

    def transparent(self) -> "Scene":
        """The scene with a specimen that doesn't absorb."""
        return replace(self, volume=Volume(self.volume.grid, self.volume.delta, self.volume.background))

    def nothing(self) -> Tensor:
        """What stands for images that can't be computed: one pixel of nan each, which broadcasts to any size."""
        return self.volume.delta.new_full((len(self.acquisition.prisms), len(self.acquisition.focus), 1, 1), math.nan)

    def coarse(self) -> Iterator[Fidelity]:
        """Fidelities for questions that aren't about slabs, from coarse slabs to fine ones.

        The slabs of the first one are at most as deep as half the objective's depth of field; a strong specimen may
        need finer ones.
        """
        grid, n0, objective = self.volume.grid, number(self.volume.background), self.microscope.objective
        na = n0 if objective is None else objective.reach(n0)
        deepest = n0 * self.microscope.wavelength / (2 * na**2)
        steps = min(self.slices, max(COARSE, math.ceil(grid.extent[0] / deepest)))
        while steps < MOST_UNSTABLE * self.slices:
            yield Fidelity(TRUTH, steps=steps, order=1)
            yield Fidelity(TRUTH, steps=steps)  # the second order often carries light where the first makes energy
            steps *= 2
        yield Fidelity(TRUTH, steps=MOST_UNSTABLE * self.slices)

    def hardest(self) -> "Scene":
        """The scene with the hardest of its images only, in at most two colours.

        They are those of the darkest, the brightest, the most sheared and the last prism, at the lowest and the highest
        focus and at the one that is nearest to the specimen.
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
        """The scene with at most so many sources; where the condenser names its own, some of those."""
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
        """Two scenes, each with every other of the condenser's own sources; the scene itself if it has at most one."""
        condenser = self.microscope.condenser
        if condenser is None or condenser.points is None or len(condenser.points) < 2:
            return [self]
        points, weights = self.microscope.sources(len(condenser.points))
        return [replace(self, microscope=self.microscope.lit_from(points[i::2], weights[i::2])) for i in (0, 1)]

    @property
    def strained(self) -> bool:
        """Whether some of the slabs that were tried didn't carry its light."""
        return bool(self._unstable)

    def carries(self, fidelity: Fidelity) -> bool:
        """Whether light of all the scene's sources can cross the specimen with a fidelity."""
        one = Acquisition(self.acquisition.prisms[:1], self.acquisition.focus[:1])
        try:
            replace(self, acquisition=one)(replace(fidelity, padding=0))
        except CANNOT_CROSS:
            return False
        return True

    def window(self, side: int = WINDOW) -> "Scene":
        """The scene with only a part of its volume, about `side` voxels wide, where Δn varies most.

        Toward its sides the part fades into the mean along them, so that a layered specimen gets no edges. An axis of
        up to 1.25·side voxels is kept whole. The part is wide enough for two pixels of the camera.
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
        # the array is periodic: a window may lie across its sides, where a specimen that reaches them may have an edge
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
    """A microscope with at most two wavelengths.

    The shortest one, which needs the thinnest slabs, stands for the shorter half of those that are lit; the mean of the
    longer half stands for that half. Each has its half's share of the light.
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
    """A factor (y, x) that rises from 0 at the sides of a part of an array to 1 inside; 1 along axes kept whole."""
    ramps = []
    for length, whole in zip(size, full, strict=True):
        ramp = torch.ones(length)
        if length < whole:
            width = length // 8
            rise = torch.sin(math.pi / 2 * (torch.arange(width) + 0.5) / width).square()
            ramp[:width], ramp[-width:] = rise, rise.flip(0)
        ramps.append(ramp)
    return ramps[0][:, None] * ramps[1]
