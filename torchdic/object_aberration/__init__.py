"""The specimen's own aberration of each object point (Kagalwala & Kanade, section 3.3)."""
