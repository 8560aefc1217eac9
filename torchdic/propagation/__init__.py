"""How light crosses the specimen: straight rays, bent rays and waves. Each way is one object."""
