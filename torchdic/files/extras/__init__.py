"""Formats of microscopes' makers, each read through a package of its own that is loaded where it is asked for."""
