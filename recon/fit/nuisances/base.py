"""What every nuisance has: what it says of its parameter's entries, so that few images show how all of them act."""

from typing import ClassVar, Literal

import torch
from torch import Tensor

from recon.fit.unknowns import Unknown


class Nuisance(Unknown):
    """A quantity of few numbers that the images depend on, but that isn't what is sought.

    Adam moves it as any unknown, and `recon.fit.nuisances.refinement.refined` by Gauss and Newton, with differences of
    images. A subclass is a frozen dataclass with these fields, whose first value suits a well-aligned microscope:
    learning_rate: Adam's first, in the parameter's unit. step: of the differences, in the parameter's unit; ten of
    them are a large error. Raises ValueError unless both are above 0.

    and says of its parameter:
    axes: the images' axes that its first axes are. An entry acts on the images of its own prism, or plane, alone, so
    that one set of images with all such entries moved shows what each of them does. The parameter's other axes have
    their own set each.
    centred: whether only the differences between those entries can be told: their mean plays no part in the value.
    width: one standard deviation of its entries about 0 before an image is seen, in the parameter's unit; None where
    nothing is known of them, and in Adam's descent, which goes by the images alone.
    forms: whether it acts on how images are formed; if not, on their recording alone, and nothing is propagated anew.
    `put` then replaces what was there.
    """

    learning_rate: float
    step: float
    width: ClassVar[float | None] = None
    axes: ClassVar[tuple[Literal["prism", "focus"], ...]] = ()
    centred: ClassVar[bool] = False
    forms: ClassVar[bool] = True

    def __post_init__(self) -> None:
        for name, value in (("learning_rate", self.learning_rate), ("step", self.step)):
            if not (0 < value < float("inf")):
                raise ValueError(f"{self.name}: {name} {value} must be above 0")

    def value(self, parameter: Tensor) -> Tensor:
        """The value that a parameter stands for; differentiable."""
        return self.of_entries(self.told(parameter))

    def told(self, parameter: Tensor) -> Tensor:
        """The parameter without the mean that can't be told."""
        axes = tuple(range(len(self.axes)))
        return parameter - parameter.mean(axes, keepdim=True) if self.centred else parameter

    def of_entries(self, entries: Tensor) -> Tensor:
        """The value of entries whose mean has been taken out; each is that of its own entry."""
        return entries

    def directions(self, parameter: Tensor) -> Tensor:
        """(direction, *the parameter's shape): 1 at the entries that are moved together, 0 elsewhere."""
        shape = parameter.shape[len(self.axes) :]
        number = shape.numel()
        unit = torch.eye(number, dtype=parameter.dtype, device=parameter.device)
        return unit.reshape(number, *(1,) * len(self.axes), *shape).expand(number, *parameter.shape)

    def acting(self, parameter: Tensor, images: tuple[int, int]) -> Tensor:
        """How far each entry moves each image along each direction: (prism, focus, direction, entry), float64.

        images: how many prisms and planes there are.
        """
        own, number = parameter.shape[: len(self.axes)], parameter.numel()
        unit = torch.eye(number, dtype=torch.float64, device=parameter.device).reshape(*parameter.shape, number)
        unit = self.told(unit).reshape(*own, -1, number)
        for axis, name in enumerate(("prism", "focus")):
            if name not in self.axes:
                unit = unit.unsqueeze(axis)
        return unit.expand(*images, *unit.shape[2:])
