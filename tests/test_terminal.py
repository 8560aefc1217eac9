"""Every message reaches every terminal, whatever its encoding."""

import io
import os
import subprocess
import sys
from pathlib import Path

import pytest

from recon.cli import main
from recon.report.terminal import write_plainly

MESSAGE = "5 µm, Δn 0.03 … 0.04, 12 × 14, 45°, Größe, \udcff"


@pytest.fixture
def terminal(monkeypatch):
    """A function that puts a terminal of an encoding in the place of stdout and stderr, and returns its bytes."""

    def put(encoding):
        raw = io.BytesIO()
        stream = io.TextIOWrapper(raw, encoding=encoding, write_through=True)
        monkeypatch.setattr(sys, "stdout", stream)
        monkeypatch.setattr(sys, "stderr", stream)
        return raw

    return put


@pytest.mark.parametrize(
    ("encoding", "shown"),
    [
        ("ascii", b"5 um, dn 0.03 ... 0.04, 12 x 14, 45deg, Gr??e, ?"),
        ("latin-1", "5 µm, dn 0.03 ... 0.04, 12 × 14, 45°, Größe, ?".encode("latin-1")),
        ("cp1252", "5 µm, dn 0.03 … 0.04, 12 × 14, 45°, Größe, ?".encode("cp1252")),
        ("utf-8", "5 µm, Δn 0.03 … 0.04, 12 × 14, 45°, Größe, ?".encode()),
    ],
)
def test_what_a_terminal_lacks_is_written_in_plain_letters(terminal, encoding, shown):
    raw = terminal(encoding)
    write_plainly()
    print(MESSAGE)
    assert raw.getvalue() == shown + b"\n"


@pytest.mark.parametrize("encoding", ["ascii", "latin-1", "cp1252"])
def test_an_error_reaches_a_terminal_without_its_signs(terminal, encoding, tmp_path):
    raw = terminal(encoding)
    config = tmp_path / "Δ µ.toml"
    assert main(["simulate", str(config), "--out", str(tmp_path)]) == 2
    assert b"No such file or directory" in raw.getvalue()


def test_a_stream_of_another_kind_and_none_stay_as_they_are(monkeypatch):
    monkeypatch.setattr(sys, "stdout", io.StringIO())
    monkeypatch.setattr(sys, "stderr", None)
    write_plainly()


@pytest.mark.parametrize("arguments", [["--help"], ["reconstruct", "--help"]], ids=" ".join)
def test_help_reaches_a_terminal_without_its_signs(terminal, arguments):
    raw = terminal("ascii")
    with pytest.raises(SystemExit) as done:
        main(arguments)
    assert done.value.code == 0
    assert b"usage: torchdic" in raw.getvalue()


def test_the_installed_command_answers_in_ascii(tmp_path):
    done = subprocess.run(
        [Path(sys.executable).with_name("torchdic"), "plan", str(tmp_path / "µ.toml")],
        capture_output=True,
        env={**os.environ, "PYTHONIOENCODING": "ascii"},
        check=False,
    )
    assert b"No such file or directory" in done.stderr
    assert b"UnicodeEncodeError" not in done.stderr
    assert done.returncode == 2


def test_a_run_outlives_a_reader_that_has_read_enough(tmp_path):
    """As of `torchdic … | head -1`: what follows is lost, and no more; errors still reach stderr."""
    program = (
        "import sys; from recon.cli import main; from recon.report.terminal import write_plainly\n"
        "write_plainly(); sys.stdin.read()\n"
        "for _ in range(2): print('x' * 100_000, flush=True)\n"
        "open('result', 'w').write('there')\n"
        "sys.exit(main(['completion', 'bash']))"
    )
    with subprocess.Popen(
        [sys.executable, "-c", program],
        cwd=tmp_path,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    ) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.close()
        process.stdin.close()
        assert process.stderr.read() == b""
    assert process.returncode == 0
    assert (tmp_path / "result").read_text() == "there"


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no device here is always full")
def test_what_a_full_disk_keeps_from_being_printed_is_said_to_be_lost():
    words = [sys.executable, "-m", "recon", "completion", "bash"]
    with open("/dev/full", "w") as full:
        found = subprocess.run(words, stdout=full, stderr=subprocess.PIPE, text=True)
    assert found.returncode == 2
    assert found.stderr.splitlines() == ["torchdic: error: what is printed is lost: No space left on device"]
