"""Commands that say how far a volume can be trusted: before it is recorded, and after."""
