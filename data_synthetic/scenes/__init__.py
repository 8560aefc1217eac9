"""Specimens of which scenes are made: several at once, fibres, graded ones, and any that is drawn at random."""
