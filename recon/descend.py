"""The descent under its first name: `from recon.descend import …` stays beside `from recon import …`.

Python puts this module, once it is loaded, in the place of the function `recon.descend`. So it is called and explained
as that one is.
"""

import sys
from types import ModuleType

from recon.fit.descent import descend, minimise
from recon.fit.problem import Problem, Recipe
from recon.fit.step import Step

__all__ = ["Problem", "Recipe", "Step", "descend", "minimise"]


class CallableDescent(ModuleType):
    """A module that is called as the function of its name is."""

    __call__ = staticmethod(descend)


__doc__, __wrapped__ = descend.__doc__, descend
sys.modules[__name__].__class__ = CallableDescent
