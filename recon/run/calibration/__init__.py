"""A calibration from a configuration to a folder: what the images tell of the optics, and how well."""
