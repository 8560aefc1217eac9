"""What users import to read and write stacks and volumes; the code is in `torchdic.files`."""

from torchdic.errors import StackError, StackWarning
from torchdic.files.format import Stack
from torchdic.files.stack import read_stack, read_volume, write_stack, write_volume

__all__ = ["Stack", "StackError", "StackWarning", "read_stack", "read_volume", "write_stack", "write_volume"]
