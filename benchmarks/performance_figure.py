"""The figure of docs/performance.md, drawn from its table of rays.

python benchmarks/performance_figure.py
"""

import re
from pathlib import Path

import matplotlib.pyplot as plt

DOCS = Path(__file__).parents[1] / "docs"
TITLES = ("forward, s", "forward and gradient, s", "peak above imports, MiB")


def main() -> None:
    """Draw it."""
    text = (DOCS / "performance.md").read_text()
    table = text[text.index("| way |") :].split("\n\n")[0].splitlines()[2:]
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in table]
    names = [row[0] for row in rows]
    colours = ["tab:blue" if name.startswith("torchdic,") else "0.7" for name in names]
    figure, axes = plt.subplots(1, 3, figsize=(11, 3), sharey=True, layout="constrained")
    for i, (axis, title) in enumerate(zip(axes, TITLES, strict=True), start=1):
        found = [re.match(r"[\d.]+", row[i]) for row in rows]
        bars = axis.barh(names, [float(v[0]) if v else 0.0 for v in found], color=colours)
        axis.bar_label(bars, [v[0] if v else "–" for v in found], padding=3)
        axis.set_title(title, fontsize=10)
        axis.margins(x=0.18)
        axis.spines[["top", "right"]].set_visible(False)
    axes[0].invert_yaxis()
    figure.savefig(DOCS / "performance.png", dpi=110)


if __name__ == "__main__":
    main()
