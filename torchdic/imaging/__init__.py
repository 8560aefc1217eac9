"""From the spectrum of the field behind the specimen to intensities in the image plane."""
