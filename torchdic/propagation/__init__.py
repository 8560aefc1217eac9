"""How light crosses the specimen: straight rays, bent rays and waves, an object each."""
