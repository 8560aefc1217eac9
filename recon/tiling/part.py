"""The problem of one tile of a field, with what it shares with the others."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Bool
from torch import Tensor

from recon.fit.nuisances.light import Lamp
from recon.fit.problem import Problem
from recon.fit.setup import Setup, empty_medium
from recon.fit.step import Step
from recon.fit.unknowns import with_support
from recon.misfit.base import Misfit
from recon.prior.weight import FollowsNoise, Inside
from recon.tiling.layout import Layout, Span, Tile
from recon.tiling.shared import Finding, LearnedByFirst, SharedPriors, is_of_tile, scale_over

# Steps at most in which a tile goes on with another weight. Four or five do; what is left is far below the noise.
STEPS_AGAIN = 6


def without_margin(problem: Problem) -> Problem:
    """The problem of a field alone: the tiles have their own margins."""
    setup = problem.setup
    if setup.margin == 0:
        return problem

    medium = empty_medium(setup.field, float(setup.volume.background), setup.volume.delta)
    unknowns = [with_support(unknown, setup.within_field) for unknown in problem.unknowns]
    return replace(problem, setup=replace(setup, volume=medium, margin=0), unknowns=unknowns)


def lacks(whole: Problem, layout: Layout, tile: Tile) -> str | None:
    """Why there is nothing to fit in a tile; None where there is. whole: without a margin."""
    mask, support = whole.misfit.mask, whole.support
    if mask is not None:
        counts = _counting(mask[..., tile.rows.pixels, tile.columns.pixels]).tolist()
        if not all(counts):
            return f"no pixel of prism {counts.index(False) + 1} counts" if any(counts) else "no pixel counts"
    if support is not None and not bool(_with_margin(support, tile, layout.margin).any()):
        return "no Δn is sought"
    return None


def problem_of_tile(
    whole: Problem,
    layout: Layout,
    tile: Tile,
    noise: Sequence[float] | None,
    learned: LearnedByFirst | None = None,
    priors: SharedPriors | None = None,
) -> Problem:
    """What is to be fitted of a tile.

    whole: the problem of the field, without a margin. noise: standard deviation of each prism's; None isn't known.
    learned: by the first tile; None is that one itself. priors: as the leaders say; None is a leader, which finds its
    own weight and contrast.
    Raises ValueError where the tile `lacks` what is to be fitted and for an uneven lamp that isn't learned, and
    NotImplementedError for a misfit that has no parts.
    """
    if whole.setup.lamp is not None:
        raise ValueError("an uneven lamp that is given can't be cut into tiles; learn it")
    unit = None  # the weight that a leader finds is relative to its own scale
    if whole.weight is None:
        unit = whole.misfit  # weights that are given are relative to that of the whole
    elif learned is not None and priors is not None:
        unit = learned.misfit
    misfit = whole.misfit.part(tile.rows.pixels, tile.columns.pixels, unit)
    setup = _setup(whole.setup, layout)
    unknowns = [with_support(u, lambda support: _with_margin(support, tile, layout.margin)) for u in whole.unknowns]
    if learned is not None:
        for unknown in unknowns:
            if not is_of_tile(unknown):
                setup = unknown.put(learned.values[unknown.name].to(misfit.data.device), setup)
        unknowns = [unknown for unknown in unknowns if is_of_tile(unknown)]
    tile_problem = replace(whole, setup=setup, misfit=misfit, unknowns=unknowns)
    inside = _inside(misfit, layout, tile) if priors is None else None
    weight = _weight(whole, tile_problem, inside, noise, priors)
    return replace(tile_problem, weight=weight, contrast=None if priors is None else priors.contrast)


def gone_on_with(problem: Problem, last: Step) -> Problem:
    """The problem of a tile that goes on from an earlier fit, with the weight that all share from the first step on.

    problem: as others than the leaders have it. last: the earlier fit's last step. It takes STEPS_AGAIN at most.
    """
    setup = problem.setup
    for unknown in problem.unknowns:
        if isinstance(unknown, Lamp):
            setup = unknown.put(last.values[unknown.name].to(problem.misfit.data.device), setup)
    rule = problem.weight
    assert rule is not None
    held = replace(rule, first=rule.towards, towards=None, held=True)
    steps = min(problem.steps, STEPS_AGAIN)
    return replace(problem.again(problem.misfit, last, last.delta), setup=setup, weight=held, steps=steps)


def finding_of(whole: Problem, tile: Tile, misfit: Misfit, last: Step, unit: Misfit) -> Finding:
    """What a leader's fit says. misfit: its own. last: its last step. unit: the first tile's misfit."""
    shared = whole.misfit.part(tile.rows.pixels, tile.columns.pixels, unit)
    return Finding.by(last, scale_over(shared, misfit))


def _inside(misfit: Misfit, layout: Layout, tile: Tile) -> Inside | None:
    """The pixels of a tile that count in the blended field; None where a prism has none there.

    What lies beyond the margin shows in the others, too, and no volume of the tile explains it.
    """
    rows, columns = layout.along_y.counting(tile.place[0]), layout.along_x.counting(tile.place[1])
    if misfit.mask is not None and not _counting(misfit.mask[..., rows, columns]).all():
        return None
    return Inside(misfit.part(rows, columns, misfit), rows, columns)


def _weight(
    whole: Problem, tile: Problem, inside: Inside | None, noise: Sequence[float] | None, priors: SharedPriors | None
) -> FollowsNoise:
    """The common factor of a tile's priors: a leader finds it, from what is inside the tile.

    The others go there from the least of the leaders' way, as they would in a fit of the whole; where the leaders took
    too few steps to find one, theirs stays as it begins. Weights that are given are those of the whole field without a
    margin.
    """
    misfit = tile.misfit if inside is None else inside.misfit
    pixels = int(misfit.pixels.sum())
    if whole.weight is None:
        return FollowsNoise(None, pixels, tile.setup.dilution, held=True)
    known = misfit.of_noise(noise) if misfit.knows_all and noise is not None else None
    if priors is None:
        return replace(whole.weight, noise_misfit=known, pixels=pixels, inside=inside)
    return FollowsNoise(known, pixels, priors.least, held=priors.weight is None, towards=priors.weight)


def _counting(mask: Bool[Tensor, "prism focus y x"]) -> Bool[Tensor, " prism"]:
    """Whether a pixel of each prism counts."""
    return mask.flatten(1).any(1)


def _setup(whole: Setup, layout: Layout) -> Setup:
    """The setup of a tile; they are all alike."""
    field = replace(whole.field, shape=(whole.field.shape[0], layout.along_y.count, layout.along_x.count))
    medium = empty_medium(
        field.widened(layout.margin, layout.margin), float(whole.volume.background), whole.volume.delta
    )
    return replace(whole, volume=medium, margin=layout.margin)


def _with_margin(support: Bool[Tensor, "z y x"], tile: Tile, margin: int) -> Bool[Tensor, "z row column"]:
    """A tile's part of a support, with its margin; beyond the field it goes on as at the edge."""

    def indices(span: Span, voxels: int) -> Tensor:
        wanted = torch.arange(span.voxels.start - margin, span.voxels.stop + margin, device=support.device)
        return wanted.clamp(0, voxels - 1)

    _, ny, nx = support.shape
    return support[:, indices(tile.rows, ny)[:, None], indices(tile.columns, nx)]
