"""From a field's spectrum behind the specimen to intensities on the camera."""
