"""What is wrong with a recording: its lamp, its camera's pixels, and a stage that drifts."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

# No light reaches a corner at a steeper angle.
_RIGHT_ANGLE = math.pi / 2


@dataclass(frozen=True)
class Faults:
    """The faults of a recording; without any it is one of an even lamp, sound pixels and a stage at rest.

    tilt: the lamp's change (y, x) from one side of the field to the other, relative to its mean.
    vignette: angle in rad at which light reaches the field's corners, where it falls to cos⁴ of that; 0 is no fall.
    flicker: standard deviation of the images' brightness, relative to its mean.
    drift: (y, x) in µm by which the specimen moves from one plane to the next; the middle plane is where it is.
    hot: how many pixels have a dark current.
    dead: how many pixels give the camera's offset alone.
    dark_current: of the hottest pixel at most, relative to the light of an empty bright field; each has a fifth of it,
    or more.

    Raises ValueError for a lamp that is dark somewhere, a flicker or a number of pixels below 0, and a dark current not
    above 0.
    """

    tilt: tuple[float, float] = (0.0, 0.0)
    vignette: float = 0.0
    flicker: float = 0.0
    drift: tuple[float, float] = (0.0, 0.0)
    hot: int = 0
    dead: int = 0
    dark_current: float = 1.0

    def __post_init__(self) -> None:
        if not abs(self.tilt[0]) + abs(self.tilt[1]) < 2:
            raise ValueError(f"tilt {self.tilt} must leave light in each corner: |y| + |x| must be below 2")
        if not 0 <= self.vignette < _RIGHT_ANGLE:
            raise ValueError(f"vignette {self.vignette} rad must be at least 0 and below π/2")
        if not 0 <= self.flicker < 0.3:
            raise ValueError(f"flicker {self.flicker} must be at least 0 and below 0.3")
        if not all(map(math.isfinite, self.drift)):
            raise ValueError(f"drift {self.drift} µm must be finite (y, x)")
        for name, number in (("hot", self.hot), ("dead", self.dead)):
            if isinstance(number, bool) or int(number) != number or number < 0:
                raise ValueError(f"{name} {number} must be a whole number of pixels, at least 0")
        if not 0 < self.dark_current < math.inf:
            raise ValueError(f"dark_current {self.dark_current} must be above 0")

    def lamp(self, pixels: tuple[int, int]) -> Float[Tensor, "y x"]:
        """The lamp's light on each of the pixels (y, x), float64; its mean is 1."""
        y, x = (2 * (torch.arange(n, dtype=torch.float64) + 0.5) / n - 1 for n in pixels)
        y, x = y[:, None], x[None, :]
        tilted = 1 + (self.tilt[0] * y + self.tilt[1] * x) / 2
        # tanθ grows as the distance from the axis, of which a corner is √2 away; cos⁴θ = 1/(1 + tan²θ)²
        tangent = math.tan(self.vignette) ** 2 * (y.square() + x.square()) / 2
        light = tilted / (1 + tangent) ** 2
        return light / light.mean()

    def brightness(self, images: tuple[int, int], generator: torch.Generator) -> Float[Tensor, "prism focus"]:
        """The brightness of each of the images (prism, focus), about 1, float64."""
        drawn = torch.randn(images, generator=generator, dtype=torch.float64)
        return 1 + self.flicker * drawn.clamp(-3, 3)

    def shifts(self, planes: int) -> Float[Tensor, "focus 2"]:
        """Where the specimen is in each plane, (y, x) in µm from its own place, float64."""
        after = torch.arange(planes, dtype=torch.float64) - (planes - 1) // 2
        return after[:, None] * torch.tensor(self.drift, dtype=torch.float64)

    def stuck(
        self, pixels: tuple[int, int], generator: torch.Generator
    ) -> tuple[Float[Tensor, "y x"], Bool[Tensor, "y x"]]:
        """The dark current of each pixel, in empty bright fields, and the dead pixels (True).

        They lie apart by a pixel at least. Raises ValueError where the camera has no room for them.
        """
        current, dead = torch.zeros(pixels, dtype=torch.float64), torch.zeros(pixels, dtype=torch.bool)
        free = torch.ones(pixels, dtype=torch.bool)
        for number in range(self.hot + self.dead):
            places = free.nonzero()
            if len(places) == 0:
                raise ValueError(f"{self.hot} hot and {self.dead} dead pixels have no room on {tuple(pixels)}")
            y, x = places[int(torch.randint(len(places), (1,), generator=generator))].tolist()
            free[max(y - 1, 0) : y + 2, max(x - 1, 0) : x + 2] = False
            if number < self.hot:
                share = 0.2 + 0.8 * float(torch.rand(1, generator=generator, dtype=torch.float64))
                current[y, x] = self.dark_current * share
            else:
                dead[y, x] = True
        return current, dead
