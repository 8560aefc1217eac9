"""What few condenser directions leave out, added to their images: the difference from careful images of a volume
nearby.

Images of few directions are cheap, but the difference between them and those of many is more than the noise of a bright
stack, and a fit would make it a part of the specimen. It hardly changes with the volume. So it is computed now and
then, without a gradient, and the steps are taken on few directions plus this difference: where they end, the volume
explains the data by careful images (the defect correction of K. Böhmer, P. Hemker and H. Stetter, Computing Suppl. 5,
1, 1984). A part of it follows the volume: what few directions miss of a weak specimen.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from recon.fit.newton.missed import MissedResponse, share_of
from recon.fit.setup import Setup
from torchdic import Fidelity

# A correction that changed the images by less than this share of the noise's misfit may serve REST further steps.
SETTLED, REST = 0.004, 2

# Directions of the first steps.
COARSE = 18


@dataclass(frozen=True, eq=False)
class Correction:
    """The difference of careful images from draft ones.

    added: to the images that the microscope forms (prism, focus, row, column); None is nothing yet.
    rest: accepted steps for which it still serves.
    share: of what draft images miss of a weak specimen, see `MissedResponse`, that follows the volume.
    """

    added: Float[Tensor, "prism focus row column"] | None = None
    rest: int = 0
    share: float = 0.0

    def to(
        self,
        formed: Float[Tensor, "prism focus row column"],
        delta: Float[Tensor, "z y x"],
        missed: MissedResponse | None,
    ) -> Float[Tensor, "prism focus row column"]:
        """Draft images with the correction. delta: Δn of their volume. missed: by weak specimens; None is nothing."""
        if self.added is None:
            return formed
        images = formed + self.added
        return images if missed is None or self.share == 0 else images + self.share * missed(delta)

    @torch.no_grad()
    def renewed(
        self,
        setup: Setup,
        formed: Float[Tensor, "prism focus row column"],
        careful: Fidelity,
        missed: MissedResponse | None,
        size: Callable[[Tensor], float],
    ) -> "Correction":
        """The correction at the setup's volume, or this one where it still serves.

        formed: the draft images of that volume. careful: the fidelity of the images to which they are corrected.
        missed: as in `to`. size: of a change of images, in shares of what noise leaves.
        """
        if self.rest > 0:
            return replace(self, rest=self.rest - 1)
        added, share = setup.formed(careful) - formed.detach(), self.share
        if missed is not None:
            linear = missed(setup.volume.delta.detach())
            share = share_of(linear, added) if self.added is None else share
            added = added - share * linear
        moved = size(added if self.added is None else added - self.added)
        return Correction(added, REST if moved < SETTLED else 0, share)


def drafts(careful: Fidelity, sources: int | None) -> tuple[Fidelity, Fidelity]:
    """The fidelities of the first steps and of the later ones: fewer directions, and no padding.

    sources: directions of the later steps; None is all of the careful fidelity's.
    """
    fine = replace(careful, padding=0, order=1, sources=min(sources or careful.sources, careful.sources))
    return replace(fine, sources=min(COARSE, fine.sources)), fine
