"""The command that shows what a folder of results holds in napari: its layers, and the window."""
