"""Which fits are tried: methods × propagations × directions × planes, without the combinations that make no sense."""

from dataclasses import replace
from itertools import product

from recon.config.schema import Config, ConfigError
from recon.fit.problem import DIRECT, DRAFT_SOURCES, STEPS
from recon.report.fit_trial import FitCandidate
from recon.run.reconstruct import RECOMMENDED, RECOMMENDED_FOR_ADAM
from torchdic import Fidelity
from torchdic.planning.comparisons import TRUTH
from torchdic.propagation.base import propagations

# Condenser directions of Adam's fits by propagations other than the wave, and the steps that gain them something: most
# of what straight and bent rays can't explain stays.
FEW_DIRECTIONS = {"rays": 16}
FEW_STEPS = {"rays": 40, "projection": 60}


def fits_of(config: Config) -> list[FitCandidate]:
    """The fits that a configuration's [work_precision] asks for.

    On rays Newton's steps err more than Adam's, so newton is tried by the wave alone. `linear` and `opl` have no
    propagation and no directions of their own. Raises ConfigError for more planes than the stack has, and where nothing
    is left.
    """
    section, stack = config.work_precision, len(config.acquisition.focus)
    methods = section.methods or (*STEPS, *DIRECT)
    named = section.propagations or tuple(propagation.name for propagation in propagations())
    planes = section.planes or tuple(dict.fromkeys((stack, (stack + 1) // 2, (stack + 3) // 4)))
    for number in planes:
        if number > stack:
            raise ConfigError(f"work_precision.planes: {number} exceeds the stack's {stack}")
    found: list[FitCandidate] = []
    for method, number in product(methods, planes):
        if method in DIRECT:
            found.append(FitCandidate(method, None, None, number))
            continue
        for propagation in named:
            if method == "newton" and propagation != TRUTH:
                continue
            given = section.directions or _directions(_usual(config, method, propagation), method)
            found += [FitCandidate(method, propagation, directions, number) for directions in given]
    if not found:
        raise ConfigError(
            f"work_precision: {', '.join(methods)} can't fit by {', '.join(named)}: newton is tried by the wave"
        )
    return list(dict.fromkeys(found))


def planes_of(number: int, stack: int) -> list[int]:
    """Which planes of a stack are fitted, from 0: evenly spaced over all of it, the middle one if it is one."""
    if number == 1:
        return [stack // 2]
    return [round(i * (stack - 1) / (number - 1)) for i in range(number)]


def configured(config: Config, candidate: FitCandidate) -> Config:
    """The configuration of one fit: its method, its fidelity and its planes.

    [reconstruction] counts for all; its steps, for its own method alone. [fidelity] counts for its own propagation.
    """
    section, propagation = config.reconstruction, candidate.propagation
    steps = section.steps if candidate.method == section.method else None
    if steps is None and candidate.method == "adam":
        steps = FEW_STEPS.get(propagation or "")
    recipe = replace(section, method=candidate.method, steps=steps, tiles=None)
    fidelity = RECOMMENDED
    if propagation is not None:
        fidelity = _usual(config, candidate.method, propagation)
        fidelity = replace(fidelity, sources=candidate.directions or fidelity.sources)
    focus = config.acquisition.focus
    acquisition = replace(config.acquisition, focus=[focus[i] for i in planes_of(candidate.planes, len(focus))])
    return replace(config, reconstruction=recipe, fidelity=fidelity, tolerance=None, acquisition=acquisition)


def _directions(fidelity: Fidelity, method: str) -> tuple[int, ...]:
    """A fidelity's directions; of Newton's method also those of its draft images, which are then not corrected."""
    draft = DRAFT_SOURCES[method]
    return (draft, fidelity.sources) if method == "newton" and draft < fidelity.sources else (fidelity.sources,)


def _usual(config: Config, method: str, propagation: str) -> Fidelity:
    """The configuration's own fidelity where it has this propagation, else the recommended one."""
    if config.fidelity is not None and config.fidelity.propagation == propagation:
        return config.fidelity
    if propagation == TRUTH:
        return RECOMMENDED_FOR_ADAM if method == "adam" else RECOMMENDED
    sources = FEW_DIRECTIONS.get(propagation, RECOMMENDED_FOR_ADAM.sources)
    return Fidelity(propagation, max(1, config.volume.shape[0] // 2), sources)  # bent rays take a step for two slices
