"""How uncertain fitted parameters are: by the noise, and by how much the images disagree.

With the Hessian H of the misfit and the gradient as a sum of parts, the covariance is H⁻¹·S·H⁻¹, where S is the sum of
the squares of the parts. With the pixels as parts it holds what noise does, and any misfit that differs from pixel to
pixel (H. White, Econometrica 48, 817, 1980). With the images as parts it also holds what a model that isn't quite right
does within each image (K.-Y. Liang and S. L. Zeger, Biometrika 73, 13, 1986). The larger of both counts. An error that
all images share isn't in it. What is known of a parameter beforehand counts as one more image of it.
"""

from collections.abc import Mapping

import torch
from torch import Tensor

from recon.fit.nuisances.nearby import Nearby
from recon.fit.nuisances.refinement import ABSOLUTE, Beforehand, normal_equations
from recon.misfit.base import Misfit


@torch.no_grad()
def standard_deviations(nearby: Nearby, parameters: Mapping[str, Tensor], misfit: Misfit) -> dict[str, Tensor]:
    """One standard deviation of each entry of each parameter, by name, in the parameter's unit.

    nearby: near these parameters. An entry that no image tells has its scale, which is a large error.
    """
    equations = normal_equations(nearby, parameters, Beforehand.at(nearby, parameters, misfit), scattered=True)
    assert equations.scatter is not None
    inverse = torch.linalg.inv(equations.damped)
    parts, number = [equations.scatter], len(equations.slopes)
    if number > 1:
        slopes = equations.slopes - equations.slopes.mean(0)
        parts.append(number / (number - 1) * slopes.mT @ slopes)
    before = torch.diag(equations.unit * equations.held)
    variance = torch.stack([(inverse @ (part + before) @ inverse).diagonal() for part in parts]).amax(0).clamp_min(0)
    held = ABSOLUTE * inverse.diagonal()  # 1 where only the damping holds an entry, next to nothing elsewhere
    deviations = (variance + held.square()).sqrt() * equations.scale
    each = deviations.split([parameter.numel() for parameter in parameters.values()])
    shaped = zip(parameters.items(), each, strict=True)
    return {name: part.reshape(parameter.shape).to(parameter) for (name, parameter), part in shaped}
