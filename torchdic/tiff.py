"""Reading and writing of stacks under the name by which users import it; see `torchdic.files`."""

from torchdic.errors import StackError, StackWarning
from torchdic.files.stack import Stack, read_stack, read_volume, write_stack, write_volume

__all__ = ["Stack", "StackError", "StackWarning", "read_stack", "read_volume", "write_stack", "write_volume"]
