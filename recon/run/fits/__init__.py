"""Work and precision of the fit: what each way to reconstruct costs, and how near it comes."""
