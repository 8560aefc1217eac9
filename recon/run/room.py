"""Whether there is room for a descent, found before it begins."""

import math
from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from recon.fit.bounds import SupportedBounds
from recon.fit.descent import minimise
from recon.fit.newton.descent import COARSE_STEPS
from recon.fit.newton.secants import MEMORY
from recon.fit.planned import GivenFidelity
from recon.fit.problem import Problem
from recon.fit.setup import empty_medium
from recon.fit.unknowns import IndexDifference, Unknown
from recon.misfit.base import Misfit
from recon.prior.weight import FollowsNoise
from torchdic import Fidelity, Grid, Microscope, Volume, foreseen, image
from torchdic.forward.foresee import AMPLE
from torchdic.memory.free import check_room, check_volume, free_bytes
from torchdic.memory.held import course_of, most
from torchdic.memory.signature import stand_in

# Pixels along a side of the sample that is measured, and steps of its descent by each method: the last of them hold
# what all hold. Newton's hold the most once the careful ones have filled the memory of secants.
SIDE = 40
STEPS = {"newton": COARSE_STEPS + MEMORY + 1, "adam": 3}
# Weight of the priors in the sample of Newton's method.
LIGHT = 1e-9
# More bytes than the linear start holds for each pixel, slice, and image or slice.
LINEAR = 64
# Arrays of the volume's size that any descent holds: Δn, its gradient and Adam's two moments.
ARRAYS = 4


def check_room_for_volume(grid: Grid, device: torch.device) -> None:
    """Raise ShortOfMemoryError where not even the descent's own arrays would have room."""
    check_volume(grid, ARRAYS, device)


def check_room_for_descent(problem: Problem, misfit: Callable[[Tensor], Misfit]) -> None:
    """Raise ShortOfMemoryError where a descent would take more memory than is free.

    misfit: makes the problem's misfit from data. Where the fidelity has yet to be planned, nothing is checked: each
    image is, when it is computed.
    """
    if not isinstance(problem.fidelity, GivenFidelity):
        return
    free = free_bytes(problem.misfit.data.device)
    if free is None or _ample(problem) <= free:
        return
    shape = "×".join(map(str, problem.setup.volume.grid.shape))
    check_room(bytes_of_descent(problem, misfit), free, f"Steps of a reconstruction of {shape} voxels")


def bytes_of_descent(problem: Problem, misfit: Callable[[Tensor], Misfit]) -> int:
    """The bytes that a descent of a given fidelity needs at least, beside its data. misfit: as above."""
    assert isinstance(problem.fidelity, GivenFidelity)
    fidelity, setup = problem.fidelity.fidelity, problem.setup
    images = foreseen(setup.volume, setup.microscope, setup.acquisition, fidelity, gradient=True).least
    return images + held_beside_images(problem, misfit, fidelity)


def _ample(problem: Problem) -> int:
    """More bytes than any descent by single sources needs: what fits even so need not be measured."""
    slices, *sides = problem.setup.volume.grid.shape
    images = math.prod(problem.setup.shape[:2])
    return math.prod(sides) * (slices + images) * (AMPLE + LINEAR * slices)


def held_beside_images(problem: Problem, misfit: Callable[[Tensor], Misfit], fidelity: Fidelity) -> int:
    """Bytes that a descent holds beside an image and its gradient: measured on few pixels, scaled to the problem's.

    They are those of the unknowns and what they are made of, the priors, the steps that are handed out, the start, and
    what the method keeps: Adam its moments; Newton's the Hessian, the secants and the correction of draft images.
    The sample has no margin: its images are as large as the volume, at least as large as the problem's.
    """
    known, dtype = problem.setup, problem.misfit.data.dtype
    grid = known.volume.grid
    few = replace(grid, shape=(grid.shape[0], *(min(n, SIDE) for n in grid.shape[1:])))
    medium = empty_medium(few, float(known.volume.background), torch.zeros((), dtype=dtype))
    microscope = stand_in(_of_one_source(known.microscope))
    recording = {
        "brightness": stand_in(known.brightness),
        "drift": stand_in(known.drift),
        "lamp": stand_in(known.lamp),
        "margin": 0,
    }
    setup = replace(known, volume=medium, microscope=microscope, acquisition=stand_in(known.acquisition), **recording)
    # values play no part, but images of one brightness are refused
    data = torch.rand(setup.shape, dtype=dtype, generator=torch.Generator().manual_seed(0))
    ample = replace(fidelity, memory=1 << 62)
    share = math.prod(few.shape) / math.prod(grid.shape)
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
        volume = Volume(few, learned, medium.background)
        image(volume, microscope, setup.acquisition, ample).sum().backward()

    beside = most(course_of(descend)) - most(course_of(compute_image))
    return math.ceil(beside * math.prod(grid.shape[1:]) / math.prod(few.shape[1:]))


def _of_shape(unknown: Unknown, shape: tuple[int, int, int]) -> Unknown:
    """An unknown with a support, if it has one, of another shape."""
    if not isinstance(unknown, IndexDifference) or not isinstance(unknown.bounds, SupportedBounds):
        return unknown
    return replace(unknown, bounds=replace(unknown.bounds, support=torch.ones(shape, dtype=torch.bool)))


def _of_one_source(microscope: Microscope) -> Microscope:
    """A microscope with one direction of its light, whose images hold least beside the descent."""
    points, _ = microscope.sources(1, dtype=torch.float64)
    return microscope.lit_from(points[:1])
