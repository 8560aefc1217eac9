"""torchdic doctor: what an installation holds, and whether it computes what it should."""

import re
from pathlib import Path

import numpy as np
import pytest
import torch

import torchdic
from recon.cli import main
from recon.cli.doctor import installation, selftest


def told(capsys, *words):
    code = main(["doctor", "--device", "cpu", *words])
    said = capsys.readouterr()
    return code, said.out, said.err


def test_a_sound_installation_is_told_so(capsys):
    code, out, _ = told(capsys)
    assert code == 0
    assert f"torchdic      {torchdic.__version__}, Python " in out
    assert re.search(rf"^torch +{re.escape(torch.__version__)} \(asked for: >=2.6\)$", out, re.MULTILINE)
    assert "this folder   can be written to" in out
    assert out.count("passed") == 3
    assert out.strip().endswith("on cpu")


def test_another_image_or_gradient_fails(capsys, monkeypatch, tmp_path):
    wrong = np.load(selftest.STORED) + 1e-4
    np.save(tmp_path / "wrong.npy", wrong)
    monkeypatch.setattr(selftest, "STORED", tmp_path / "wrong.npy")
    code, out, err = told(capsys)
    assert code == 1
    assert "images against stored ones: 1.0e-04, FAILED" in out
    assert err.strip() == (
        "torchdic: error: this installation computes something else than it should: "
        "images against stored ones (1.0e-04, at most 2.0e-05)"
    )


@pytest.mark.parametrize("damage", ["empty", "cut", "missing", "of another shape", "not finite"])
def test_damaged_images_are_told_in_one_line(capsys, monkeypatch, tmp_path, damage):
    path, stored = tmp_path / "stored.npy", np.load(selftest.STORED)
    if damage == "empty":
        path.write_bytes(b"")
    elif damage == "cut":
        path.write_bytes(selftest.STORED.read_bytes()[:500])
    elif damage != "missing":
        np.save(path, stored[0] if damage == "of another shape" else np.where(stored > 0, np.nan, 0))
    monkeypatch.setattr(selftest, "STORED", path)
    code, _, err = told(capsys)
    assert code == 1
    assert len(err.splitlines()) == 1
    assert "install torchdic again" in err


def test_a_wrong_gradient_fails(monkeypatch):
    right = selftest.images
    monkeypatch.setattr(selftest, "images", lambda delta: right(delta.detach() + 0.9 * (delta - delta.detach())))
    outcome = next(o for o in selftest.outcomes(torch.device("cpu")) if "gradient" in o.what)
    assert outcome.error == pytest.approx(0.1, rel=1e-3)
    assert not outcome.passed


def test_a_missing_extra_is_told_with_its_command(capsys, monkeypatch):
    found = installation._version
    missing = installation.MISSING
    monkeypatch.setattr(installation, "_version", lambda name: missing if name == "nd2" else found(name))
    _, out, _ = told(capsys)
    assert "[bio]         missing, for ND2, CZI and LIF: pip install 'torchdic[bio]'" in out


def test_the_packages_are_those_that_the_project_asks_for():
    assert {"torch", "torchdiffeq", "numpy", "scikit-image"} <= dict(installation.packages()).keys()
    assert [name for name, _ in installation.packages("zarr")] == ["zarr"]


def test_a_folder_that_is_a_file_is_told(tmp_path):
    (tmp_path / "file").write_text("precious")
    words = dict(installation.lines(torch.device("cpu"), Path(tmp_path / "file")))["this folder"]
    assert "can't be written to" in words
