"""Fits of other images than the measured ones, which tell how far a volume may be off.

Noise: the estimate's own images with other noise are fitted in the same way, and once without any. How the former
differ from the latter is how the estimate differs from that of noiseless images (the parametric bootstrap: B. Efron and
R. J. Tibshirani, An Introduction to the Bootstrap, Chapman & Hall 1993, 6.5). The estimate stands for the specimen.

What is lost: what the images don't see, the priors fill, and they fill it in the estimate already, whose own images a
fit therefore explains by nearly the same volume. A copy that is turned has the estimate's well known sides where the
images see little. It is known; it is recorded like the specimen, with noise, and fitted like it: how the fit differs
from it is the whole error of such a fit.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor
from tqdm import tqdm

from recon.evidence.estimate import Estimate
from recon.evidence.turned import middle, turn, turned
from recon.fit.problem import Problem
from recon.fit.step import Step
from torchdic.ranks.each import each

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


def refits(estimate: Estimate, wanted: Sequence[Named], *, at_once: bool = True) -> Iterator[Refit]:
    """The refits that are wanted, in this order, as they are done, beside a bar that says so.

    Each depends on its kind and number alone. at_once: whether of several processes each does one by itself, where the
    estimate's function that solves must be one of a module; else all of them do one after the other together.
    """
    own = estimate.images(estimate.delta) if any(kind != "turned" for kind, _ in wanted) else None

    def problem(kind: Kind, number: int) -> Problem | None:
        if kind == "turned":
            images = estimate.images(copy(estimate, number))
            return estimate.of_other_images(estimate.recorded(images, SEEDS_OF_COPIES + number), anywhere=True)
        assert own is not None
        noisy = kind == "noise"
        return estimate.of_other_images(estimate.recorded(own, number) if noisy else own, going_on=noisy)

    problems, solve = (problem(*one) for one in wanted), partial(_solved, estimate.solve)
    within = estimate.problem.setup.within_field
    volumes = each(solve, problems) if at_once else map(solve, problems)
    for (kind, number), found in zip(tqdm(wanted, desc="refits", unit="fit"), volumes, strict=True):
        delta = torch.zeros_like(estimate.delta) if found is None else found
        truth = within(copy(estimate, number)).cpu() if kind == "turned" else None
        yield Refit(kind, number, within(delta).cpu(), truth)


def _solved(solve: Callable[[Problem], Step], problem: Problem | None) -> Float[Tensor, "z y x"] | None:
    """Δn of a problem's solution; None where there is no problem."""
    return None if problem is None else solve(problem).delta


def copy(estimate: Estimate, number: int) -> Float[Tensor, "z y x"]:
    """The estimate, turned: a specimen of its kind. number: of the copy, from 0."""
    delta = estimate.delta
    return turned(delta, estimate.problem.setup.volume.grid, middle(delta), turn(number))
