"""The whole microscope: from a specimen to its images."""
