"""What is known of a specimen before it is measured, as terms that are added to a misfit, and how much they weigh."""
