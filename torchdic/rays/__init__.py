"""Rays through a gradient of index: their equation, its solution, caustics, and the mesh of rays that land."""
