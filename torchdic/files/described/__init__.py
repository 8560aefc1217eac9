"""What a TIFF's header says of its pixels: their size, their unit, their bit depth and their calibration."""
