"""Polarised light: Jones's 2×2 algebra.

Fields vary as exp(+ikz), so light along a slow axis, whose optical path is longer, gains phase: a retarder of
retardance Γ multiplies the component along its slow axis by exp(+iΓ/2) and the other by exp(−iΓ/2). Angles in rad are
counted from axis 1 towards axis 2; the Nomarski prism's beam 1 is polarised along axis 1 and beam 2 along axis 2.
Angles and retardances are numbers, which give float64, or tensors of any batch shape, which keep their dtype, device
and graph.

R. C. Jones, J. Opt. Soc. Am. 31, 488 (1941); E. Wolf, Nuovo Cimento 13, 1165 (1959) for the coherency matrix.
"""

import math
from functools import reduce

import torch
from jaxtyping import Complex, Float, Inexact
from torch import Tensor


def linear(angle: float | Tensor) -> Float[Tensor, "*batch 2"]:
    """The Jones vector of unit light polarised linearly at an angle: (cos, sin), real."""
    angle = _real(angle)
    return torch.stack((angle.cos(), angle.sin()), -1)


def rotation(angle: float | Tensor) -> Float[Tensor, "*batch 2 2"]:
    """A rotation of the plane of polarisation by an angle, axis 1 towards axis 2; real."""
    cos, sin = linear(angle).unbind(-1)
    return torch.stack((cos, -sin, sin, cos), -1).unflatten(-1, (2, 2))


def polariser(angle: float | Tensor) -> Float[Tensor, "*batch 2 2"]:
    """An ideal polariser or analyser: the projection on light polarised at an angle; real."""
    axis = linear(angle)
    return axis[..., :, None] * axis[..., None, :]


def retarder(retardance: float | Tensor, angle: float | Tensor) -> Complex[Tensor, "*batch 2 2"]:
    """A lossless plate of retardance Γ in rad with its slow axis at an angle; complex and unitary.

    R(angle)·diag(e^{iΓ/2}, e^{−iΓ/2})·R(−angle) = cos(Γ/2) + i·sin(Γ/2)·(2P − 1), P the projection on the slow axis.
    """
    retardance, angle = _alike(retardance, angle)
    half, slow = retardance[..., None, None] / 2, polariser(angle)
    unit = torch.eye(2, dtype=slow.dtype, device=slow.device)
    return torch.complex(*torch.broadcast_tensors(half.cos() * unit, half.sin() * (2 * slow - unit)))


def half_wave_plate(angle: float | Tensor) -> Complex[Tensor, "*batch 2 2"]:
    """A retarder of π, which mirrors the plane of polarisation at its slow axis."""
    return retarder(math.pi, angle)


def quarter_wave_plate(angle: float | Tensor) -> Complex[Tensor, "*batch 2 2"]:
    """A retarder of π/2, which turns light that is linear at 45° to its slow axis into circular light, and back."""
    return retarder(math.pi / 2, angle)


def train(*elements: Inexact[Tensor, "... 2 2"]) -> Inexact[Tensor, "... 2 2"]:
    """The Jones matrix of several elements, in the order in which light meets them. Raises ValueError for none."""
    if not elements:
        raise ValueError("a train of optics needs at least 1 element, not 0")
    return reduce(lambda before, element: _matmul(element, before), elements)


def apply(element: Inexact[Tensor, "... 2 2"], light: Inexact[Tensor, "... 2"]) -> Inexact[Tensor, "... 2"]:
    """The Jones vector behind an element."""
    return _matmul(element, light[..., None])[..., 0]


def intensity(light: Inexact[Tensor, "*batch 2"]) -> Float[Tensor, "*batch"]:
    """The intensity |E1|² + |E2|² of a Jones vector."""
    return (light * light.conj()).real.sum(-1) if light.is_complex() else light.square().sum(-1)


def leaky(angle: float | Tensor, extinction: float | Tensor | None) -> Float[Tensor, "*batch 2 2"]:
    """A†A of a polariser that leaks: P + r(1 − P), real.

    angle: of the light that it passes, rad.
    extinction: the share r of crossed intensity that it lets pass; None is an ideal polariser.

    For a polariser this is the coherency matrix of the light behind it, if unpolarised light of unit intensity along
    each axis comes in. For an analyser it is the matrix W of the intensity E†WE that passes. It is linear in r; the
    Jones matrix itself contains √r, whose slope at 0 is infinite.
    """
    if extinction is None:
        return polariser(angle)
    extinction, angle = _alike(extinction, angle)
    passed = polariser(angle)
    crossed = torch.eye(2, dtype=passed.dtype, device=passed.device) - passed
    return passed + extinction[..., None, None] * crossed


def _real(value: float | Tensor) -> Tensor:
    return value if isinstance(value, Tensor) else torch.tensor(value, dtype=torch.float64)


def _alike(one: float | Tensor, other: float | Tensor) -> tuple[Tensor, Tensor]:
    """Both as tensors of one dtype and device: those of the first tensor among them, or float64."""
    if isinstance(one, Tensor):
        return one, torch.as_tensor(other, dtype=one.dtype, device=one.device)
    other = _real(other)
    return torch.as_tensor(one, dtype=other.dtype, device=other.device), other


def _matmul(left: Tensor, right: Tensor) -> Tensor:
    kind = torch.promote_types(left.dtype, right.dtype)
    return left.to(kind) @ right.to(kind)
