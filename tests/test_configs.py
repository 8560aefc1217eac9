from pathlib import Path

import pytest

from recon.config.conversion import dump
from recon.config.reading import load

EXPERIMENTS = Path(__file__).parents[1] / "experiments"
FILES = sorted(EXPERIMENTS.glob("*.toml"))


def test_the_promised_experiments_are_there():
    assert {"bead.toml", "etched_glass.toml", "cell.toml"} <= {path.name for path in FILES}


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_every_experiments_configuration_loads_and_resolves_to_itself(path, tmp_path):
    config = load(path)
    resolved = tmp_path / "config.toml"
    resolved.write_text(dump(config), encoding="utf-8")
    assert dump(load(resolved)) == dump(config)


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_every_experiment_has_a_specimen_or_data(path):
    config = load(path)
    assert config.specimen is not None or config.data is not None
