"""The shell completes commands, options and files."""

import shutil
import subprocess
import sys

import pytest

COMPLETE = """
source ./script
COMP_WORDS=({words}); COMP_CWORD={last}
$(complete -p torchdic | grep -o "_shtab[a-z_]*")
echo "${{COMPREPLY[@]}}"
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with bash's script and a configuration."""
    folder = tmp_path_factory.mktemp("completion")
    done = subprocess.run([sys.executable, "-m", "recon", "completion", "bash"], capture_output=True, check=True)
    (folder / "script").write_bytes(done.stdout)
    (folder / "cell.toml").touch()
    return folder


@pytest.mark.skipif(shutil.which("bash") is None, reason="bash isn't here")
@pytest.mark.parametrize(
    ("words", "completed"),
    [
        ("torchdic rec", ["reconstruct"]),
        ("torchdic reconstruct --re", ["--resume", "--restart"]),
        ("torchdic reconstruct ce", ["cell.toml"]),
        ("torchdic completion z", ["zsh"]),
    ],
)
def test_bash_completes_what_is_typed(folder, words, completed):
    script = COMPLETE.format(words=words, last=len(words.split()) - 1)
    done = subprocess.run(["bash", "-c", script], cwd=folder, capture_output=True, text=True, check=True)
    assert done.stdout.split() == completed


def test_another_shell_is_refused_in_one_line():
    done = subprocess.run([sys.executable, "-m", "recon", "completion", "ksh"], capture_output=True, text=True)
    assert done.returncode == 2
    assert "'ksh'" in done.stderr
    assert done.stderr.count("\n") == 1
