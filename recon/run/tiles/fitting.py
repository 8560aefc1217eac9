"""A field fitted tile by tile, and what its tiles say together."""

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from recon.config.schema import ConfigError
from recon.fit.problem import Problem
from recon.fit.step import Step
from recon.fit.unknowns import IndexDifference
from recon.prior.weight import record
from recon.report.forecast import Forecast
from recon.run.checkpoint import Checkpoint
from recon.run.folder.prepared import keep_folder
from recon.run.interruption import InterruptedRunError
from recon.run.recorded import STOPPING, descend_recorded, tell_foreseen
from recon.run.results import GO_ON, ResultsError, Tiled, leave_interrupted, model_images
from recon.run.tiles.kept import FITTED, begun, folder_of, identity_of, is_kept, keep, kept, prepared, remember_side
from recon.tiling.blending import blended_images, blended_volume
from recon.tiling.layout import Layout, Tile
from recon.tiling.leaders import leaders, strongest_first
from recon.tiling.part import finding_of, gone_on_with, lacks, problem_of_tile
from recon.tiling.shared import Finding, LearnedByFirst, SharedPriors
from recon.tiling.visits import Visit
from torchdic.files.whole import WriteError
from torchdic.ranks.group import rank, ranks
from torchdic.ranks.shared import everywhere

# What the second fit of a leader takes, over that of its first: some five steps, with all that a descent begins with.
AGAIN = 0.3


def tiles_to_fit(whole: Problem, layout: Layout) -> tuple[Tile, ...]:
    """The tiles in which there is something to fit, in the order in which they are; a line names the others.

    whole: the problem of the field, without a margin. Raises ConfigError where there is none.
    """
    told = [(tile, lacks(whole, layout, tile)) for tile in strongest_first(layout, whole.misfit)]
    found = tuple(tile for tile, reason in told if reason is None)
    if not found:
        first, reason = told[0]
        raise ConfigError(
            f"reconstruction.tiles: none of {len(told)} tiles can be fitted: in tile {first} {reason}; take larger "
            "tiles, or leave out less of the images"
        )
    if not leaders(whole, found):
        raise ConfigError(
            f"reconstruction.tiles: none of {len(found)} tiles can be fitted by itself: in each the images of a prism "
            "are uniform; take larger tiles"
        )
    for tile, reason in told:
        if reason is not None:
            print(f"tile {tile}: {reason}: Δn stays 0 there")
    return found


@dataclass(frozen=True, eq=False)
class TiledFit:
    """A field that is fitted tile by tile.

    whole: the problem of the field, without a margin. layout: of its tiles. tiles: those that are fitted, in the order
    in which they are, see `tiles_to_fit`. noise: standard deviation of each prism's; None isn't known. out: folder of
    the results. identity: what the fit depends on. checkpoint_every: steps between two checkpoints of a tile.
    """

    whole: Problem
    layout: Layout
    tiles: tuple[Tile, ...]
    noise: Sequence[float] | None
    out: Path
    identity: str
    checkpoint_every: int

    @cached_property
    def leading(self) -> list[Visit]:
        """The leaders' own fits, the first tile's first."""
        return [Visit(tile) for tile in leaders(self.whole, self.tiles)]

    @property
    def following(self) -> list[Visit]:
        """The fits that go by what the leaders have found: their own again, and those of the other tiles."""
        again = [Visit(visit.tile, again=True) for visit in self.leading if self.shares_weight]
        return [*again, *self.others]

    @property
    def others(self) -> list[Visit]:
        """The fits of the tiles that don't lead."""
        return [visit for visit in map(Visit, self.tiles) if visit not in self.leading]

    @property
    def shares_weight(self) -> bool:
        """Whether leaders, which are fitted, have found a weight together; a lone one has nothing to take over."""
        return len(self.leading) > 1 and self.priors.weight is not None

    def fitted(self) -> Tiled:
        """Make the fits that have yet to be made, and put all tiles together.

        Raises as `descend_recorded` does, with the tile's checkpoint and the volume of the fitted tiles left in the
        folder, and ResultsError where a fitted tile can't be kept.
        """
        first, *leading = self.leading
        is_there, forecast = self.kept(first) is not None, Forecast(self.problem(first))
        if left := self._left():
            number = len({visit.tile.number for visit in left})
            of = f" for {number} tile{'s' if number > 1 else ''}{f' by {ranks()} processes' if ranks() > 1 else ''}"
            descents = sum(AGAIN if visit.again else 1.0 for visit in left)
            tell_foreseen(self.problem(first), forecast, descents=descents / ranks(), of=of)
        if not is_there:
            self.fit(first, forecast)
        self._fit_missing(leading, forecast)
        self._fit_missing(self.following, forecast)
        return self.together()

    def _fit_missing(self, visits: Sequence[Visit], forecast: Forecast) -> None:
        """Make those of some fits that have yet to be made, shared out among the processes."""
        if missing := [visit for visit in visits if self.kept(visit) is None]:
            everywhere(_fit_share, self, missing, forecast)

    def _left(self) -> list[Visit]:
        """The fits that are probably left to be made: too few steps find no weight to go on with."""
        missing = [visit for visit in self.leading if not is_kept(folder_of(self.out, visit))]
        if not missing:
            return [visit for visit in self.following if not is_kept(folder_of(self.out, visit))]
        again = [Visit(visit.tile, again=True) for visit in self.leading]
        return [*missing, *(again if len(again) > 1 else []), *self.others]

    def fit(self, visit: Visit, forecast: Forecast) -> None:
        """Fit one tile and keep it. forecast: of the time left. Raises as `fitted` does."""
        number = f"{self.tiles.index(visit.tile) + 1} of {len(self.tiles)}"
        print(f"tile {visit}, {f'by what {len(self.leading)} tiles have found' if visit.again else number}")
        folder, identity, problem = folder_of(self.out, visit), self.identity_of(visit), self.problem(visit)
        with _told():
            self._prepare(folder)
        start, left = begun(folder, identity), forecast.of_another(problem) if visit.again else forecast

        def leave(step: Step) -> str:
            # of several processes, the first leaves it for all
            return self.leave_so_far(visit, step) if rank() == 0 else "its Δn so far is in the checkpoint"

        try:
            ended = descend_recorded(problem, folder, self.checkpoint_every, identity, start, leave, left)
        except InterruptedRunError as error:
            raise InterruptedRunError(f"tile {visit}: {error}") from None
        except STOPPING as error:
            error.args = (f"tile {visit}: {error}",)
            raise
        with _told():
            self._prepare(folder)  # it may have been removed, with what it was in
            keep(folder, ended)

    def _prepare(self, folder: Path) -> None:
        """Make a fit's folder, and leave beside it what the tiles are. Raises WriteError and FolderInUseError."""
        keep_folder(self.out)
        prepared(folder)
        remember_side(self.out, self.layout.side, self.whole.fidelity.coarse.memory)

    def kept(self, visit: Visit) -> Checkpoint | None:
        """A fitted tile; None where it has yet to be fitted. Raises CheckpointError where it is another run's."""
        return kept(folder_of(self.out, visit), self.identity_of(visit))

    def found(self, visit: Visit) -> Checkpoint:
        """A tile that has been fitted. Raises as `kept` does, and ResultsError where it is gone."""
        ended = self.kept(visit)
        if ended is None:
            gone = folder_of(self.out, visit) / FITTED
            raise ResultsError(f"{gone}: was removed during the run; go on with --resume, which fits that tile again")
        return ended

    def identity_of(self, visit: Visit) -> str:
        """What a tile's fit depends on."""
        return identity_of(self.identity, self.layout, visit.tile, self.whole.steps, self._taken_over_by(visit))

    def _taken_over_by(self, visit: Visit) -> str:
        """What a tile's fit takes over from others, in words."""
        if visit == self.leading[0]:
            return ""
        sums = {"scale": self.learned.misfit.variance, **self.learned.values}
        learned = ", ".join(f"{name} {float(value.cpu().sum(dtype=torch.float64))}" for name, value in sums.items())
        if visit in self.leading:
            return learned
        priors = self.priors
        way = "at once" if visit.again else f"from {priors.least} on"
        return f"{learned}, weight {priors.weight} {way}, contrast {priors.contrast}"

    @cached_property
    def learned(self) -> LearnedByFirst:
        """What the first tile, which is fitted, says of all."""
        first = self.leading[0]
        return LearnedByFirst.by(self.problem(first), self.found(first).step)

    @cached_property
    def priors(self) -> SharedPriors:
        """What the leaders, which are fitted, say together."""
        return SharedPriors.by([self._finding(visit) for visit in self.leading])

    def _finding(self, visit: Visit) -> Finding:
        """What a leader, which is fitted, says."""
        own, last = self.problem(visit).misfit, self.found(visit).step
        return finding_of(self.whole, visit.tile, own, last, self.learned.misfit)

    def problem(self, visit: Visit) -> Problem:
        """What a fit is to find."""

        def of_tile(learned: LearnedByFirst | None = None, priors: SharedPriors | None = None) -> Problem:
            return problem_of_tile(self.whole, self.layout, visit.tile, self.noise, learned, priors)

        if visit in self.leading:
            return of_tile(None if visit == self.leading[0] else self.learned)
        problem = of_tile(self.learned, self.priors)
        return gone_on_with(problem, self.found(Visit(visit.tile)).step) if visit.again else problem

    def volume(
        self,
        ended: Iterable[tuple[Tile, Checkpoint]],
        stopped: Sequence[tuple[Tile, Float[Tensor, "z row column"]]] = (),
    ) -> Float[Tensor, "z y x"]:
        """Δn of the field, of tiles that are fitted, and of those that were stopped."""
        fitted = ((tile, found.step.delta) for tile, found in ended)
        return blended_volume(self.layout, self.whole.setup.field.shape[0], chain(fitted, stopped))

    def images(self) -> Float[Tensor, "prism focus y x"]:
        """The model's images of the field."""
        found = ((visit.tile, model_images(self.problem(visit), self.found(visit).step)) for visit in self.last)
        return blended_images(self.layout, self.whole.setup.shape[:2], found)

    @property
    def last(self) -> list[Visit]:
        """The last fit of each tile."""
        return list({visit.tile.number: visit for visit in [*self.leading, *self.following]}.values())

    def so_far(self) -> Iterator[tuple[Tile, Checkpoint]]:
        """The tiles that have been fitted, each as its last fit so far has it; one at a time."""
        there = [is_kept(folder_of(self.out, visit)) for visit in self.leading]
        if not there[0]:
            return  # all others are fitted after it
        visits = [*self.leading, *(self.following if all(there) else [])]
        fits = {visit.tile.number: visit for visit in visits if is_kept(folder_of(self.out, visit))}
        yield from ((visit.tile, self.found(visit)) for visit in fits.values())

    def together(self) -> Tiled:
        """What the fitted tiles say together."""
        steps, seconds = {str(tile): 0 for tile in self.tiles}, {str(tile): 0.0 for tile in self.tiles}
        for visit in [*self.leading, *self.following]:
            ended = self.found(visit).step
            steps[str(visit.tile)] += ended.number
            seconds[str(visit.tile)] += ended.seconds
        first, delta = self.found(self.leading[0]), self.volume((v.tile, self.found(v)) for v in self.last)
        values = {**self.learned.values, IndexDifference.name: delta}
        weights = first.step.weights
        if self.shares_weight:
            weights = (*weights, record(first.step.number, self.priors.weight, "the leading tiles' mean"))
        whole = replace(first.step, delta=delta, values=values, seconds=sum(seconds.values()), weights=weights)
        axes = self.layout.along_y, self.layout.along_x
        found = {
            "pixels": [axis.size for axis in axes],
            "overlap": [axis.overlap for axis in axes],
            "margin": self.layout.margin,
            "steps": steps,
            "seconds": {name: round(value, 3) for name, value in seconds.items()},
        }
        return Tiled(replace(first, step=whole), self.images(), self.problem(self.leading[0]), found)

    def leave_so_far(self, stopped: Visit, step: Step) -> str:
        """Leave the volume of the fitted tiles and of one that is stopped at a step; returns words about it."""
        others = [tile for tile, _ in self.so_far() if tile != stopped.tile]
        number = f"{len(others)} of {len(self.tiles)} tiles"
        fitted = ((tile, ended) for tile, ended in self.so_far() if tile != stopped.tile)
        delta = self.volume(fitted, [(stopped.tile, step.delta.detach().cpu())])
        path = leave_interrupted(self.out, delta, self.whole.setup.field, f"delta n, interrupted after {number}")
        return f"{path.name} holds Δn so far: {number}, and this one as it is"


@contextmanager
def _told() -> Iterator[None]:
    """Within this block a tile's file that can't be written raises ResultsError, which says how to go on."""
    try:
        yield
    except WriteError as error:
        raise ResultsError(f"{error}{GO_ON}") from error


def _fit_share(fit: TiledFit, visits: Sequence[Visit], forecast: Forecast) -> None:
    """Make a process' share of some fits. forecast: of the time left of one."""
    for visit in visits[rank() :: ranks()]:
        fit.fit(visit, forecast)
