"""Fits of other images than the measured ones, which tell how far a volume may be off.

Noise: the estimate's own images with other noise are fitted in the same way, and once without any. How the former
differ from the latter is how the estimate differs from that of noiseless images (the parametric bootstrap: B. Efron and
R. J. Tibshirani, An Introduction to the Bootstrap, Chapman & Hall 1993, 6.5). The estimate stands for the specimen.

What is lost: what the images don't see, the priors fill, and they fill it in the estimate already, whose own images a
fit therefore explains by nearly the same volume. A copy that is turned has the estimate's well known sides where the
images see little. It is known; it is recorded like the specimen, with noise, and fitted like it: how the fit differs
from it is the whole error of such a fit.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

from jaxtyping import Float
from torch import Tensor
from tqdm import tqdm

from recon.evidence.estimate import Estimate
from recon.evidence.turned import middle, turn, turned

# What a refit is of, and with its number from 0, which one it is.
Kind = Literal["noiseless", "noise", "turned"]
Named = tuple[Kind, int]

# How many there are unless the user says otherwise.
NOISY, COPIES = 16, 8

# Seeds of the noise: those of the copies begin here.
SEEDS_OF_COPIES = 1000


@dataclass(frozen=True, eq=False)
class Refit:
    """A fit of other images.

    kind: "noiseless", of the estimate's own images; "noise", of these with other noise; "turned", of a turned copy.
    number: of its kind, from 0. delta: what was found. truth: what it was to find, of a turned copy; Δn (z, y, x), both
    within the field.
    """

    kind: Kind
    number: int
    delta: Float[Tensor, "z y x"]
    truth: Float[Tensor, "z y x"] | None = None


def planned_refits(noise: int, copies: int) -> list[Named]:
    """Kinds and numbers of so many refits, and of the one without noise, in the order in which they are done."""
    return [
        ("noiseless", 0),
        *(("noise", number) for number in range(noise)),
        *(("turned", number) for number in range(copies)),
    ]


def refits(estimate: Estimate, wanted: list[Named]) -> Iterator[Refit]:
    """The refits that are wanted, one by one as they are done, beside a bar that says so.

    Each depends on its kind and number alone.
    """
    setup = estimate.problem.setup
    own = estimate.images(estimate.delta) if any(kind != "turned" for kind, _ in wanted) else None
    for kind, number in tqdm(wanted, desc="refits", unit="fit"):
        if kind == "turned":
            truth = copy(estimate, number)
            images = estimate.recorded(estimate.images(truth), SEEDS_OF_COPIES + number)
            found = estimate.refitted(images, anywhere=True)
            yield Refit(kind, number, setup.within_field(found).cpu(), setup.within_field(truth).cpu())
            continue
        assert own is not None
        noisy = kind == "noise"
        found = estimate.refitted(estimate.recorded(own, number) if noisy else own, going_on=noisy)
        yield Refit(kind, number, setup.within_field(found).cpu())


def copy(estimate: Estimate, number: int) -> Float[Tensor, "z y x"]:
    """The estimate, turned: a specimen of its kind. number: of the copy, from 0."""
    delta = estimate.delta
    return turned(delta, estimate.problem.setup.volume.grid, middle(delta), turn(number))
