"""What a reconstruction leaves in its folder."""

RESULTS = {
    "volume.ome.tif",
    "metrics.json",
    "log.csv",
    "config.resolved.toml",
    "images.ome.tif",
    "images.png",
    "sections.png",
    "misfit.png",
    "checkpoint.pt",
    "README.txt",
}
