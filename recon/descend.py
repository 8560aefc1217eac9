"""The descent under the name by which users import it; see `recon.fit.descent`."""

from recon.fit.descent import Recipe, Step, descend

__all__ = ["Recipe", "Step", "descend"]
