"""Rays through a gradient of index: their equation, its solution, caustics, and the field that the rays make."""
