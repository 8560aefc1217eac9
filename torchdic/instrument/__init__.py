"""The microscope's parts: illumination, prism, objective, polarisation and camera."""
