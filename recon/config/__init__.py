"""Configuration files: TOML whose tables are the project's own dataclasses.

An unknown key, a value of a wrong type and an unphysical value are errors. Each is one line that names the file, the
key, the value and the law.
"""

from recon.config.conversion import dump, flat
from recon.config.reading import load, structure
from recon.config.schema import Config, ConfigError, UnitsWarning, UnlikelyWarning

__all__ = ["Config", "ConfigError", "UnitsWarning", "UnlikelyWarning", "dump", "flat", "load", "structure"]
