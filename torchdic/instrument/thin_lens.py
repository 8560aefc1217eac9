"""The lens law: distances, focal length and magnification of a thin lens."""

import math
from dataclasses import dataclass

# Where more lengths are given than the lens law needs, they agree if they differ by no more than this, relatively.
_AGREE = 1e-6


@dataclass(frozen=True)
class ThinLens:
    """A thin lens that forms a real image: 1/f = 1/a + 1/b and M = b/a; `thin_lens` finds it from any two of these.

    focal_length: f in µm.
    object_distance: a in µm.
    image_distance: b in µm.
    magnification: M of the image, which is inverted.

    Raises ValueError where one isn't positive, or they break one of the two laws.
    """

    focal_length: float
    object_distance: float
    image_distance: float
    magnification: float

    def __post_init__(self) -> None:
        f, a, b, m = self.focal_length, self.object_distance, self.image_distance, self.magnification
        for name, value in vars(self).items():
            if not (0 < value < math.inf):
                raise ValueError(f"{name} {value:g} must be above 0: the lens law 1/f = 1/a + 1/b forms no real image")
        if not math.isclose(1 / f, 1 / a + 1 / b, rel_tol=_AGREE):
            raise ValueError(
                f"lens law 1/f = 1/a + 1/b: 1/{f:g} isn't 1/{a:g} + 1/{b:g}, it calls for f {a * b / (a + b):g}"
            )
        if not math.isclose(m, b / a, rel_tol=_AGREE):
            raise ValueError(f"magnification M = b/a: {m:g} isn't {b:g}/{a:g} = {b / a:g}")


def thin_lens(
    *,
    focal_length: float | None = None,
    object_distance: float | None = None,
    image_distance: float | None = None,
    magnification: float | None = None,
) -> ThinLens:
    """The thin lens from two or more of its lengths (µm) and its magnification, by 1/f = 1/a + 1/b and M = b/a.

    Raises ValueError for fewer than two, lengths that form no real image, and values that contradict each other.
    """
    f, a, b, m = focal_length, object_distance, image_distance, magnification
    given = {"focal_length": f, "object_distance": a, "image_distance": b, "magnification": m}
    known = {name: value for name, value in given.items() if value is not None}
    if len(known) < 2:
        raise ValueError(f"the lens law needs two of {', '.join(given)}; {len(known)} given")
    for name, value in known.items():
        if not (0 < value < math.inf):
            raise ValueError(f"{name} {value:g} must be above 0")
    for name, distance in (("object_distance", a), ("image_distance", b)):
        if f is not None and distance is not None and distance <= f:
            raise ValueError(
                f"{name} {distance:g} must be above the focal length {f:g}: 1/f = 1/a + 1/b forms no real image"
            )
    if f is not None and a is None:
        a = f * (1 + 1 / known["magnification"]) if b is None else f * b / (b - f)
    elif a is None:
        a = known["image_distance"] / known["magnification"]
    if b is None:
        b = f * a / (a - f) if m is None and f is not None else a * known["magnification"]
    return ThinLens(a * b / (a + b) if f is None else f, a, b, b / a if m is None else m)
