"""A field that is larger than memory, cut into overlapping tiles that are fitted by themselves and blended."""
