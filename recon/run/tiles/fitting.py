"""A field fitted tile by tile, and what its tiles say together."""

import math
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain
from pathlib import Path

from jaxtyping import Float
from torch import Tensor

from recon.config.schema import ConfigError
from recon.fit.problem import Problem
from recon.fit.step import Step
from recon.fit.unknowns import IndexDifference
from recon.report.forecast import Forecast
from recon.run.checkpoint import Checkpoint
from recon.run.folder.prepared import keep_folder
from recon.run.interruption import InterruptedRunError
from recon.run.recorded import STOPPING, descend_recorded, tell_foreseen
from recon.run.results import GO_ON, ResultsError, Tiled, leave_interrupted, model_images
from recon.run.tiles.kept import FITTED, begun, folder_of, identity_of, keep, kept, prepared, remember_side
from recon.tiling.blending import blended_images, blended_volume
from recon.tiling.layout import Layout, Tile
from recon.tiling.part import SharedByTiles, lacks, problem_of_tile, strongest_first
from torchdic.files.whole import WriteError
from torchdic.ranks.group import rank, ranks
from torchdic.ranks.shared import everywhere


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

    def fitted(self) -> Tiled:
        """Fit the tiles that have yet to be fitted, and put all of them together.

        Raises as `descend_recorded` does, with the tile's checkpoint and the volume of the fitted tiles left in the
        folder, and ResultsError where a fitted tile can't be kept.
        """
        first, *others = self.tiles
        forecast = Forecast(self.problem(first))
        if self.kept(first) is None:
            tell_foreseen(self.problem(first), forecast, tiles=math.ceil(len(self.tiles) / ranks()))
            self.fit(first, forecast)
        missing = [tile for tile in others if self.kept(tile) is None]
        if missing:
            if forecast.untried:
                tell_foreseen(self.problem(missing[0]), forecast, tiles=math.ceil(len(missing) / ranks()))
            everywhere(_fit_share, self, missing, forecast)
        return self.together()

    def fit(self, tile: Tile, forecast: Forecast) -> None:
        """Fit one tile and keep it. forecast: of the time left. Raises as `fitted` does."""
        print(f"tile {tile}, {self.tiles.index(tile) + 1} of {len(self.tiles)}")
        folder, identity, problem = folder_of(self.out, tile), self.identity_of(tile), self.problem(tile)
        with _told():
            self._prepare(folder)
        start = begun(folder, identity)

        def leave(step: Step) -> str:
            # of several processes, the first leaves it for all
            return self.leave_so_far(tile, step) if rank() == 0 else "its Δn so far is in the checkpoint"

        try:
            ended = descend_recorded(problem, folder, self.checkpoint_every, identity, start, leave, forecast)
        except InterruptedRunError as error:
            raise InterruptedRunError(f"tile {tile}: {error}") from None
        except STOPPING as error:
            error.args = (f"tile {tile}: {error}",)
            raise
        with _told():
            self._prepare(folder)  # it may have been removed, with what it was in
            keep(folder, ended)

    def _prepare(self, folder: Path) -> None:
        """Make a tile's folder, and leave beside it what the tiles are. Raises WriteError and FolderInUseError."""
        keep_folder(self.out)
        prepared(folder)
        remember_side(self.out, self.layout.side, self.whole.fidelity.coarse.memory)

    def kept(self, tile: Tile) -> Checkpoint | None:
        """A fitted tile; None where it has yet to be fitted. Raises CheckpointError where it is another run's."""
        return kept(folder_of(self.out, tile), self.identity_of(tile))

    def found(self, tile: Tile) -> Checkpoint:
        """A tile that has been fitted. Raises as `kept` does, and ResultsError where it is gone."""
        ended = self.kept(tile)
        if ended is None:
            gone = folder_of(self.out, tile) / FITTED
            raise ResultsError(f"{gone}: was removed during the run; go on with --resume, which fits that tile again")
        return ended

    def identity_of(self, tile: Tile) -> str:
        """What a tile's fit depends on."""
        return identity_of(self.identity, self.layout, tile, self.whole.steps, self._taken_over_by(tile))

    def _taken_over_by(self, tile: Tile) -> str:
        """What a tile takes over from the first one, in words; none of the first itself."""
        if tile == self.tiles[0]:
            return ""
        shared = self.shared
        return f"weight {shared.least} to {shared.weight}, contrast {shared.contrast}"

    @cached_property
    def shared(self) -> SharedByTiles:
        """What the first tile, which is fitted, says of all."""
        first = self.tiles[0]
        return SharedByTiles.by(self.problem(first), self.found(first).step)

    def problem(self, tile: Tile) -> Problem:
        """What is to be fitted of a tile."""
        shared = None if tile == self.tiles[0] else self.shared
        return problem_of_tile(self.whole, self.layout, tile, self.noise, shared)

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
        found = ((tile, model_images(self.problem(tile), ended.step)) for tile, ended in self.all_found())
        return blended_images(self.layout, self.whole.setup.shape[:2], found)

    def all_found(self) -> Iterator[tuple[Tile, Checkpoint]]:
        """All tiles, one at a time. Raises as `found` does."""
        return ((tile, self.found(tile)) for tile in self.tiles)

    def ended(self) -> Iterator[tuple[Tile, Checkpoint]]:
        """The fitted tiles, one at a time."""
        for tile in self.tiles:
            found = self.kept(tile)
            if found is not None:
                yield tile, found
            elif tile == self.tiles[0]:
                return  # the others are fitted after it

    def together(self) -> Tiled:
        """What the fitted tiles say together."""
        steps, seconds = {}, {}
        for tile, ended in self.all_found():
            steps[str(tile)], seconds[str(tile)] = ended.step.number, ended.step.seconds
        first, delta = self.found(self.tiles[0]), self.volume(self.all_found())
        values = {**self.shared.values, IndexDifference.name: delta}
        whole = replace(first.step, delta=delta, values=values, seconds=sum(seconds.values()))
        ended = replace(first, step=whole)
        axes = self.layout.along_y, self.layout.along_x
        record = {
            "pixels": [axis.size for axis in axes],
            "overlap": [axis.overlap for axis in axes],
            "margin": self.layout.margin,
            "steps": steps,
            "seconds": {name: round(value, 3) for name, value in seconds.items()},
        }
        return Tiled(ended, self.images(), self.problem(self.tiles[0]), record)

    def leave_so_far(self, tile: Tile, step: Step) -> str:
        """Leave the volume of the fitted tiles and of one that is stopped at a step; returns words about it."""
        number = f"{sum(1 for _ in self.ended())} of {len(self.tiles)} tiles"
        delta = self.volume(self.ended(), [(tile, step.delta.detach().cpu())])
        path = leave_interrupted(self.out, delta, self.whole.setup.field, f"delta n, interrupted after {number}")
        return f"{path.name} holds Δn so far: {number}, and this one as it is"


@contextmanager
def _told() -> Iterator[None]:
    """Within this block a tile's file that can't be written raises ResultsError, which says how to go on."""
    try:
        yield
    except WriteError as error:
        raise ResultsError(f"{error}{GO_ON}") from error


def _fit_share(fit: TiledFit, tiles: Sequence[Tile], forecast: Forecast) -> None:
    """Fit a process' share of some tiles. forecast: of the time left of one."""
    for tile in tiles[rank() :: ranks()]:
        fit.fit(tile, forecast)
