"""What accuracy costs: the error of images and of gradients against seconds and bytes.

The error of images is that of `torchdic.planning.image_error`. The error of a gradient is ‖g − g'‖/‖g'‖ over all
voxels, for the loss in `loss_weights`.

Two errors are told apart. The numerical error is that against the converged answer of the same model (propagation,
amplitude, defocus and object aberration): more steps, sources, padding or digits would remove it. The model's error is
that against the truth. The truth of images is an exact field's images where they are given, otherwise the converged
wave's; the truth of gradients is always the converged wave's. Candidates and converged answers have the same voxels:
the error of voxels that are too coarse is a part of the model's error where the truth is exact.
"""

import math
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from statistics import median
from typing import TypeVar

import torch
from jaxtyping import Float
from torch import Tensor
from torch.profiler import ProfilerActivity, profile

from torchdic.fidelity import Fidelity
from torchdic.forward.images import image
from torchdic.grid import Grid
from torchdic.instrument.microscope import Acquisition, Microscope
from torchdic.planning.comparisons import CANNOT_CROSS, TRUTH
from torchdic.planning.cost import timed
from torchdic.planning.image_error import image_error
from torchdic.propagation.base import propagations
from torchdic.specimen.volume import Volume

T = TypeVar("T")

# The fields of a fidelity that choose a model. The others say how carefully it is computed.
MODEL = ("propagation", "amplitude", "defocus", "object_aberration")


@dataclass(frozen=True)
class Candidate:
    """A way to compute that is to be tried.

    fidelity: what the images are computed with.
    dtype: "float32" or "float64"; None is the volume's own.
    name: for tables and figures; "" is a description of the fidelity.
    Raises ValueError for any other dtype.
    """

    fidelity: Fidelity
    dtype: str | None = None
    name: str = ""

    def __post_init__(self) -> None:
        if self.dtype not in (None, "float32", "float64"):
            raise ValueError(f"dtype {self.dtype!r} must be one of 'float32', 'float64'")

    @property
    def label(self) -> str:
        """The name; where it is "", the propagation, the number of sources, and all that isn't a default."""
        if self.name:
            return self.name
        words = [f"{self.fidelity.propagation} {self.fidelity.sources}"]
        for option in fields(Fidelity):
            value = getattr(self.fidelity, option.name)
            if option.name not in ("propagation", "sources", "memory") and value != option.default:
                words.append(f"{value} steps" if option.name == "steps" else f"{option.name} {value}")
        return ", ".join([*words, *([self.dtype] if self.dtype else [])])


@dataclass(frozen=True)
class Trial:
    """What a candidate costs and how far it errs.

    A number is None where the candidate gave no image, or where there was nothing to compare it with.

    name: the candidate's label.
    candidate: what was tried.
    seconds: of the images without a gradient, the median of several runs.
    gradient_seconds: of the images with the gradient to every voxel.
    peak_bytes: the most bytes of tensors held at once while the images are computed, beside those held before.
    gradient_peak_bytes: the same for the images with the gradient.
    numerical_error: of the images, against the converged answer of the same model; see `torchdic.planning.image_error`.
    model_error: of the images, against exact images where they are given, otherwise against the converged wave.
    numerical_gradient_error: ‖g − g'‖/‖g'‖ over all voxels, for g' of the same model's converged answer.
    model_gradient_error: the same for g' of the converged wave.
    failure: why there is no image, or None.
    """

    name: str
    candidate: Candidate
    seconds: float | None = None
    gradient_seconds: float | None = None
    peak_bytes: int | None = None
    gradient_peak_bytes: int | None = None
    numerical_error: float | None = None
    model_error: float | None = None
    numerical_gradient_error: float | None = None
    model_gradient_error: float | None = None
    failure: str | None = None


def work_precision(
    volume: Volume,
    microscope: Microscope,
    acquisition: Acquisition,
    candidates: Sequence[Candidate | Fidelity],
    reference: Candidate | Fidelity | Mapping[str, Candidate | Fidelity],
    *,
    exact: Float[Tensor, "prism focus y x"] | None = None,
    repeats: int = 3,
) -> list[Trial]:
    """Measure what each candidate costs on a scene and how far it errs: a Trial of each, in their order.

    volume, microscope, acquisition: the scene, as for `torchdic.image`.
    candidates: the ways to compute that are compared.
    reference: how to compute what counts as converged, in float64 unless it is a Candidate with another dtype. Either
        one for all: its numbers then serve the propagation of each candidate, and its own doesn't matter. Or one for
        each propagation by its name, the wave among them.
    exact: images of an exact field, (prism, focus, y, x): the truth of `Trial.model_error`; None is the converged wave.
    repeats: runs that are timed, after those that warm up and measure bytes.
    Raises ValueError for no candidates, repeats below 1, a propagation without a reference, and exact images of another
    shape than the model's.
    """
    return list(trials(volume, microscope, acquisition, candidates, reference, exact=exact, repeats=repeats))


def trials(
    volume: Volume,
    microscope: Microscope,
    acquisition: Acquisition,
    candidates: Sequence[Candidate | Fidelity],
    reference: Candidate | Fidelity | Mapping[str, Candidate | Fidelity],
    *,
    exact: Float[Tensor, "prism focus y x"] | None = None,
    repeats: int = 3,
) -> Iterator[Trial]:
    """The trials of `work_precision`, one by one as they are done."""
    if not candidates:
        raise ValueError("work_precision needs at least one candidate")
    if repeats < 1:
        raise ValueError(f"repeats {repeats} must be at least 1")
    run = _Run(volume, microscope, acquisition)
    given = [c if isinstance(c, Candidate) else Candidate(c) for c in candidates]
    needed = {TRUTH, *(candidate.fidelity.propagation for candidate in given)}
    references = reference if isinstance(reference, Mapping) else dict.fromkeys(needed, reference)
    if missing := needed - set(references):
        raise ValueError(f"reference has none for propagation {min(missing)!r}, only for {', '.join(references)}")
    converged = _Converged(run, references)
    wave = converged(Fidelity(TRUTH))
    assert wave is not None
    truth = wave.images if exact is None else exact.to(wave.images)
    if truth.shape != wave.images.shape:
        raise ValueError(f"exact images have shape {tuple(truth.shape)}, the model's {tuple(wave.images.shape)}")
    for candidate in given:
        try:
            yield _trial(run, candidate, converged(candidate.fidelity), wave, truth, repeats)
        except CANNOT_CROSS as error:
            yield Trial(candidate.label, candidate, failure=str(error))


def gradient_error(gradient: Float[Tensor, "z y x"], expected: Float[Tensor, "z y x"]) -> float:
    """‖g − g'‖/‖g'‖ over all voxels, for the gradient g and the expected one g'."""
    expected = expected.to(torch.float64)
    return float((gradient.to(expected) - expected).norm() / expected.norm())


def loss_weights(shape: Sequence[int]) -> Float[Tensor, "prism focus y x"]:
    """The weights of the loss Σ weights·images, whose gradients are compared; float64.

    They are white noise of a fixed seed, under a window that falls to 0 at the sides, so that light that wraps around
    there counts no more than in the images. The gradient is then the adjoint of imaging, applied to a fixed residual.

    shape: of the images, (prism, focus, y, x).
    """
    noise = torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    y, x = (torch.hann_window(n, periodic=False, dtype=torch.float64) for n in shape[2:])
    return noise * y[:, None] * x / noise.numel()


def pareto_front(costs: Sequence[float | None], errors: Sequence[float | None]) -> list[int]:
    """The indices of the points that no other point beats, by rising cost.

    A point beats another one if neither its cost nor its error is larger, and one of them is smaller. Of equal points
    the first is taken. Points without a cost or an error are left out.
    """
    known = [(c, e, i) for i, (c, e) in enumerate(zip(costs, errors, strict=True)) if c is not None and e is not None]
    front: list[int] = []
    least = float("inf")
    for _, error, index in sorted(known):
        if error < least:
            front.append(index)
            least = error
    return front


def ladder(grid: Grid, *, padded: bool = True) -> list[Candidate]:
    """Candidates of each propagation, from its cheapest to its most careful one.

    grid: of the volume.
    padded: whether padding is tried too, which would change the scene where a specimen reaches the sides.
    """
    margin = max(grid.shape[1:]) // 8 if padded else 0
    rungs = [Candidate(*rung) for propagation in propagations() for rung in propagation.rungs(grid, margin)]
    return list(dict.fromkeys(rungs))  # without padding two are the same


def converged_fidelities(candidates: Sequence[Candidate | Fidelity], grid: Grid) -> dict[str, Fidelity]:
    """For each propagation a fidelity that is finer than its candidates, to count as converged.

    It has twice their steps, half as many sources again and cubic splines, and the widest padding of all candidates.
    Its sources are K rings of 2K, which are the same from opposite sides: the bright field of a weak phase is sensitive
    to that. The wave's error falls with the square of its steps, so that a wave of half the reference's steps errs by
    4/3 of what its trial shows.
    """
    given = [c.fidelity if isinstance(c, Candidate) else c for c in candidates]
    found: dict[str, Fidelity] = {}
    used: list[str] = [TRUTH, *(f.propagation for f in given)]
    for propagation in dict.fromkeys(used):
        own = [f for f in given if f.propagation == propagation] or given
        steps = 2 * max(f.steps or grid.shape[0] for f in own)
        sources = 2 * math.ceil(math.sqrt(0.75 * max(f.sources for f in own))) ** 2
        margin = max(f.padding for f in given)
        found[propagation] = Fidelity(propagation, steps, sources, "cubic", padding=margin)
    return found


@dataclass(frozen=True, eq=False)
class _Answer:
    """Images (prism focus y x) and the gradient (z y x) to every voxel."""

    images: Tensor
    gradient: Tensor


@dataclass(frozen=True, eq=False)
class _Run:
    """The images of a scene and their gradient, computed anew each time."""

    volume: Volume
    microscope: Microscope
    acquisition: Acquisition

    def prepared(self, candidate: Candidate) -> Volume:
        """The volume in the candidate's dtype, free of any earlier graph, with a gradient to its Δn."""
        plain = self.volume
        dtype = getattr(torch, candidate.dtype) if candidate.dtype else plain.delta.dtype
        delta = plain.delta.detach().to(dtype, copy=True).requires_grad_()
        absorption = None if plain.absorption is None else plain.absorption.detach()
        return Volume(plain.grid, delta, plain.background.detach(), absorption)

    def images(self, volume: Volume, fidelity: Fidelity) -> Tensor:
        """The images, (prism, focus, y, x)."""
        return image(volume, self.microscope, self.acquisition, fidelity)

    def forward(self, volume: Volume, fidelity: Fidelity) -> Tensor:
        """The images without a graph."""
        with torch.no_grad():
            return self.images(volume, fidelity)

    def backward(self, volume: Volume, fidelity: Fidelity) -> _Answer:
        """The images and the gradient of their loss."""
        images = self.images(volume, fidelity)
        loss = (images * loss_weights(images.shape).to(images)).sum()
        (gradient,) = torch.autograd.grad(loss, volume.delta)
        return _Answer(images.detach(), gradient)

    def answer(self, candidate: Candidate) -> _Answer:
        """The candidate's images and gradient."""
        return self.backward(self.prepared(candidate), candidate.fidelity)


@dataclass(frozen=True, eq=False)
class _Converged:
    """The converged answer of each model, computed once."""

    run: _Run
    references: Mapping[str, Candidate | Fidelity]
    known: dict[tuple, _Answer | None] = field(default_factory=dict)

    def __call__(self, fidelity: Fidelity) -> _Answer | None:
        """The converged answer of a fidelity's model; None where its light can't cross the specimen.

        Raises UnstableError where the reference's slabs don't carry the wave, as more of them would.
        """
        model = {name: getattr(fidelity, name) for name in MODEL}
        key = tuple(model.values())
        if key not in self.known:
            best = self.references[fidelity.propagation]
            best = best if isinstance(best, Candidate) else Candidate(best, "float64")
            try:
                self.known[key] = self.run.answer(replace(best, fidelity=replace(best.fidelity, **model)))
            except CANNOT_CROSS:
                if fidelity.propagation == TRUTH:
                    raise
                self.known[key] = None
        return self.known[key]


def _trial(
    run: _Run, candidate: Candidate, converged: _Answer | None, wave: _Answer, truth: Tensor, repeats: int
) -> Trial:
    """Measure one candidate."""
    volume, fidelity = run.prepared(candidate), candidate.fidelity
    device = volume.delta.device
    answer, gradient_bytes = peak_bytes(lambda: run.backward(volume, fidelity), device)
    _, bytes_ = peak_bytes(lambda: run.forward(volume, fidelity), device)
    return Trial(
        candidate.label,
        candidate,
        median(timed(lambda: run.forward(volume, fidelity), repeats, device)),
        median(timed(lambda: run.backward(volume, fidelity), repeats, device)),
        bytes_,
        gradient_bytes,
        None if converged is None else image_error(answer.images, converged.images),
        image_error(answer.images, truth),
        None if converged is None else gradient_error(answer.gradient, converged.gradient),
        gradient_error(answer.gradient, wave.gradient),
    )


def peak_bytes(run: Callable[[], T], device: torch.device | str = "cpu") -> tuple[T, int]:
    """What a function returns, and the most bytes of tensors held at once while it runs, beside those held before.

    On the CPU torch's profiler lists each time that torch takes or frees memory; it doesn't see what FFT libraries take
    for themselves. On CUDA torch's own allocator counts.
    """
    device = torch.device(device)
    if device.type == "cuda":
        torch.cuda.synchronize(device)
        torch.cuda.reset_peak_memory_stats(device)
        before = torch.cuda.memory_allocated(device)
        result = run()
        torch.cuda.synchronize(device)
        return result, torch.cuda.max_memory_allocated(device) - before
    os.environ.setdefault("KINETO_LOG_LEVEL", "99")  # otherwise the profiler prints each start and stop
    with profile(activities=[ProfilerActivity.CPU], profile_memory=True) as profiler:
        result = run()
    recorded = profiler.profiler
    assert recorded is not None
    assert recorded.kineto_results is not None
    events = [event for event in recorded.kineto_results.events() if event.name() == "[memory]"]
    held, most = 0, 0
    for event in sorted(events, key=lambda event: event.start_ns()):
        held += event.nbytes()  # pyright: ignore[reportAttributeAccessIssue]
        most = max(most, held)
    return result, most
