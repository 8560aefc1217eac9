"""Whether there is room for a descent, found before it begins."""

import math
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace

import torch
from torch import Tensor

from recon.earlier.path_length import path_length
from recon.earlier.tikhonov import MEMORY as MEMORY_OF_LINEAR
from recon.earlier.tikhonov import tikhonov
from recon.fit.bounds import Bounds
from recon.fit.descent import minimise
from recon.fit.newton.correction import drafts
from recon.fit.newton.descent import COARSE_STEPS
from recon.fit.newton.missed import MissedResponse
from recon.fit.newton.secants import MEMORY
from recon.fit.newton.weak_hessian import weak_responses
from recon.fit.planned import GivenFidelity
from recon.fit.problem import Problem
from recon.fit.setup import Setup, empty_medium
from recon.fit.unknowns import Unknown, with_support
from recon.misfit.base import Misfit
from recon.prior.weight import FollowsNoise
from torchdic import Fidelity, Grid, Microscope, Volume, foreseen, image
from torchdic.forward.foresee import AMPLE
from torchdic.memory.free import check_room, check_volume, free_bytes
from torchdic.memory.held import course_of, most
from torchdic.memory.signature import stand_in
from torchdic.ranks.group import alone

# Pixels along a side of the sample that is measured, and steps of its descent by each method: the last of them hold
# what all hold. Newton's hold the most once the careful ones have filled the memory of secants.
SIDE = 40
STEPS = {"newton": COARSE_STEPS + MEMORY + 1, "adam": 3}
# Weight of the priors in the sample of Newton's method.
LIGHT = 1e-9
# More bytes than the linear start holds for each pixel, slice, and image or slice.
LINEAR = 64
# Bytes that pictures and files of the results hold at most beside them: of each pixel of the images and of each voxel,
# and of the pictures themselves.
OF_PIXEL, OF_VOXEL, PICTURES = 32, 24, 64 << 20
# Arrays of the volume's size that any descent holds: Δn, its gradient and Adam's two moments.
ARRAYS = 4


def check_room_for_volume(grid: Grid, device: torch.device) -> None:
    """Raise ShortOfMemoryError where not even the descent's own arrays would have room."""
    check_volume(grid, ARRAYS, device)


def check_room_for_descent(problem: Problem, misfit: Callable[[Tensor], Misfit], at_once: int = 1) -> None:
    """Raise ShortOfMemoryError where a descent would take more memory than is free.

    misfit: makes the problem's misfit from data. at_once: number of such descents on this machine. Where the fidelity
    has yet to be planned, what the descent holds beside its images is checked: each image is, when it is computed.
    """
    free = free_bytes(problem.misfit.data.device)
    if free is None or at_once * _ample(problem.setup) <= free:
        return
    wanted = at_once * bytes_at_least(problem, misfit)
    several = f", {at_once} at once," if at_once > 1 else ""
    check_room(wanted, free, f"Steps of a reconstruction of {_named(problem.setup.volume.grid)} voxels{several}")


def bytes_held(problem: Problem, misfit: Callable[[Tensor], Misfit]) -> int:
    """The bytes that a descent will hold, beside its data, with its images in batches as large as their budget allows.

    misfit: makes the problem's misfit from data. Where no fidelity is planned yet, they are those of its first steps.
    """
    setup, careful = problem.setup, problem.fidelity.coarse
    scene, beside = (setup.volume, setup.microscope, setup.acquisition), held_beside_images(problem, misfit, careful)
    if problem.method != "newton":
        return foreseen(*scene, careful, gradient=True).peak + beside
    # gradients are those of drafts, and careful images have none
    _, draft = drafts(careful, problem.fidelity.draft_sources)
    images = max(foreseen(*scene, draft, gradient=True).peak, foreseen(*scene, careful, gradient=False).peak)
    return max(images + beside, _bytes_of_responses(problem, draft, careful))


def _bytes_of_responses(problem: Problem, draft: Fidelity, careful: Fidelity) -> int:
    """The most bytes that are held while transfer functions are made: measured on few pixels, scaled to the problem's.

    draft, careful: of the later steps, see `recon.fit.newton.correction.drafts`.
    """
    setup, dtype = problem.setup, problem.misfit.data.dtype
    few, data, share = _sample(setup, stand_in(setup.microscope), dtype)
    missed = draft.sources < careful.sources and MissedResponse.bytes_for(setup, dtype.itemsize) <= careful.memory // 2
    sources = careful.sources if missed else draft.sources
    fidelity = replace(draft, sources=sources, memory=math.ceil(share * careful.memory))
    with alone():  # the bytes are counted in this process
        return math.ceil(most(course_of(lambda: weak_responses(few, fidelity, data))) / share)


def bytes_at_least(problem: Problem, misfit: Callable[[Tensor], Misfit]) -> int:
    """The bytes that a descent needs at least, beside its data; without its images' where no fidelity is planned yet.

    misfit: makes the problem's misfit from data.
    """
    setup, fidelity, images = problem.setup, problem.fidelity.coarse, 0
    if isinstance(problem.fidelity, GivenFidelity):
        images = foreseen(setup.volume, setup.microscope, setup.acquisition, fidelity, gradient=True).least
    return images + held_beside_images(problem, misfit, fidelity)


def check_room_for_report(pixels: int, voxels: int = 0) -> None:
    """Raise ShortOfMemoryError where the CPU has no room for pictures and files of so many pixels and voxels."""
    wanted = PICTURES + OF_PIXEL * pixels + OF_VOXEL * voxels
    check_room(wanted, free_bytes(torch.device("cpu")), "Pictures and files of the results")


def check_room_for_direct(method: str, data: Tensor, setup: Setup, bounds: Bounds) -> None:
    """Raise ShortOfMemoryError where a method without a descent would take more memory than is free.

    method: "linear" or "opl". data: (prism, focus, y, x), on the volume's pixels. bounds: of Δn.
    """
    free = free_bytes(data.device)
    if free is None or _ample(setup) <= free:
        return
    few, sample, share = _sample(setup, stand_in(setup.microscope), data.dtype)

    def solve() -> None:
        with suppress(ValueError):  # which the method itself will raise
            if method == "linear":
                tikhonov(sample, few, None, bounds, memory=math.ceil(share * MEMORY_OF_LINEAR))
            else:
                path_length(sample, few, None)

    with alone():  # the bytes are counted in this process
        wanted = math.ceil(most(course_of(solve)) / share)
    check_room(wanted, free, f"A volume of {_named(setup.volume.grid)} voxels by method '{method}'")


def _named(grid: Grid) -> str:
    return "×".join(map(str, grid.shape))


def _ample(setup: Setup) -> int:
    """More bytes than any fit by single sources needs: what fits even so need not be measured."""
    slices, *sides = setup.volume.grid.shape
    images = math.prod(setup.shape[:2])
    return math.prod(sides) * (slices + images) * (AMPLE + LINEAR * slices)


def held_beside_images(problem: Problem, misfit: Callable[[Tensor], Misfit], fidelity: Fidelity) -> int:
    """Bytes that a descent holds beside an image and its gradient: measured on few pixels, scaled to the problem's.

    They are those of the unknowns and what they are made of, the priors, the steps that are handed out, the start, and
    what the method keeps: Adam its moments; Newton's the Hessian, the secants and the correction of draft images.
    The sample has no margin: its images are as large as the volume, at least as large as the problem's.
    """
    dtype, microscope = problem.misfit.data.dtype, stand_in(_of_one_source(problem.setup.microscope))
    setup, data, share = _sample(problem.setup, microscope, dtype)
    few, ample = setup.volume.grid, replace(fidelity, memory=1 << 62)
    given = GivenFidelity(ample, problem.fidelity.draft_sources, math.ceil(share * (fidelity.memory // 2)))
    # with a light prior every step of Newton's moves, and is remembered
    weight = FollowsNoise(0.0, data.numel(), first=LIGHT) if problem.method == "newton" else problem.weight
    sample = replace(problem, setup=setup, misfit=misfit(data), weight=weight, fidelity=given)
    sample = replace(sample, steps=STEPS[problem.method], unknowns=[_of_shape(u, few.shape) for u in sample.unknowns])

    def descend() -> None:
        last = None
        for step in minimise(sample):
            last = step  # held while the next one is computed, as a caller's loop does
        del last

    def compute_image() -> None:
        learned = torch.zeros(few.shape, dtype=dtype, requires_grad=True)
        volume = Volume(few, learned, setup.volume.background)
        image(volume, microscope, setup.acquisition, ample).sum().backward()

    with alone():  # the bytes are counted in this process
        beside = most(course_of(descend)) - most(course_of(compute_image))
    return math.ceil(beside / share)


def _sample(setup: Setup, microscope: Microscope, dtype: torch.dtype) -> tuple[Setup, Tensor, float]:
    """A setup of few pixels on the CPU, without a margin, data of its images, and its share of the setup's pixels."""
    grid = setup.volume.grid
    few = replace(grid, shape=(grid.shape[0], *(min(n, SIDE) for n in grid.shape[1:])))
    medium = empty_medium(few, float(setup.volume.background), torch.zeros((), dtype=dtype))
    recording = {
        "brightness": stand_in(setup.brightness),
        "drift": stand_in(setup.drift),
        "lamp": stand_in(setup.lamp),
        "margin": 0,
    }
    made = replace(setup, volume=medium, microscope=microscope, acquisition=stand_in(setup.acquisition), **recording)
    # values play no part, but images of one brightness are refused
    data = torch.rand(made.shape, dtype=dtype, generator=torch.Generator().manual_seed(0))
    return made, data, math.prod(few.shape) / math.prod(grid.shape)


def _of_shape(unknown: Unknown, shape: tuple[int, int, int]) -> Unknown:
    """An unknown with a support, if it has one, of another shape."""
    return with_support(unknown, lambda _: torch.ones(shape, dtype=torch.bool))


def _of_one_source(microscope: Microscope) -> Microscope:
    """A microscope with one direction of its light, whose images hold least beside the descent."""
    points, _ = microscope.sources(1, dtype=torch.float64)
    return microscope.lit_from(points[:1])
