"""What a reconstruction leaves in its folder."""

# What the command line leaves beside the results, once all of them are written.
BESIDE = {"report.html", "run.json", "README.txt"}

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
    *BESIDE,
}
