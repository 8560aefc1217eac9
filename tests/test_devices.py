"""The same code wherever the tensors are: nothing is left on the CPU, and hardly anything waits for the device."""

from collections import Counter
from dataclasses import replace
from functools import cache

import pytest
import torch
from distant import DISTANT, Device, bring, send

from recon.fit.descent import descend
from recon.fit.problem import Recipe
from torchdic import (
    Acquisition,
    Camera,
    Condenser,
    Fidelity,
    Grid,
    JonesPupil,
    Layer,
    Microscope,
    Objective,
    Polarisation,
    Prism,
    Spectrum,
    Volume,
    image,
    image_field,
    plan,
)

GRID = Grid((6, 11, 14), (0.4, 0.2, 0.21))
# so small an array holds no light for long
pytestmark = pytest.mark.filterwarnings("ignore::torchdic.errors.WrapAroundWarning")
SCOPE = Microscope(0.546, Objective(0.75), Condenser(0.4))
FIDELITY = Fidelity(sources=3)


def learned(value):
    return torch.tensor(value, dtype=torch.float64, requires_grad=True)


@pytest.fixture
def values(smooth_field):
    """All that a scene may learn, by name."""
    named = {
        "delta": smooth_field(GRID, 0.02),
        "absorption": 0.004 + 0.002 * torch.rand(GRID.shape, dtype=torch.float64),
        **{name: learned(v) for name, v in {"n0": 1.37, "y": 0.07, "x": -0.19, "bias": 0.8, "focus": 0.6}.items()},
        **{name: learned(v) for name, v in {"tilt": 0.2, "coma": 0.1, "leak": 0.01, "layer": 3.0}.items()},
    }
    return {name: value.requires_grad_() for name, value in named.items()}


def scope(**parts):
    return lambda v: replace(SCOPE, **{k: part(v) if callable(part) else part for k, part in parts.items()})


SCOPES = {
    "plain": scope(),
    "no objective": scope(objective=None),
    "lens": scope(objective=lambda v: Objective(0.75, {4: v["tilt"], 7: v["coma"]}, "aplanatic")),
    "layer": scope(objective=lambda v: Objective(0.75, layer=Layer(v["layer"], 1.52, 1.5))),
    "ring of light": scope(condenser=Condenser(0.4, inner_na=0.3)),
    "no condenser prism": scope(condenser_prism=False),
    "colours": scope(spectrum=Spectrum((0.5, 0.58), (1.0, 2.0))),
    "polarisers that leak": scope(
        polarisation=lambda v: Polarisation(v["leak"], v["leak"] / 2, v["leak"] * 2, v["leak"] * 3)
    ),
    "lenses of matrices": scope(
        polarisation=lambda v: Polarisation(
            v["leak"], pupil=JonesPupil({5: (v["tilt"], 0.1)}, {6: (v["leak"], 0.0)}, depolarisation=True)
        )
    ),
    "camera": scope(camera=Camera(pixel_size=0.4)),
}
FIDELITIES = {
    "projection": {},
    "rays": {},
    "wave": {},
    "projection, cubic": {"interpolation": "cubic"},
    "rays, cubic, padded": {"interpolation": "cubic", "padding": 2},
    "rays, adaptive": {"solver": "dopri5"},
    "rays, recomputed": {"memory": 1},
    "wave, first order, recomputed": {"order": 1, "memory": 1},
    "wave, paraxial, cut": {"defocus": "paraxial", "band_limit": True},
    "projection, linear object_aberration": {"object_aberration": "linear"},
    "projection, object_aberration of a cone": {"object_aberration": "cone"},
}
# each of these has a like among the others
DEAR = (
    "rays, adaptive",
    "rays, cubic, padded",
    "rays, recomputed",
    "wave, first order, recomputed",
    "projection, object_aberration of a cone",
)


def images(values, microscope, fidelity):
    volume = Volume(GRID, values["delta"], values["n0"], values["absorption"])
    prisms = [Prism((values["y"], values["x"]), values["bias"]), None, Prism((0.1, 0.2), 0.3)]
    return image(volume, microscope(values), Acquisition(prisms, [values["focus"], -0.4]), fidelity)


def result(values, microscope, fidelity):
    """The images, and the gradients of a sum of them in all that is learned."""
    found = images(values, microscope, fidelity)
    found.pow(3).sum().backward()
    return {"images": found, **{name: v.grad for name, v in values.items() if v.grad is not None}}


def as_here(values, microscope, fidelity):
    here = result(values, microscope, fidelity)
    there = {name: send(value) for name, value in values.items()}
    with Device():
        found = result(there, microscope, fidelity)
    assert found.keys() == here.keys()
    for name, value in found.items():
        assert value.device == DISTANT
        torch.testing.assert_close(bring(value), here[name].detach(), rtol=1e-9, atol=1e-12)


# what rays bring to the microscope: their phase, and their polarisation
OF_RAYS = ("plain", "lenses of matrices")


@pytest.mark.parametrize(
    ("propagation", "name"),
    [
        pytest.param(propagation, name, marks=pytest.mark.slow if propagation != "wave" and name not in OF_RAYS else ())
        for propagation in ("projection", "rays", "wave")
        for name in SCOPES
    ],
)
def test_every_microscope_images_there_as_here(values, name, propagation):
    as_here(values, SCOPES[name], replace(FIDELITY, propagation=propagation))


@pytest.mark.parametrize("name", [pytest.param(n, marks=pytest.mark.slow if n in DEAR else ()) for n in FIDELITIES])
def test_every_fidelity_images_there_as_here(values, name):
    as_here(values, SCOPES["plain"], replace(FIDELITY, propagation=name.split(",")[0], **FIDELITIES[name]))


def test_thin_object_images_there_as_here():
    thin = torch.polar(torch.ones(11, 14), 0.1 * torch.rand(11, 14)).to(torch.complex128)
    settings = GRID, SCOPE, Acquisition([Prism((0.1, 0.2), 0.3)], [0.5])
    here = image_field(thin, *settings, background=1.33, fidelity=FIDELITY)
    with Device():
        there = image_field(send(thin), *settings, background=1.33, fidelity=FIDELITY)
    torch.testing.assert_close(bring(there), here)


@pytest.mark.parametrize(
    "recipe",
    [Recipe(steps=5), pytest.param(Recipe(steps=10), marks=pytest.mark.slow), Recipe("adam", 2)],
    ids=["newton", "newton to its end", "adam"],
)
def test_descent_goes_there_as_here(values, recipe):
    data = images(values, SCOPES["plain"], FIDELITY).detach()
    settings = [Prism((0.07, -0.19), 0.8), None, Prism((0.1, 0.2), 0.3)]
    scene = GRID, 1.37, SCOPE, Acquisition(settings, [0.6, -0.4]), FIDELITY, recipe
    *_, here = descend(data, *scene)
    with Device():
        *_, there = descend(send(data), *scene)
    torch.testing.assert_close(bring(there.delta), here.delta, rtol=1e-6, atol=1e-9)


def test_plan_is_made_there(values):
    settings = Acquisition([Prism((0.1, 0.2), 0.3)], [0.0, 0.4])
    with Device():
        made = plan(Volume(GRID, send(values["delta"].detach()), 1.37), SCOPE, settings, 0.05)
    assert made.error <= 0.05


@cache
def waits(propagation, slices=6, sources=6, planes=2, prisms=2):
    """How often the CPU waits for the device while an image and its gradient are made."""
    grid = Grid((slices, 11, 14), (0.4, 0.2, 0.21))
    delta = send((0.01 * torch.rand(grid.shape, dtype=torch.float64)).requires_grad_())
    settings = [Prism((0.1, 0.2), 0.3 + i) for i in range(prisms)]
    with Device() as device:
        scene = Volume(grid, delta, 1.36), SCOPE, Acquisition(settings, [0.2 * i for i in range(planes)])
        image(*scene, Fidelity(propagation, sources=sources)).square().sum().backward()
    return device.waits


@pytest.mark.parametrize("more", [{"slices": 12}, {"sources": 12}, {"planes": 4}, {"prisms": 4}], ids=str)
@pytest.mark.parametrize("way", ["projection", "wave"])
def test_no_wait_depends_on_how_much_is_computed(way, more):
    assert waits(way, **more) == waits(way)
    assert waits(way).total() <= 12


def test_rays_wait_once_a_step_for_torchdiffeq_and_twice_a_source_for_what_their_mesh_holds():
    few = waits("rays")
    assert waits("rays", planes=4) == few
    assert waits("rays", prisms=4) == few
    assert waits("rays", slices=12) - few == Counter({"_local_scalar_dense in solver._odeint": 6})
    more = waits("rays", sources=12) - few
    assert more == Counter({"repeat_interleave in mesh._covered_by_one": 6, "nonzero in mesh._covered_by_one": 6})
    assert few.total() <= 12 + 6 + 2 * 6 + 16


def test_devices_do_not_mix():
    with Device(), pytest.raises(RuntimeError, match=r"mul: tensors on two devices: \(2,\) on meta, \(2,\) on cpu"):
        send(torch.ones(2)) * torch.ones(2)


@pytest.mark.parametrize(
    "wait",
    [
        lambda v: float(v.sum()),
        lambda v: v[v > 0],
        lambda v: v.tolist(),
        lambda v: v.to("cpu"),
        lambda v: v.new_tensor([1.0]),
        lambda v: torch.tensor(1.0, device=v.device),
        lambda v: torch.repeat_interleave(v.long()),
        lambda v: bool((v > 0).any()),
    ],
)
def test_every_wait_is_counted(wait):
    value = send(torch.ones(3))
    with Device() as device:
        value.sum() * 2 + 1.5
        assert device.waits.total() == 0
        wait(value)
    assert device.waits.total() == 1
