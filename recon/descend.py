"""The descent under the name by which users import it; see `recon.fit.descent`."""

from recon.fit.descent import Step, descend
from recon.fit.problem import Recipe

__all__ = ["Recipe", "Step", "descend"]
