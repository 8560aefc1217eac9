"""The effects of a scene: what the image would err by if each were left out, and how much work that would save.

EFFECTS is the whole list, in the order of the table that users see. A new effect is a new entry.
"""

from dataclasses import dataclass

from torchdic.planning.worth import (
    Measure,
    PlannedScene,
    camera_pixels,
    left_out,
    object_aberration,
    paraxial_defocus,
    ray_step,
    sides,
    single_slab,
    sources,
    straight_rays,
)


@dataclass(frozen=True)
class Effect:
    """An effect, such as diffraction or absorption, and what it is worth in a scene.

    name: of the effect.
    needed: whether the images would miss the tolerance if this effect alone were left out.
    error: of the images without it, see `torchdic.planning.image_error`; estimated.
    cost: the part of the image's work, 0 to 1, that leaving it out would save.
    basis: where the error comes from: "pilot", a small image computed with and without the effect; "bound", the error
        is at most this; "absent", the scene doesn't have the effect.
    note: what was compared, or why there is only a bound.
    """

    name: str
    needed: bool
    error: float
    cost: float
    basis: str
    note: str = ""


# Each effect by its name, with the function that finds its worth. A function that returns None leaves the effect out of
# the table: a single colour is so usual that "spectrum" has no row there.
EFFECTS: dict[str, Measure] = {
    "bending": straight_rays,
    "amplitude": ray_step(lambda rays: rays.carried - rays.bent, "rays with and without it"),
    "diffraction": ray_step(lambda rays: rays.wave - rays.carried, "the wave against rays"),
    "object aberration": object_aberration,
    "partial coherence": sources,
    "steps": single_slab,
    "defocus": paraxial_defocus,
    "sides": sides,
    "polarisation": left_out(
        lambda scene: scene.microscope.polarisation is not None,
        lambda scene, planned: scene.changed(polarisation=None),
    ),
    "absorption": left_out(
        lambda scene: scene.volume.absorption is not None,
        lambda scene, planned: scene.transparent(),
    ),
    "spectrum": left_out(
        lambda scene: scene.microscope.spectrum is not None,
        # a pilot's own wavelength differs from the one that the microscope names
        lambda scene, planned: scene.changed(spectrum=None, wavelength=planned.scene.microscope.wavelength),
        otherwise=None,
    ),
    "camera": camera_pixels,
}


def effects(planned: PlannedScene) -> tuple[Effect, ...]:
    """Every effect's worth in a scene that is computed with the planned fidelity."""
    found = []
    for name, measure in EFFECTS.items():
        worth = measure(planned)
        if worth is not None:
            needed = worth.error > planned.tolerance if worth.needed is None else worth.needed
            found.append(Effect(name, needed, worth.error, worth.cost, worth.basis, worth.note))
    return tuple(found)
