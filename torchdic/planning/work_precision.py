"""What accuracy costs: error against seconds and bytes, of images and of gradients.

The error of images is that of `torchdic.image_error`; the error of a gradient is ‖g − g'‖/‖g'‖ over all voxels, of
the loss in `loss_weights`.

Two errors are kept apart. The numerical one is against the converged answer of the same model (propagation, amplitude,
defocus, object aberration): what more steps, sources, padding or digits would change. The model's is against the truth:
an exact field's images where they are given, otherwise the converged wave; of gradients always the converged wave.
Voxels are taken as they are: what finer ones would change is part of the model's error where the truth is exact.
"""

import math
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from statistics import median
from typing import TypeVar

import torch
from jaxtyping import Float
from torch import Tensor
from torch.profiler import ProfilerActivity, profile

from torchdic.errors import TurnedRaysError, UnstableError
from torchdic.fidelity import Fidelity
from torchdic.forward.images import image
from torchdic.grid import Grid
from torchdic.instrument.microscope import Acquisition, Microscope
from torchdic.planning.comparisons import TRUTH
from torchdic.planning.cost import timed
from torchdic.planning.image_error import image_error
from torchdic.propagation.base import propagations
from torchdic.specimen.volume import Volume

T = TypeVar("T")

# What a fidelity says about the model; all else says how carefully that is computed.
MODEL = ("propagation", "amplitude", "defocus", "object_aberration")


@dataclass(frozen=True)
class Candidate:
    """A way to compute: a fidelity, the dtype to compute in (None is the volume's), and a name (a description if "").

    Raises ValueError for a dtype other than float32 and float64.
    """

    fidelity: Fidelity
    dtype: str | None = None
    name: str = ""

    def __post_init__(self) -> None:
        if self.dtype not in (None, "float32", "float64"):
            raise ValueError(f"dtype {self.dtype!r} must be one of 'float32', 'float64'")

    @property
    def label(self) -> str:
        """The name, or else what sets this candidate apart: propagation, sources, and what is not a default."""
        if self.name:
            return self.name
        words = [f"{self.fidelity.propagation} {self.fidelity.sources}"]
        for field in fields(Fidelity):
            value = getattr(self.fidelity, field.name)
            if field.name not in ("propagation", "sources", "memory") and value != field.default:
                words.append(f"{value} steps" if field.name == "steps" else f"{field.name} {value}")
        return ", ".join([*words, *([self.dtype] if self.dtype else [])])


@dataclass(frozen=True)
class Trial:
    """What a candidate costs, and how far it errs; None where it gave no image, or there was nothing to compare with.

    seconds, peak_bytes: of the images without a gradient, the median of several runs and the most bytes of tensors held
    at once above what was there before. gradient_seconds, gradient_peak_bytes: of the images and the gradient to every
    voxel. The errors are those of the module's head. failure: why there is no image.
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
    """A trial of each candidate on a scene, in their order.

    reference: how to compute what counts as converged; float64 unless it is a Candidate that says otherwise. Its
    propagation doesn't matter: each candidate's own is computed with the reference's numbers. Or one for each
    propagation, the wave among them. exact: images of an exact field, the truth for `model_error`. repeats: timed runs,
    after those that measure bytes and warm up.
    Raises ValueError for no candidates, repeats below 1, a propagation without a reference and exact images of another
    shape.
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
    """The trials of `work_precision`, one by one."""
    if not candidates:
        raise ValueError("work_precision needs at least one candidate")
    if repeats < 1:
        raise ValueError(f"repeats {repeats} must be at least 1")
    scene = _Scene(volume, microscope, acquisition)
    given = [c if isinstance(c, Candidate) else Candidate(c) for c in candidates]
    needed = {TRUTH, *(candidate.fidelity.propagation for candidate in given)}
    references = reference if isinstance(reference, Mapping) else dict.fromkeys(needed, reference)
    if missing := needed - set(references):
        raise ValueError(f"reference has none for propagation {min(missing)!r}, only for {', '.join(references)}")
    known: dict[tuple, _Answer | None] = {}

    def converged(fidelity: Fidelity) -> _Answer | None:
        """The converged answer of a fidelity's model; None where it has none, because rays turn."""
        model = {name: getattr(fidelity, name) for name in MODEL}
        key = tuple(model.values())
        if key not in known:
            best = references[fidelity.propagation]
            best = best if isinstance(best, Candidate) else Candidate(best, "float64")
            try:
                known[key] = scene.answer(replace(best, fidelity=replace(best.fidelity, **model)))
            except TurnedRaysError:
                known[key] = None
        return known[key]

    wave = converged(Fidelity(TRUTH))
    assert wave is not None
    truth = wave.images if exact is None else exact.to(wave.images)
    if truth.shape != wave.images.shape:
        raise ValueError(f"exact images have shape {tuple(truth.shape)}, the model's {tuple(wave.images.shape)}")
    for candidate in given:
        try:
            yield _trial(scene, candidate, converged(candidate.fidelity), wave, truth, repeats)
        except (TurnedRaysError, UnstableError) as error:
            yield Trial(candidate.label, candidate, failure=str(error))


def gradient_error(gradient: Float[Tensor, "z y x"], expected: Float[Tensor, "z y x"]) -> float:
    """‖g − g'‖/‖g'‖ over all voxels."""
    expected = expected.to(torch.float64)
    return float((gradient.to(expected) - expected).norm() / expected.norm())


def loss_weights(shape: Sequence[int]) -> Float[Tensor, "prism focus y x"]:
    """What the images are weighted with, Σ weights·image, in the loss whose gradient is compared; float64.

    The gradient is then the adjoint of imaging, applied to a fixed residual: white noise of a fixed seed, under a
    window that falls to 0 at the sides, so that what wraps around there counts no more than in the images.
    """
    noise = torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    y, x = (torch.hann_window(n, periodic=False, dtype=torch.float64) for n in shape[2:])
    return noise * y[:, None] * x / noise.numel()


def pareto_front(costs: Sequence[float | None], errors: Sequence[float | None]) -> list[int]:
    """Which points no other one beats: none is as cheap and as right, and better in one. By rising cost.

    Points without a cost or an error are left out; of equal ones the first stays.
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
    """Candidates from the cheapest way to the most careful one, for a volume of so many slices.

    padded: whether to try padding, which makes another scene of a specimen that reaches the sides.
    """
    margin = max(grid.shape[1:]) // 8 if padded else 0
    rungs = [Candidate(*rung) for propagation in propagations() for rung in propagation.rungs(grid, margin)]
    return list(dict.fromkeys(rungs))  # without padding two are alike


def converged_fidelities(candidates: Sequence[Candidate | Fidelity], grid: Grid) -> dict[str, Fidelity]:
    """For each propagation numbers finer than its candidates': twice the steps, half as many sources again, splines.

    Sources are K rings of 2K: the same from opposite sides, which weak phase in bright field lives by.
    The padding is that of all candidates' widest. The wave's error at half the reference's steps is 4/3 of what a trial
    shows, for it falls with their square.
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


class _Scene:
    """What is computed anew by each candidate."""

    def __init__(self, volume: Volume, microscope: Microscope, acquisition: Acquisition) -> None:
        self.volume, self.microscope, self.acquisition = volume, microscope, acquisition

    def prepared(self, candidate: Candidate) -> Volume:
        """The volume in the candidate's dtype, cut from any graph, its Δn learned."""
        plain = self.volume
        dtype = getattr(torch, candidate.dtype) if candidate.dtype else plain.delta.dtype
        delta = plain.delta.detach().to(dtype, copy=True).requires_grad_()
        absorption = None if plain.absorption is None else plain.absorption.detach()
        return Volume(plain.grid, delta, plain.background.detach(), absorption)

    def images(self, volume: Volume, fidelity: Fidelity) -> Tensor:
        return image(volume, self.microscope, self.acquisition, fidelity)

    def forward(self, volume: Volume, fidelity: Fidelity) -> Tensor:
        with torch.no_grad():
            return self.images(volume, fidelity)

    def backward(self, volume: Volume, fidelity: Fidelity) -> _Answer:
        images = self.images(volume, fidelity)
        loss = (images * loss_weights(images.shape).to(images)).sum()
        (gradient,) = torch.autograd.grad(loss, volume.delta)
        return _Answer(images.detach(), gradient)

    def answer(self, candidate: Candidate) -> _Answer:
        return self.backward(self.prepared(candidate), candidate.fidelity)


def _trial(
    scene: _Scene, candidate: Candidate, converged: _Answer | None, wave: _Answer, truth: Tensor, repeats: int
) -> Trial:
    volume, fidelity = scene.prepared(candidate), candidate.fidelity
    device = volume.delta.device
    answer, gradient_bytes = peak_bytes(lambda: scene.backward(volume, fidelity), device)
    _, bytes_ = peak_bytes(lambda: scene.forward(volume, fidelity), device)
    return Trial(
        candidate.label,
        candidate,
        median(timed(lambda: scene.forward(volume, fidelity), repeats, device)),
        median(timed(lambda: scene.backward(volume, fidelity), repeats, device)),
        bytes_,
        gradient_bytes,
        None if converged is None else image_error(answer.images, converged.images),
        image_error(answer.images, truth),
        None if converged is None else gradient_error(answer.gradient, converged.gradient),
        gradient_error(answer.gradient, wave.gradient),
    )


def peak_bytes(run: Callable[[], T], device: torch.device | str = "cpu") -> tuple[T, int]:
    """What a function returns, and the most bytes of tensors held at once while it runs, above those held before.

    On the CPU torch's profiler sees each allocation and release of its allocator (not the workspaces of FFT libraries);
    on CUDA its caching allocator counts them.
    """
    device = torch.device(device)
    if device.type == "cuda":
        torch.cuda.synchronize(device)
        torch.cuda.reset_peak_memory_stats(device)
        before = torch.cuda.memory_allocated(device)
        result = run()
        torch.cuda.synchronize(device)
        return result, torch.cuda.max_memory_allocated(device) - before
    os.environ.setdefault("KINETO_LOG_LEVEL", "99")  # the profiler tells stderr of each start and stop otherwise
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
