"""How a TIFF's pages become one stack (prism, focus, y, x) of grey values."""
