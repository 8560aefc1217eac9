"""The descent under the name by which users import it; see `recon.fit.descent`."""

from recon.fit.descent import descend, minimise
from recon.fit.problem import Problem, Recipe
from recon.fit.step import Step

__all__ = ["Problem", "Recipe", "Step", "descend", "minimise"]
