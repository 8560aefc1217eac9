"""Configuration files: TOML whose schema is the domain's own dataclasses.

Unknown keys, wrong types and unphysical values are errors that name the file, the key, the value and the law.
"""

from recon.config.conversion import dump, flat
from recon.config.reading import load, structure
from recon.config.schema import Config, ConfigError, UnitsWarning

__all__ = ["Config", "ConfigError", "UnitsWarning", "dump", "flat", "load", "structure"]
