"""The commands about what accuracy costs: plan, and work-precision of images and of fits."""
