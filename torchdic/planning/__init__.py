"""What accuracy costs: the plan of an image, the worth of each effect, and work against precision."""
