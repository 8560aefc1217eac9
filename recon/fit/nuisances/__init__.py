"""What the images depend on beside Δn, in few numbers that can be learned: brightness, drift, bias, focus, shear."""
