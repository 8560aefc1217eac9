"""The stack that a calibration goes by, and the parts of it that its fits take."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from recon.calibration.beside_volume import Beside
from recon.calibration.part import PIXELS, PLANES, SLICES, Part, part_of
from recon.calibration.trials.orders import Orders, find_orders
from recon.calibration.trials.short_fits import can_be_tried
from recon.config.schema import Config
from recon.fit.bounds import Bounds
from recon.fit.nuisances.light import Lamp
from recon.fit.problem import Problem, Recipe
from recon.misfit.gaussian import GaussianMisfit
from recon.recording.cut_field import needed_margin
from recon.recording.preparation import Measured
from recon.run.data import camera_pixels, load_data
from recon.run.room import check_room_for_descent
from torchdic import Acquisition, Fidelity, Grid, Microscope
from torchdic.ranks.group import ranks_here

# Slices of the volumes by which signs and orders are told, before a round has fewer.
COARSE = 20


@dataclass(frozen=True, eq=False)
class CalibrationStack:
    """A measured stack and what its configuration says of it.

    config: as far as it is calibrated. measured: the stack in the model's unit. data, mask: its pixels, and which of
    them count.
    """

    config: Config
    measured: Measured
    data: Float[Tensor, "prism focus y x"]
    mask: Bool[Tensor, "prism focus y x"] | None

    @classmethod
    def read(cls, config: Config, device: torch.device) -> "CalibrationStack":
        """The stack that a configuration names. Raises ConfigError and StackError as `load_data` does."""
        measured = load_data(config)
        counted = measured.left_out.counted
        mask = None if counted is None else torch.from_numpy(counted).to(device)
        return cls(config, measured, torch.from_numpy(measured.data).to(device), mask)

    @property
    def noise(self) -> list[float]:
        """Standard deviation of each prism's noise; 0 where it isn't known."""
        return self.measured.noise or [0.0] * len(self.data)

    @property
    def pixels(self) -> Grid:
        """The stack's pixels, and the volume's slices, as a grid: the voxels of all short fits."""
        return camera_pixels(self.config)

    @property
    def microscope(self) -> Microscope:
        """The microscope without its camera, whose pixels are the voxels."""
        return replace(self.config.microscope, camera=None)

    def with_config(self, config: Config) -> "CalibrationStack":
        """The same, with more calibrated. The data stay relative to the empty field of the biases that were told."""
        return replace(self, config=config)

    def part(self, pixels: int = PIXELS, planes: int = PLANES, slices: int = SLICES) -> Part:
        """The part around the strongest structure; at most so many of each."""
        return part_of(self.data, self.mask, self.pixels, pixels, planes, slices)

    def orders(self, bounds: Bounds) -> Orders | None:
        """Signs and orders by short fits; None where no linear response lets them be made. bounds: of Δn."""
        part, recipe = self.part(slices=COARSE), Recipe(bounds=bounds, prior=self.config.reconstruction.prior)
        config, fidelity = self.config, Fidelity("wave")

        def problem_of(acquisition: Acquisition, slices: int, recipe: Recipe) -> Problem:
            some = part.sliced(slices)
            setup = some.setup(config.volume.background, self.microscope, acquisition)
            return Problem.from_recipe(
                some.data, setup, fidelity, recipe, lambda data: GaussianMisfit(data, mask=some.mask), self.noise
            )

        if not can_be_tried(problem_of(config.acquisition, COARSE, recipe)):
            return None
        return find_orders(config.acquisition, problem_of, recipe, self.noise)

    def check_room(self, bounds: Bounds) -> None:
        """Raise ShortOfMemoryError where the fits of a part would take more memory than is free. bounds: of Δn."""
        part, recipe = self.part(), Recipe(bounds=bounds, prior=self.config.reconstruction.prior)
        setup = part.setup(self.config.volume.background, self.microscope, self.config.acquisition)
        problem = Problem.from_recipe(part.data, setup, Fidelity("wave"), recipe, noise=self.noise)
        if can_be_tried(problem):
            check_room_for_descent(problem, GaussianMisfit, at_once=ranks_here())

    def beside(self, planes: int = PLANES) -> Beside:
        """The part of the stack beside a volume that is fitted to it; the volume goes on where the specimen is cut."""
        config, part = self.config, self.part(planes=planes)
        told = config.reconstruction
        # what flattening around a specimen has left of the lamp would be put down to the optics
        learn = (Lamp.name,) if Lamp.name in told.learn else ()
        recipe = Recipe(bounds=told.bounds, prior=told.prior, learn=learn)
        scene = part.grid, self.microscope, config.volume.background
        margin = needed_margin(part.data.cpu().numpy(), self.noise, *scene)
        setup = part.setup(config.volume.background, self.microscope, config.acquisition, margin)
        return Beside(part, setup, recipe, self.noise)
