"""How carefully to compute, and nothing else."""

import dataclasses
import math

import pytest

from torchdic import DRAFT, REFERENCE, STANDARD, Fidelity


def test_every_field_but_propagation_has_a_default():
    for field in dataclasses.fields(Fidelity):
        assert field.name == "propagation" or field.default is not dataclasses.MISSING
    for propagation in ("projection", "rays", "wave"):
        assert Fidelity(propagation).propagation == propagation
        assert Fidelity(propagation=propagation).steps is None


def test_presets_are_ordered_by_care():
    assert DRAFT.sources < STANDARD.sources < REFERENCE.sources
    assert Fidelity("wave") == STANDARD
    assert len({DRAFT, STANDARD, REFERENCE}) == 3


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"steps": 0}, "steps 0 must be a whole number of at least 1"),
        ({"sources": 0}, "sources 0 must be a whole number of at least 1"),
        ({"padding": -1}, "padding -1 must be a whole number of at least 0"),
        ({"tolerance": 0.0}, r"tolerance 0\.0 must be above 0, and finite"),
        ({"tolerance": math.nan}, "tolerance nan must be above 0"),
        ({"tolerance": math.inf}, "tolerance inf must be above 0, and finite"),
        ({"reference_plane": math.nan}, "reference_plane nan must be a finite depth"),
        ({"object_aberration": "linear"}, "object_aberration 'linear' has no use in propagation \"wave\""),
        ({"memory": 0}, "memory 0 must be above 0"),
    ],
)
def test_errors_state_the_number_and_the_law(options, message):
    with pytest.raises(ValueError, match=message):
        Fidelity("wave", **options)


@pytest.mark.parametrize("method", ["linear", "cone"])
def test_object_aberration_and_the_rays_amplitude_exclude_each_other(method):
    with pytest.raises(ValueError, match=rf"object_aberration '{method}' double-counts .* amplitude must be false"):
        Fidelity("rays", object_aberration=method)
    assert Fidelity("rays", amplitude=False, object_aberration=method).object_aberration == method
    # straight rays have no amplitude, whatever the default says of bent ones
    assert Fidelity("projection", object_aberration=method).amplitude


def test_fidelity_cannot_be_changed_in_place():
    with pytest.raises(dataclasses.FrozenInstanceError):
        STANDARD.steps = 3  # pyright: ignore[reportAttributeAccessIssue]
