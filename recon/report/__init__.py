"""Figures, tables and numbers that say how a reconstruction went."""
