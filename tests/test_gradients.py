"""Autograd against central differences, and a graph only where the caller's tensors carry one."""

import math

import pytest
import torch
from torch import nn

from torchdic import Acquisition, Condenser, Fidelity, Grid, Microscope, Objective, Prism, Volume, image, image_field

GRID = Grid((3, 8, 9), (0.6, 0.22, 0.2))
POINTS = torch.tensor([[0.0, 0.0], [0.31, -0.12], [-0.17, 0.24], [0.05, 0.38]], dtype=torch.float64)
NOLL = (4, 5, 6, 7, 8)
FIDELITIES = {
    "projection": Fidelity("projection"),
    "projection-cubic-recomputed": Fidelity("projection", interpolation="cubic", steps=4, memory=1),
    "rays": Fidelity("rays"),
    "rays-cubic-recomputed": Fidelity("rays", interpolation="cubic", memory=1),
    "rays-fewer-steps": Fidelity("rays", steps=2, padding=1),
    "wave": Fidelity("wave"),
    "wave-first-order": Fidelity("wave", order=1),
    "wave-recomputed": Fidelity("wave", steps=5, memory=1),
}
PARAMETERS = ("delta", "absorption", "background", "shear", "bias", "focus", "aberrations")
# what crosses the specimen; the further parameters act on the field, whatever brought it
CROSSING = ("delta", "absorption", "background")
# test_laws compares the recomputed with the kept one, and the rays of test_ray_solver are cubic
DEAR = ("projection-cubic-recomputed", "rays-cubic-recomputed")
PROPAGATIONS = ("projection", "rays", "wave")


def scalar(value):
    return torch.tensor(value, dtype=torch.float64)


@pytest.fixture
def point(smooth_field):
    """A value of every parameter, none of them 0."""
    return {
        "delta": smooth_field(GRID, 0.04) + 0.01,
        "absorption": 0.004 + 0.002 * torch.rand(GRID.shape, dtype=torch.float64),
        "background": scalar(1.37),
        "shear": scalar([0.07, -0.19]),
        "bias": scalar(0.8),
        "focus": scalar([-0.7, 0.4]),
        "aberrations": scalar([0.11, -0.07, 0.05, 0.13, -0.09]),
    }


def compute(values, fidelity):
    """A weighted sum of the images, so that every pixel matters and none cancels another."""
    volume = Volume(GRID, values["delta"], values["background"], values["absorption"])
    objective = Objective(0.8, dict(zip(NOLL, values["aberrations"], strict=True)))
    microscope = Microscope(0.546, objective, Condenser(0.4, points=POINTS))
    prisms = [Prism(values["shear"], values["bias"]), None, Prism((values["shear"][1], 0.1), 0.3)]
    images = image(volume, microscope, Acquisition(prisms, list(values["focus"])), fidelity)
    random = torch.Generator().manual_seed(1)
    return (images * torch.rand(images.shape, generator=random, dtype=images.dtype)).sum()


def directional(function, values, name, direction, step):
    """Fourth-order central difference: its own error is step⁴, far below 1e-6."""

    def at(t):
        return float(function({**values, name: values[name] + t * step * direction}))

    return (8 * (at(1) - at(-1)) - (at(2) - at(-2))) / (12 * step)


def along(gradient):
    """A random direction in which no component cancels another, so that rounding stays below 1e-6."""
    return torch.randn_like(gradient).abs() * torch.where(gradient < 0, -1.0, 1.0)


def step(name, fidelity):
    # Rays see a field that is smooth only piece by piece (between voxel centres, and between the vertices of
    # the mesh in which they land): with a small step of Δn hardly any ray goes from one piece to the next.
    return {"delta": 1e-7 if fidelity.propagation == "rays" else 1e-5, "background": 1e-5}.get(name, 1e-4)


@pytest.mark.parametrize(
    ("name", "fidelity"),
    [
        pytest.param(
            name,
            fidelity,
            id=f"{name}-{way}",
            marks=()
            if (way in PROPAGATIONS and (way != "rays" or name in CROSSING)) or (name == "delta" and way not in DEAR)
            else pytest.mark.slow,
        )
        for name in PARAMETERS
        for way, fidelity in FIDELITIES.items()
    ],
)
def test_gradient_is_the_central_difference(point, fidelity, name):
    value = point[name].clone().requires_grad_()
    (gradient,) = torch.autograd.grad(compute({**point, name: value}, fidelity), value)
    direction = along(gradient)
    expected = directional(lambda v: compute(v, fidelity), point, name, direction, step(name, fidelity))
    assert abs(expected) > 1e-4
    assert float((gradient * direction).sum()) == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("fidelity", [FIDELITIES["rays"], FIDELITIES["wave"]], ids=["rays", "wave"])
def test_gradient_reaches_every_voxel(point, fidelity):
    value = point["delta"].clone().requires_grad_()
    (gradient,) = torch.autograd.grad(compute({**point, "delta": value}, fidelity), value)
    assert bool((gradient != 0).all())


@pytest.mark.parametrize(
    ("propagation", "name", "bias"),
    [
        pytest.param(
            propagation,
            name,
            0.0 if name == "bias" else 0.8,
            id=f"{propagation}-{name}-{0.0 if name == 'bias' else 0.8}",
            marks=pytest.mark.slow if propagation == "rays" and name not in CROSSING else (),
        )
        for propagation in PROPAGATIONS
        for name in ("shear", "bias", "focus", "aberrations", "delta", "absorption")
    ],
)
def test_parameter_that_is_zero_keeps_its_gradient(point, propagation, name, bias):
    """Zero is a value, not an absence: the gradient at 0 is the central difference and not 0."""
    values = {**point, "bias": scalar(bias)}
    if name == "delta":
        # all rays land on pixels: ∫κ ds, linear in each triangle of the mesh, must not have a kink there
        values["absorption"] = torch.full_like(point["absorption"], 0.004)
    if name != "bias":
        values[name] = torch.zeros_like(point[name])
    value = values[name].clone().requires_grad_()
    fidelity = Fidelity(propagation)
    (gradient,) = torch.autograd.grad(compute({**values, name: value}, fidelity), value)
    direction = along(gradient)
    if name == "absorption":
        # κ < 0 is refused: a one-sided difference, of fourth order too
        def at(t):
            return float(compute({**values, name: value.detach() + t * 1e-5 * direction.abs()}, fidelity))

        expected, direction = (
            (48 * at(1) - 36 * at(2) + 16 * at(3) - 3 * at(4) - 25 * at(0)) / 12e-5,
            direction.abs(),
        )
    else:
        expected = directional(lambda v: compute(v, fidelity), values, name, direction, step(name, fidelity))
    assert abs(expected) > 1e-4
    assert float((gradient * direction).sum()) == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("propagation", ["projection", pytest.param("rays", marks=pytest.mark.slow), "wave"])
def test_result_carries_a_graph_only_where_a_tensor_of_the_caller_does(point, propagation):
    assert not compute(point, Fidelity(propagation)).requires_grad
    for name in PARAMETERS:
        values = {**point, name: point[name].clone().requires_grad_()}
        assert compute(values, Fidelity(propagation)).requires_grad, name
        with torch.no_grad():
            assert not compute(values, Fidelity(propagation)).requires_grad


def test_parameter_is_learned_and_a_constant_is_not(point):
    volume = Volume(GRID, nn.Parameter(point["delta"]), 1.37, point["absorption"])
    assert [name for name, _ in volume.named_parameters()] == ["delta"]
    assert {name for name, _ in volume.named_buffers()} == {"background", "absorption"}
    volume = Volume(GRID, point["delta"], nn.Parameter(scalar(1.37)))
    assert [name for name, _ in volume.named_parameters()] == ["background"]


@pytest.mark.parametrize("propagation", ["projection", pytest.param("rays", marks=pytest.mark.slow), "wave"])
def test_tensor_keeps_its_graph(point, propagation):
    """delta = f(θ): the chain rule goes through the volume to θ."""
    theta = scalar(0.3).requires_grad_()

    def of(theta):
        return compute({**point, "delta": point["delta"] * torch.sin(theta)}, Fidelity(propagation))

    (gradient,) = torch.autograd.grad(of(theta), theta)
    step = 1e-5
    with torch.no_grad():
        expected = (8 * (of(theta + step) - of(theta - step)) - (of(theta + 2 * step) - of(theta - 2 * step))) / (
            12 * step
        )
    assert float(gradient) == pytest.approx(float(expected), rel=1e-6)


def test_float32_parameter_of_a_float64_volume_keeps_its_graph(point, propagation):
    shear = torch.tensor([0.07, -0.19], requires_grad=True)
    result = compute({**point, "shear": shear}, Fidelity(propagation))
    assert result.dtype == torch.float64
    (gradient,) = torch.autograd.grad(result, shear)
    double = point["shear"].float().double().requires_grad_()
    (expected,) = torch.autograd.grad(compute({**point, "shear": double}, Fidelity(propagation)), double)
    assert gradient.dtype == torch.float32
    torch.testing.assert_close(gradient.double(), expected, rtol=2 * torch.finfo(torch.float32).eps, atol=0)


@pytest.mark.parametrize("memory", [1, 1 << 30])
@pytest.mark.parametrize("sources", [(), (len(POINTS),)], ids=["one-for-all", "one-per-source"])
def test_gradient_of_a_thin_transmission_is_the_central_difference(memory, sources):
    transmission = torch.randn(*sources, *GRID.shape[1:], dtype=torch.complex128)
    microscope = Microscope(0.546, Objective(0.8), Condenser(0.4, points=POINTS))
    acquisition = Acquisition([Prism((0.1, 0.2), 0.7), None], [0.3, -0.5])

    def of(transmission):
        fidelity = Fidelity(memory=memory)
        images = image_field(transmission, GRID, microscope, acquisition, background=1.36, fidelity=fidelity)
        return (images * torch.arange(images.numel()).reshape(images.shape)).sum() / images.numel()

    value = transmission.clone().requires_grad_()
    assert not of(transmission).requires_grad
    (gradient,) = torch.autograd.grad(of(value), value)
    direction = torch.randn_like(transmission)
    step = 1e-4
    # quadratic in the transmission: the central difference is exact but for rounding
    expected = float(of(transmission + step * direction) - of(transmission - step * direction)) / (2 * step)
    assert float((gradient.conj() * direction).real.sum()) == pytest.approx(expected, rel=1e-8)


def test_gradient_of_real_transmission_is_real():
    transmission = torch.rand(GRID.shape[1:], dtype=torch.float64, requires_grad=True)
    microscope = Microscope(0.546, Objective(0.8))
    images = image_field(transmission, GRID, microscope, Acquisition(), background=1.36)
    (gradient,) = torch.autograd.grad(images.sum(), transmission)
    assert gradient.dtype == torch.float64
    assert math.isfinite(float(gradient.norm()))
    assert float(gradient.norm()) > 0
