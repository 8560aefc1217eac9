"""All that a stack's images tell before anything is fitted."""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Real
from scipy import ndimage

from recon.recording.background import background_surface, noise_level
from recon.recording.masks import counted_pixels, median_of_known, nearest_counted
from recon.recording.stuck_pixels import stuck_pixels
from recon.recording.survey.dark_counts import DarkCounts, dark_counts
from recon.recording.survey.direction import ShearDirection, shear_direction, specimens
from recon.recording.survey.focus import sharpest_plane
from torchdic.files.format import Stack

# Share of the images in which a pixel is saturated that is hot, among neighbours of which fewer than half are: too much
# light saturates whole regions.
_ALWAYS, _ALONE = 0.9, 0.5

# Pixels along a side of the square that holds a pixel's neighbours.
_NEIGHBOURS = 5

# Pixels along a side of the smallest images that tell anything.
SMALLEST = 16

# Share of white noise's power that a Gaussian of one pixel's width lets through.
_KEPT = 1 / (4 * math.pi)


@dataclass(frozen=True, eq=False)
class SettingSurvey:
    """What the images of one prism setting tell.

    level: median of the background over the field, in the file's unit, dark counts and all.
    tilt: (y, x), the background's change across the field; unevenness: peak to peak; both relative to its level.
    flicker: standard deviation of the planes' brightness; brightness: of each plane; both relative to their mean.
    noise: standard deviation of a pixel's noise, in the file's unit; None where images are too small to tell.
    direction: of the shear; None where the images show none.
    likeness: correlation of the images with those of each setting before, from −1 to 1; noise isn't counted.
    """

    level: float
    tilt: tuple[float, float]
    unevenness: float
    flicker: float
    brightness: Float[np.ndarray, " focus"]
    noise: float | None
    direction: ShearDirection | None
    likeness: tuple[float, ...]


@dataclass(frozen=True, eq=False)
class Survey:
    """What a stack's images tell.

    How far the specimen drifted isn't among it: through focus the images of one bias change as if they moved, by up to
    a tenth of the depth. A fit learns it.

    settings: one for each prism setting. sharpest: number of the sharpest plane, counted from 0.
    camera: its gain and dark counts; None where the noise doesn't tell them.
    hot, dead: pixels (y, x) that are brighter, and darker, than the light. saturated: pixels of all images that are.
    """

    settings: tuple[SettingSurvey, ...]
    sharpest: int
    camera: DarkCounts | None
    hot: Bool[np.ndarray, "y x"]
    dead: Bool[np.ndarray, "y x"]
    saturated: int


def shows_edges(found: Survey) -> bool:
    """Whether any setting's images show a direction of shear, as the edges of a specimen do."""
    return any(setting.direction is not None for setting in found.settings)


def survey(stack: Stack, ratio: float) -> Survey:
    """Look through a stack.

    ratio: how far a specimen's pixel may stand out of its neighbours, see `recon.recording.stuck_pixels.sharpest`.
    """
    counted = counted_pixels(stack)
    stuck = stuck_pixels(stack.data, ratio, counted)
    if counted is not None:
        stuck = stuck | _hot(~counted)
    saturated = 0 if counted is None else int((~counted & ~stuck).sum())
    counted = counted_pixels(stack, None, stuck)
    pixel = stack.pixel_size or (1.0, 1.0)
    flattened = np.stack(
        [flattened_planes(planes, None if counted is None else counted[i]) for i, planes in enumerate(stack.data)]
    )
    settings = [
        _setting(planes if counted is None else np.where(counted[i], planes, np.nan), flattened, i, pixel)
        for i, planes in enumerate(stack.data)
    ]
    above = median_of_known(stack.data.reshape(-1, *stack.data.shape[2:])) > np.median(stack.data)
    return Survey(
        settings=tuple(settings),
        sharpest=sharpest_plane(flattened),
        camera=_camera(stack, flattened, counted),
        hot=stuck & above,
        dead=stuck & ~above,
        saturated=saturated,
    )


def _hot(saturated: Bool[np.ndarray, "prism focus y x"]) -> Bool[np.ndarray, "y x"]:
    """The pixels of a camera that are always saturated, and most of whose neighbours aren't."""
    share = saturated.mean((0, 1))
    return (share > _ALWAYS) & (ndimage.uniform_filter(share, _NEIGHBOURS, mode="nearest") < _ALONE)


def flattened_planes(
    planes: Real[np.ndarray, "focus y x"], counted: Bool[np.ndarray, "focus y x"] | None
) -> Float[np.ndarray, "focus y x"]:
    """One setting's images over their background and of equal brightness, about 1, float32.

    Pixels that don't count have the value of the nearest one that does.

    Where the background isn't above 0, as of floats from which it was subtracted, the images are only brought to one
    level and spread.
    """
    sound = planes if counted is None else np.stack(list(map(nearest_counted, planes, counted)))
    surface = background_surface(np.median(sound, axis=0))
    even = float(surface.min()) > 0
    spread = 1.0 if even else float(np.std(sound, dtype=np.float64)) or 1.0
    flat = np.empty(planes.shape, np.float32)
    for number, image in enumerate(sound):
        if even:
            relative = image / surface
            level = float(np.median(relative))
            flat[number] = relative / level if level > 0 else 1 + relative - level
        else:
            flat[number] = 1 + (image - np.median(image)) / spread
    return flat


def _setting(known: np.ndarray, flattened: np.ndarray, prism: int, pixel: tuple[float, float]) -> SettingSurvey:
    """One setting's survey. known: its planes as stored, NaN where a pixel doesn't count."""
    flat = flattened[prism]
    typical = median_of_known(known)
    curved, plane = background_surface(typical), background_surface(typical, 1)
    level = float(np.median(curved))
    relative = 1 / level if level > 0 else 0.0
    field = ~specimens(flat)
    field = (field if field.any() else np.ones_like(field)) & (curved > 0)
    lit = [float(np.nanmedian(image[field] / curved[field])) if field.any() else 1.0 for image in known]
    brightness = np.array(lit)
    mean = float(brightness.mean())
    return SettingSurvey(
        level=level,
        tilt=(float(plane[-1, 0] - plane[0, 0]) * relative, float(plane[0, -1] - plane[0, 0]) * relative),
        unevenness=float(np.ptp(curved)) * relative,
        flicker=float(brightness.std()) / mean if mean > 0 else 0.0,
        brightness=brightness / mean if mean > 0 else np.ones_like(brightness),
        noise=noise_level(known),
        direction=shear_direction(flat, pixel),
        likeness=tuple(_likeness(flat, other) for other in flattened[:prism]),
    )


def _likeness(images: np.ndarray, others: np.ndarray) -> float:
    """The correlation of two settings' images, plane by plane, of what isn't noise."""
    product, powers = 0.0, np.zeros(2)
    for pair in zip(images, others, strict=True):
        a, b = ((smooth - smooth.mean()).ravel() for smooth in (ndimage.gaussian_filter(each, 1) for each in pair))
        product += float(a @ b)
        noise = np.array([(noise_level(each) or 0.0) ** 2 * each.size * _KEPT for each in pair])
        powers += np.array([a @ a, b @ b]) - noise
    if not (powers > 0).all():  # noise alone
        return 0.0
    return float(np.clip(product / math.sqrt(powers.prod()), -1, 1))


def _camera(stack: Stack, flattened: np.ndarray, counted: np.ndarray | None) -> DarkCounts | None:
    """Gain and dark counts, from the empty field alone: a specimen's fine detail would count as noise."""
    if not stack.is_integer:
        return None
    empty = np.stack([np.broadcast_to(~specimens(planes), planes.shape) for planes in flattened])
    return dark_counts(stack.data, empty if counted is None else empty & counted)
