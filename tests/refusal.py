"""How a configuration is refused."""

import pytest

from recon.config import ConfigError, load


def the_error(path):
    """The one line with which a file is refused; it begins with the file."""
    with pytest.raises(ConfigError) as caught:
        load(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    assert "\n" not in message
    return message.removeprefix(f"{path}: ")
