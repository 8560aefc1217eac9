"""What imaging holds, in fitted numbers."""

import math

from torchdic.grid import Grid
from torchdic.imaging.passband import sizes
from torchdic.instrument.microscope import Acquisition, Microscope
from torchdic.memory.batches import Demand

# Values per source and pixel that autograd keeps of a pupil of Jones matrices, all of whose terms are learned.
KEPT_BY_MATRIX = 50


def demand_of_imaging(
    grid: Grid, microscope: Microscope, acquisition: Acquisition, components: int = 1, *, learned: bool = False
) -> Demand:
    """What `Imaging` holds; measured by `python benchmarks/memory.py`.

    components: of the spectrum. learned: whether the microscope or acquisition is, and not the specimen alone.
    """
    focus, prisms, polarisation = len(acquisition.focus), acquisition.prisms, microscope.polarisation
    objective, images = microscope.objective, len(acquisition.focus) * len(acquisition.prisms)
    wavelength = min(part.wavelength for part, _ in microscope.colours())
    found = None if objective is None else sizes(grid, wavelength, objective.na)
    # of the array's pixels, the parts that are waves of a window and pixels of a field
    window, field = (math.prod(shape) / math.prod(grid.shape[1:]) for shape in found) if found else (1.0, 1.0)
    # a window's frequencies and their indices are each source's own, the whole array's are common to all
    indexed, shared = (2.25, 0) if found else (0, 3 + 2 * len(prisms))
    # images of a coarser array are brought to the grid's pixels at last
    last = 4 * images if field < 1 else 0
    lens = 0
    if objective is not None:
        lens = 2 * bool(objective.aberrations or objective.layer or objective.apodisation)
    if microscope.lenses is not None:
        assert polarisation is not None
        pupil = microscope.lenses
        states = [4 if prism is None else polarisation.states for prism in prisms]
        transfers = 2 * components * sum(states)
        factors = bool(pupil.retardance) + bool(pupil.diattenuation) + (pupil.depolarisation and components == 1)
        beams = max((polarisation.states for prism in prisms if prism is not None), default=0)
        making = max(46 if factors > 1 else 31, 29 + transfers + 6 * beams) + 2 * indexed
        matrix = KEPT_BY_MATRIX + 2 * focus if learned else 0
        return Demand(
            max(making * window, (14 + transfers) * window + 6.5 * max(states) * field),
            (2 * focus + transfers + lens + matrix + indexed) * window + 2 * focus * sum(states) * field,
            max(7 * max(states) * field + 25 * learned * window, 2 * components),
            shared=shared,
            once=last,
        )
    leaks = microscope.polarisers is not None
    own = len(prisms) if found or not microscope.condenser_prism else 0
    kept = (2 * focus + lens + own + indexed) * window + (6 if leaks else 2) * images * field
    if found and leaks:
        kept += images * window
    if learned:
        terms = 0 if objective is None else len(objective.aberrations or {})
        kept += (2 * focus + 4 + terms + own) * window
    if found:
        alone = (14 + len(prisms) + lens) * window + (10 if leaks else 6 if images > 1 else 4) * field
        return Demand(alone, kept, max((10 if leaks else 8) * field, 2 * components), once=last)
    alone = 12 + lens + (2 if images > 1 else 0) + (1 + 2 * own if own else 0) + (7 if leaks else 0)
    return Demand(alone, kept, 13 if leaks else 10, shared=shared)
