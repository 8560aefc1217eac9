"""Values from a stack of a specimen that isn't known: what shows beside any volume, and why the rest doesn't."""

import math
from dataclasses import replace

import torch

from recon.calibration.beside_volume import Beside, find_angles, find_aperture, find_images, find_length
from recon.calibration.foreknowledge import most_probable
from recon.calibration.length_and_bias import Shared, shared
from recon.calibration.optics import ShearOfAxes, axes_of, firsts_of
from recon.calibration.trials.profile import Least
from recon.calibration.trials.short_fits import can_be_tried
from recon.config.schema import Config
from recon.run.calibration.assumed import foreknowledge
from recon.run.calibration.found import (
    DIRECTION,
    LENGTH,
    FoundQuantity,
    left,
    plain,
    rounded,
    rounded_angle,
    rounded_shear,
)
from recon.run.calibration.stack import CalibrationStack
from torchdic import Acquisition, Prism
from torchdic.scalar import number

# Planes whose brightness and drift are looked at, at most.
PLANES = 15

# An angle, and the logarithms of an aperture and a length, that are as uncertain as this aren't told.
UNSURE_ANGLE, UNSURE_APERTURE, UNSURE_LENGTH = math.radians(10), 0.1, 0.15

# Where the best volume leaves more than this many times what noise does, and this share of the contrast, what it
# doesn't explain would be put down to the aperture.
POOR, LEAST = 1.3, 0.03

# What slabs, directions and priors move the logarithms of aperture and length and the angle by, as measured on known
# scenes.
MODEL_APERTURE, MODEL_LENGTH, MODEL_ANGLE = 0.05, 0.05, math.radians(0.5)

# An aperture within so many standard deviations of what was told agrees with it: dim specimens tell little of it, and
# priors move it.
AGREES = 3.0

# A drift of which an image's is so many standard deviations from 0 shows: there are a hundred of them in a stack.
SHOWS = 4.0

# What tells the biases besides an unknown specimen.
BIASES = {"bias", "compensator's zero"}

PRODUCT = "beside an unknown specimen the images tell no more than its product with the shear's length; use a bead"


def by_specimen(stack: CalibrationStack, known: set[str]) -> tuple[CalibrationStack, list[FoundQuantity]]:
    """The stack with what shows beside an unknown specimen, and each quantity. known: what has been found already."""
    beside = stack.beside()
    if not can_be_tried(beside.problem(beside.setup)):
        why = "no prism has a linear response, without which no volume can be fitted beside it"
        untold = [left(name, "", None, why) for name in (DIRECTION, "condenser na", LENGTH)]
        return stack, [*untold, *_untold(stack.config, known)]
    print("the shear's direction, the condenser's aperture and the shear's length, by volumes fitted with several …")
    beside = beside.held()
    stack, angles = _angles(stack, beside)
    beside = replace(beside, setup=replace(beside.setup, acquisition=_of_part(stack, beside)))
    stack, aperture = _aperture(stack, beside)
    stack, length = _length(stack, alone=bool(BIASES & known))
    stack, images = _images(stack)
    untold = _untold(stack.config, known | {quantity.name for quantity in length})
    return stack, [angles, *aperture, *length, *images, *untold]


def _untold(config: Config, known: set[str]) -> list[FoundQuantity]:
    """What an unknown specimen doesn't tell, and why."""
    prisms = [prism for prism in config.acquisition.prisms if prism is not None]
    found: list[FoundQuantity] = []
    if not BIASES & known:
        several = len({round(abs(number(prism.bias)), 3) for prism in prisms}) > 1 or None in config.acquisition.prisms
        pairs = len(prisms) > 1
        why = PRODUCT
        if pairs and not config.calibration.one_exposure:
            told = "them" if several else "the compensator's zero"
            why += f"; if all settings had one exposure, calibration.one_exposure = true finds {told} from the levels"
        found.append(left("bias", "rad", [number(prism.bias) for prism in prisms], why))
    found.append(left("focus zero", "µm", None, "focus against z is a gauge: the volume moves with the planes"))
    why = "beside an unknown specimen they can't be told from its structure; use a bead"
    found.append(left("aberrations", "rad", None, why))
    return found


def _angles(stack: CalibrationStack, beside: Beside) -> tuple[CalibrationStack, FoundQuantity]:
    config = stack.config
    found = find_angles(beside)
    told = [math.atan2(number(p.shear[0]), number(p.shear[1])) for p in firsts_of(config.acquisition)]
    name, unit = DIRECTION, "rad"
    deviations = [math.hypot(least.deviation, MODEL_ANGLE) for least in found]
    if max(deviations) > UNSURE_ANGLE:
        why = "volumes explain the images as well with other directions: the specimen's own structure hides it"
        return stack, left(name, unit, told, why + _hidden(found, beside))
    known = foreknowledge(config)
    weighed = (most_probable(least.value, each, known.angle) for least, each in zip(found, deviations, strict=True))
    turns, sure = zip(*weighed, strict=True)
    by_images = ", ".join(map(_off, found, deviations))
    how = f"volumes fitted with {_tried(found)} directions, {_misfits(found, beside)}; the images put it {by_images} "
    how += f"from what was told, which is known to {math.degrees(known.limits[2]):.2g}°"
    unknown = ShearOfAxes(axes_of(config.acquisition))
    turned = torch.tensor([[1.0, turn] for turn in turns], dtype=torch.float64)
    made = unknown.put(turned, replace(beside.setup, acquisition=config.acquisition)).acquisition
    prisms = [prism if prism is None else rounded_shear(prism) for prism in made.prisms]
    calibrated = replace(config, acquisition=replace(made, prisms=prisms))
    values = [rounded(t + turn, 5) for t, turn in zip(told, turns, strict=True)]
    quantity = FoundQuantity(name, unit, told, values, [rounded(deviation, 2) for deviation in sure], how)
    return stack.with_config(calibrated), quantity


def _off(least: Least, deviation: float) -> str:
    return f"{math.degrees(least.value):+.1f}° ± {math.degrees(deviation):.1f}°"


def _aperture(stack: CalibrationStack, beside: Beside) -> tuple[CalibrationStack, list[FoundQuantity]]:
    config, name = stack.config, "condenser na"
    condenser = config.microscope.condenser
    if condenser is None or number(condenser.na) == 0 or condenser.points is not None or condenser.inner_na is not None:
        return stack, []
    before = number(condenser.na)
    found = find_aperture(beside)
    lowest, alone = min(misfit for _, misfit in found.tried), beside.alone
    if lowest > POOR * alone and lowest - alone > LEAST:
        why = f"the best volume leaves {lowest / alone:.1f} × what noise does" if alone > 0 else "the fit is poor"
        return stack, [left(name, "", before, f"{why}, which would be put down to it")]
    deviation = math.hypot(found.deviation, MODEL_APERTURE)
    if deviation > UNSURE_APERTURE:
        why = "volumes explain the images as well with other apertures"
        return stack, [left(name, "", before, why + _hidden([found], beside))]
    na = rounded(before * math.exp(found.value), 4)
    sure = rounded(na * deviation, 2)
    how = f"volumes fitted with {_tried([found])} apertures, {_misfits([found], beside)}"
    if abs(found.value) < AGREES * deviation:
        how += "; it agrees with what was told, which stays"
        return stack, [FoundQuantity(name, "", before, na, sure, how)]
    microscope = replace(config.microscope, condenser=replace(condenser, na=na))
    quantity = FoundQuantity(name, "", before, na, sure, how)
    return stack.with_config(replace(config, microscope=microscope)), [quantity]


def _length(stack: CalibrationStack, *, alone: bool) -> tuple[CalibrationStack, list[FoundQuantity]]:
    """The shear's length, of all settings alike, and the biases: where two settings tell an image's differential part.

    alone: whether the biases are known by other means, so that all that is found is the length's.
    """
    config = stack.config
    told = [math.hypot(number(p.shear[0]), number(p.shear[1])) for p in firsts_of(config.acquisition)]
    if len(config.acquisition.prisms) < 2:
        why = "one setting's images don't tell their differential part from a bright field's; use two, or a bead"
        return stack, [left(LENGTH, "µm", told, why)]
    beside = stack.beside()
    found = find_length(beside)
    deviation = math.hypot(found.deviation, found.unexplained, MODEL_LENGTH)
    if deviation > UNSURE_LENGTH:
        why = "volumes explain the images as well with other lengths; use a bead"
        return stack, [left(LENGTH, "µm", told, why + _hidden([found], beside))]
    biases = [number(prism.bias) for prism in config.acquisition.prisms if prism is not None]
    known = foreknowledge(config)
    parts = shared(found.value, deviation, biases, replace(known, bias=0.0) if alone else known)
    how = f"volumes fitted with {_tried([found])} lengths, {_misfits([found], beside)}; {_weighed(found, deviation)}; "
    how += f"with the length known to {known.limits[0]:.2g} of it"
    if alone:
        return _with_prisms(stack, parts), [_of_length(told, parts, f"{how} {_probable(parts)}")]
    parts = replace(parts, biases=tuple(map(rounded_angle, parts.biases)))
    how += f" and the bias to {math.degrees(known.limits[1]):.2g}° {_probable(parts)}"
    values, unsure = ([rounded(v, n) for v in part] for part, n in ((parts.biases, 5), (parts.bias_deviations, 2)))
    bias = FoundQuantity("bias", "rad", biases, values, unsure, f"{PRODUCT}; see its length")
    return _with_prisms(stack, parts), [_of_length(told, parts, how), bias]


def _weighed(found: Least, deviation: float) -> str:
    return f"the images put length/tan(bias/2) {math.expm1(found.value):+.1%} ± {deviation:.1%} from what was told"


def _probable(parts: Shared) -> str:
    return f"{math.expm1(parts.change):+.1%} is most probable"


def _of_length(told: list[float], parts: Shared, how: str) -> FoundQuantity:
    values = [rounded(length * math.exp(parts.length), 4) for length in told]
    unsure = [rounded(value * parts.length_deviation, 2) for value in values]
    return FoundQuantity(LENGTH, "µm", told, values, unsure, how)


def _with_prisms(stack: CalibrationStack, parts: Shared) -> CalibrationStack:
    """The stack with the lengths and the biases of its prisms changed."""
    acquisition, biases = stack.config.acquisition, iter(parts.biases)
    prisms = [
        prism if prism is None else replace(_stretched(prism, math.exp(parts.length)), bias=next(biases))
        for prism in acquisition.prisms
    ]
    return stack.with_config(replace(stack.config, acquisition=replace(acquisition, prisms=prisms)))


def _stretched(prism: Prism, factor: float) -> Prism:
    return rounded_shear(replace(prism, shear=tuple(number(s) * factor for s in prism.shear)))


def _images(stack: CalibrationStack) -> tuple[CalibrationStack, list[FoundQuantity]]:
    """Brightness and drift of each image; drift that shows is to be learned by the reconstruction."""
    config, beside = stack.config, stack.beside(PLANES)
    values, deviations = find_images(beside)
    planes = ", ".join(map(str, beside.part.planes))
    how = f"beside a fitted volume, of planes {planes} (from 0)"
    lit, drift = values["brightness"], values["drift"]
    found = [
        FoundQuantity(
            "brightness", "", None, plain(lit, 5), plain(deviations["brightness"] * lit, 2), f"{how}; always learned"
        )
    ]
    shows = bool((drift.abs() > SHOWS * deviations["drift"]).any())
    learn = config.reconstruction.learn
    if shows and "drift" not in learn:
        how += "; it shows, so that the reconstruction learns it"
        config = replace(config, reconstruction=replace(config.reconstruction, learn=(*learn, "drift")))
    if not shows:
        how += f"; none is {SHOWS:g} standard deviations from 0: no drift shows"
    found.append(FoundQuantity("drift", "µm", None, plain(drift, 3), plain(deviations["drift"], 2), how))
    return stack.with_config(config), found


def _of_part(stack: CalibrationStack, beside: Beside) -> Acquisition:
    acquisition = stack.config.acquisition
    return replace(acquisition, focus=[acquisition.focus[plane] for plane in beside.part.planes])


def _tried(found: list[Least]) -> int:
    return sum(len(least.tried) for least in found)


def _misfits(found: list[Least], beside: Beside) -> str:
    """The misfit as found, after the last value, and as told, before the first."""
    told, lowest = found[0].told, min(misfit for _, misfit in found[-1].tried)
    if beside.alone == 0:
        return f"misfit {lowest:.4g}, {told:.4g} as told"
    return f"misfit {lowest / beside.alone:.3f} × the noise's, {told / beside.alone:.3f} as told"


def _hidden(found: list[Least], beside: Beside) -> str:
    """Why a value isn't told: the misfits, and what they have absorbed of the noise."""
    absorbed = max(least.absorbed for least in found)
    hides = f"; they absorb {absorbed:.1%} of the noise, which may be why" if absorbed > 0 else ""
    return f" ({_misfits(found, beside)}{hides})"
