"""Biases from how bright the empty background is behind each prism setting."""

import math
from dataclasses import replace

from recon.calibration.levels import UNSURE, biases_of_levels
from recon.run.calibration.found import FoundQuantity, rounded, rounded_angle
from recon.run.calibration.stack import CalibrationStack
from torchdic.scalar import number

# What a background's level is uncertain by, relative to it, at the least: the surface that is fitted to it.
LEAST = 3e-3


def by_levels(stack: CalibrationStack) -> tuple[CalibrationStack, list[FoundQuantity]]:
    """The stack with the biases that its levels tell, and what they tell; nothing without one exposure for all."""
    config, reports = stack.config, stack.measured.prisms
    prisms = config.acquisition.prisms
    if not config.calibration.one_exposure or len(prisms) < 2 or min(report.background for report in reports) <= 0:
        return stack, []
    declared = [None if prism is None else number(prism.bias) for prism in prisms]
    planes = len(config.acquisition.focus)
    relative = [math.hypot(LEAST, (report.flicker or 0.0) / math.sqrt(planes)) for report in reports]
    found = biases_of_levels(declared, [report.background for report in reports], relative)
    of = "of the empty field" if config.data is not None and config.data.empty is not None else "of backgrounds"
    how = f"{len(prisms)} levels {of}, recorded with one exposure"
    before = [bias for bias in declared if bias is not None]
    if all(told for told, bias in zip(found.told, declared, strict=True) if bias is not None):
        biases = found.biases
        values = [rounded(bias, 5) for bias in biases if bias is not None]
        sure = [rounded(deviation, 2) for deviation in found.deviations if deviation is not None]
        quantity = FoundQuantity("bias", "rad", before, values, sure, how)
    elif found.zero_deviation < UNSURE:
        biases = tuple(None if bias is None else bias + found.zero for bias in declared)
        how += "; it is added to each bias, whose size stays as told: these settings tell the zero alone"
        zero, deviation = rounded(found.zero, 4), rounded(found.zero_deviation, 2)
        quantity = FoundQuantity("compensator's zero", "rad", 0.0, zero, deviation, how)
    else:
        return stack, []
    changed = [
        prism if prism is None or bias is None else replace(prism, bias=rounded_angle(bias))
        for prism, bias in zip(prisms, biases, strict=True)
    ]
    calibrated = replace(config, acquisition=replace(config.acquisition, prisms=changed))
    return stack.with_config(calibrated), [quantity]
