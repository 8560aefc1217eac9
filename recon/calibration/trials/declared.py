"""What may have been recorded instead of what was declared: signs, orders and axes, one mistake or several at once."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import combinations, permutations, product

from torchdic import Acquisition, Prism
from torchdic.scalar import number

# Descriptions whose shears differ by less than this part of their length, and biases by less than so much, give images
# that no short fit tells apart: measured axes are never quite across one another.
ALIKE, ALIKE_BIAS = 0.15, 0.1

# All orders of the prisms are tried where there are at most so many of them; of more, none.
MOST_PRISMS = 4

# What tells acquisitions apart: shear and bias of each prism, nothing for bright field, and the focus planes.
_Images = tuple[tuple[tuple[float, ...], ...], tuple[float, ...]]


@dataclass(frozen=True, eq=False)
class Otherwise:
    """An acquisition that may have been meant instead of the declared one.

    name: of the mistake, or of the mistakes, in a few words, with the order in which prisms are tried. what: in words.
    advice: what to do. mistakes: how many there are; 0 is as declared.
    """

    name: str
    what: str
    advice: str
    acquisition: Acquisition
    mistakes: int = 1


@dataclass(frozen=True)
class _Turn:
    """How the axes of all shears may be mistaken: signs of y and x, and whether y and x are exchanged after that."""

    name: str
    what: str
    advice: str
    y: int = 1
    x: int = 1
    exchanged: bool = False
    mistakes: int = 1

    def of(self, prism: Prism | None) -> Prism | None:
        """The prism with the other shear."""
        if prism is None:
            return None
        shear = (self.y * number(prism.shear[0]), self.x * number(prism.shear[1]))
        return replace(prism, shear=shear[::-1] if self.exchanged else shear)


_NONE = _Turn("", "", "", mistakes=0)
_SIGN = _Turn(
    "sign",
    "the shear or the bias has the other sign",
    "reverse the sign of every shear, or exchange the files of bias +b and −b",
    -1,
    -1,
)
_AXES = _Turn(
    "axes",
    "the shears' axes are exchanged",
    "exchange y and x of every shear: [y, x]; or the prisms' files; or the images are transposed",
    exchanged=True,
)
_MIRRORED = tuple(
    _Turn(
        f"mirrored {axis}",
        f"the images are mirrored in {axis}",
        f"reverse the sign of the shears' {axis}, or mirror the images in {axis}",
        *signs,
    )
    for axis, signs in (("y", (-1, 1)), ("x", (1, -1)))
)
_AXES_AND_SIGN = _Turn(
    "axes and sign",
    "the shears' axes are exchanged and reversed",
    "exchange y and x of every shear and reverse their signs; or turn the images",
    -1,
    -1,
    exchanged=True,
    mistakes=2,
)
_QUARTERS = tuple(
    _Turn(
        f"turned {turn}",
        f"the images are turned a quarter {turn}",
        "exchange y and x of every shear, and reverse the sign of one; or turn the images back",
        *signs,
        exchanged=True,
        mistakes=2,
    )
    for turn, signs in (("clockwise", (1, -1)), ("anticlockwise", (-1, 1)))
)


def one_mistake(declared: Acquisition) -> Iterator[Otherwise]:
    """Each likely mistake, the likeliest first, and two that are often made at once; those that change nothing too."""
    yield _turned(declared, _SIGN)
    yield _reversed(declared)
    for turn in (_AXES, *_MIRRORED):
        yield _turned(declared, turn)
    both = _reversed(_turned(declared, _SIGN).acquisition).acquisition
    yield Otherwise(
        "sign and focus",
        "signs and planes are both reversed",
        "reverse every shear, and acquisition.focus",
        both,
        2,
    )
    yield _turned(declared, _AXES_AND_SIGN)
    if len(declared.prisms) <= MOST_PRISMS:
        for i, j in combinations(range(len(declared.prisms)), 2):
            order = list(range(len(declared.prisms)))
            order[i], order[j] = order[j], order[i]
            yield _reordered(declared, order)


def all_mistakes(declared: Acquisition) -> list[Otherwise]:
    """The acquisition as declared, and with every combination of mistakes: axes, signs, order of prisms and of planes.

    Those that give nearly the same images are one, described by the fewest mistakes; the fewest come first.
    """
    turns = (_NONE, _SIGN, _AXES, *_MIRRORED, _AXES_AND_SIGN, *_QUARTERS)
    number_of = len(declared.prisms)
    orders = list(permutations(range(number_of))) if number_of <= MOST_PRISMS else [tuple(range(number_of))]
    found = []
    for turn, order, back in product(turns, orders, (False, True)):
        steps = [_turned(declared, turn)] if turn.mistakes else []
        if list(order) != sorted(order):
            steps.append(_reordered(steps[-1].acquisition if steps else declared, order))
        if back:
            steps.append(_reversed(steps[-1].acquisition if steps else declared))
        found.append(_together(declared, steps))
    distinct: list[tuple[_Images, Otherwise]] = []
    # among equals a sign or an axis is the plainer mistake than exchanged prisms
    for other in sorted(found, key=lambda other: (other.mistakes, "prisms" in other.name)):
        images = images_of(other.acquisition)
        if not any(_alike(images, known) for known, _ in distinct):
            distinct.append((images, other))
    return [other for _, other in distinct]


def _alike(one: _Images, other: _Images) -> bool:
    """Whether two acquisitions, as `images_of` tells them apart, give nearly the same images."""
    (prisms, focus), (others, planes) = one, other
    if focus != planes or [len(a) for a in prisms] != [len(b) for b in others]:
        return False
    return all(
        math.dist(a[:2], b[:2]) <= ALIKE * math.hypot(*a[:2]) and abs(a[2] - b[2]) <= ALIKE_BIAS
        for a, b in zip(prisms, others, strict=True)
        if a
    )


def images_of(acquisition: Acquisition) -> _Images:
    """What tells acquisitions apart. A prism of the other shear and bias is the same one, with its beams renamed."""
    prisms = []
    for prism in acquisition.prisms:
        sign = 1 if prism is None or number(prism.bias) >= 0 else -1
        values = () if prism is None else (*map(number, prism.shear), number(prism.bias))
        prisms.append(tuple(round(sign * value, 9) + 0.0 for value in values))
    return tuple(prisms), tuple(round(number(focus), 9) + 0.0 for focus in acquisition.focus)


def _turned(declared: Acquisition, turn: _Turn) -> Otherwise:
    made = Acquisition([turn.of(prism) for prism in declared.prisms], declared.focus)
    return Otherwise(turn.name, turn.what, turn.advice, made, turn.mistakes)


def _reversed(declared: Acquisition) -> Otherwise:
    """The planes in the other order, within the same range: a shift of all along z is the volume's own."""
    focus = [number(depth) for depth in declared.focus]
    ends = min(focus) + max(focus)
    return Otherwise(
        "focus",
        "the planes are in the other order",
        "reverse acquisition.focus: the stage's +z is −z",
        Acquisition(declared.prisms, [ends - depth for depth in focus]),
    )


def _reordered(declared: Acquisition, order: list[int] | tuple[int, ...]) -> Otherwise:
    """Image i was recorded with the declared prism order[i]."""
    moved = [i + 1 for i, place in enumerate(order) if i != place]
    if len(moved) == 2:
        first, second = moved
        name, what = f"prisms {first}↔{second}", f"prisms {first} and {second} (from 1) are exchanged"
        advice = "exchange them in acquisition.prisms"
    else:
        places = ", ".join(str(i + 1) for i in order)
        name, what = f"prisms in order {places}", f"the prisms (from 1) are in the order {places}"
        advice = f"put acquisition.prisms in the order {places}"
    acquisition = Acquisition([declared.prisms[i] for i in order], declared.focus)
    return Otherwise(name, what, advice, acquisition, 1 if len(moved) == 2 else 2)


def _together(declared: Acquisition, steps: list[Otherwise]) -> Otherwise:
    if not steps:
        return Otherwise("as declared", "all is as declared", "", declared, 0)
    name, what, advice = (
        separator.join(getattr(step, part) for step in steps)
        for part, separator in (("name", " and "), ("what", ", and "), ("advice", "; "))
    )
    return Otherwise(name, what, advice, steps[-1].acquisition, sum(step.mistakes for step in steps))
