"""What the site's reference is made of: docstrings, the configuration's schema and the commands' parsers."""
