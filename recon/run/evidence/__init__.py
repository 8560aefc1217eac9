"""Error bars of a finished reconstruction: its folder is read, other images are fitted, and what they tell is left."""
