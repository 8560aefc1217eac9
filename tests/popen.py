"""Python as a shell starts it, in a process of its own."""

import os
import subprocess
import sys


def python(*words, **options):
    """The process of Python with these words. What it prints comes by one pipe. options: further ones of Popen."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    return subprocess.Popen([sys.executable, *words], env=environment, **pipes, **options)
