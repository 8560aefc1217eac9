"""Phase differences between the two beams, from DIC images of a thin phase object in focus.

Such an object of phase φ has the image
    I = a·sin²((Δ + bias)/2) = a/2·(1 − cos bias·cos Δ + sin bias·sin Δ),    Δ = φ(x + s/2) − φ(x − s/2),
see `torchdic.linear.two_beam_image`; a is 1 where nothing absorbs. Images with the same shear are taken together:
- three biases or more: a, a·cos Δ and a·sin Δ are a linear least-squares problem, the phase-shifting of C. J. Cogswell,
  N. I. Smith, K. G. Larkin and P. Hariharan, Proc. SPIE 2984, 72 (1997);
- a pair ±b: R = (I₊ − I₋)/(I₊ + I₋) = sin b·sin Δ/(1 − cos b·cos Δ) is solved for Δ, and a cancels;
- one image: the inverse of sin² on the branch of its bias, with a = 1.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from torchdic import Prism
from torchdic.scalar import number

# Shears and biases that differ by less than this, relative to the shear or in rad, are the same.
_SAME = 1e-6

# |sin(bias)| below which a phase difference of either sign gives the same image, but for the noise.
_EVEN = 1e-3

# The condition number of a phase-shifting problem above which its images are taken apart.
_ILL = 30.0


@dataclass(frozen=True, eq=False)
class PhaseDifference:
    """φ(x + s/2) − φ(x − s/2) of each section.

    shear: s (y, x) in µm. phase: in rad (focus, y, x), float64. variance: of its noise where Δ is small, per variance
    of the noise of an image.
    """

    shear: tuple[float, float]
    phase: Float[Tensor, "focus y x"]
    variance: float


def phase_differences(data: Float[Tensor, "prism focus y x"], prisms: Sequence[Prism | None]) -> list[PhaseDifference]:
    """The phase differences that images show, one or more for each shear.

    data: (prism, focus, y, x), relative to the empty bright field. prisms: one for each of the data.
    Bright-field images are left out: in focus they show nothing of a phase.
    Raises ValueError where no prism shears, or where a single image's bias leaves the sign of Δ open.
    """
    groups: dict[tuple[float, float], list[tuple[float, Tensor]]] = {}
    for prism, images in zip(prisms, data.double(), strict=True):
        if prism is None:
            continue
        shear, bias = _canonical(prism)
        known = next((s for s in groups if math.dist(s, shear) <= _SAME * math.hypot(*shear)), shear)
        groups.setdefault(known, []).append((bias, images))
    if not groups:
        raise ValueError("opl needs an image with a sheared prism: bright field in focus shows no phase")
    return [difference for shear, images in groups.items() for difference in _of_shear(shear, images)]


def _canonical(prism: Prism) -> tuple[tuple[float, float], float]:
    """Shear and bias of a prism with the shear's first component above 0, and the bias in [−π, π].

    I(s, bias) = I(−s, −bias). Raises ValueError for a shear of 0.
    """
    (y, x), bias = (number(s) for s in prism.shear), number(prism.bias)
    if y == x == 0:
        raise ValueError("shear (0, 0) µm shows no phase: opl needs two beams that are apart")
    if y < 0 or (y == 0 and x < 0):
        y, x, bias = -y, -x, -bias
    return (y, x), math.remainder(bias, 2 * math.pi)


def _of_shear(shear: tuple[float, float], images: list[tuple[float, Tensor]]) -> list[PhaseDifference]:
    """The differences that images with one shear give, each of them (bias, (focus, y, x))."""
    biases = [bias for bias, _ in images]
    stepped = _phase_shifted(biases, torch.stack([image for _, image in images]))
    if stepped is not None:
        return [PhaseDifference(shear, *stepped)]
    if len(images) == 2 and abs(math.remainder(biases[0] + biases[1], 2 * math.pi)) <= _SAME:
        (_, behind), (bias, ahead) = sorted(images, key=lambda pair: pair[0])
        if abs(math.sin(bias)) > _EVEN:
            return [PhaseDifference(shear, _of_pair(bias, ahead, behind), 2 / math.sin(bias) ** 2)]
    return [PhaseDifference(shear, _of_one(bias, image), 4 / math.sin(bias) ** 2) for bias, image in images]


def _phase_shifted(biases: list[float], images: Float[Tensor, "bias focus y x"]) -> tuple[Tensor, float] | None:
    """Δ and its variance by least squares; None where the biases don't determine a, a·cos Δ and a·sin Δ."""
    if len(biases) < 3:
        return None
    b = torch.tensor(biases, dtype=torch.float64, device=images.device)
    design = torch.stack([torch.ones_like(b), -b.cos(), b.sin()], 1) / 2
    if float(torch.linalg.cond(design)) > _ILL:
        return None
    inverse = torch.linalg.pinv(design)
    _, cosine, sine = torch.einsum("cb,bfyx->cfyx", inverse, images)
    return torch.atan2(sine, cosine), float(inverse[2].square().sum())


def _of_pair(bias: float, ahead: Tensor, behind: Tensor) -> Tensor:
    """Δ from images with bias and −bias, where 0 < bias < π: R = sin b·sin Δ + R·cos b·cos Δ is one sine of Δ + ψ.

    |Δ| is at most the bias. Noise may make an image negative; R is at most 1 all the same.
    """
    ahead, behind = ahead.clamp_min(0), behind.clamp_min(0)
    ratio = (ahead - behind) / (ahead + behind).clamp_min(torch.finfo(ahead.dtype).tiny)
    sine, cosine = math.sin(bias), ratio * math.cos(bias)
    amplitude = (sine**2 + cosine.square()).sqrt()
    return torch.asin((ratio / amplitude).clamp(-1, 1)) - torch.atan(cosine / sine)


def _of_one(bias: float, image: Tensor) -> Tensor:
    """Δ from one image: 2·asin √I on the branch of its bias, less the bias. Raises ValueError for an even image."""
    if abs(math.sin(bias)) <= _EVEN:
        raise ValueError(f"bias {bias:g} rad alone shows no sign of a phase difference: opl needs sin(bias) ≠ 0")
    half = torch.asin(image.clamp(0, 1).sqrt())
    return 2 * math.copysign(1, bias) * half - bias
