"""Every command, with its arguments, from the parser that reads them."""

import argparse
import re

from recon.cli.commands import COMMANDS, Command

HEAD = """# Every command

Made from the parsers of the commands: it is what `torchdic COMMAND --help` says. Exit codes: 0 done, 1 a fit that
diverges or an installation that errs, 2 what the user can put right, 130 interrupted.

"""


def page() -> str:
    """The page of the reference, in Markdown."""
    return HEAD + "\n".join(_section(name, command) for name, command in COMMANDS.items())


def parser(name: str, command: Command) -> argparse.ArgumentParser:
    """A command's parser."""
    made = argparse.ArgumentParser(prog=f"torchdic {name}", formatter_class=_Wide, add_help=False)
    command.add_arguments(made)
    return made


class _Wide(argparse.HelpFormatter):
    """Lines of one width, whatever the terminal's."""

    def __init__(self, prog: str) -> None:
        super().__init__(prog, width=100)


def _section(name: str, command: Command) -> str:
    made = parser(name, command)
    also = f" Also `torchdic {'`, `torchdic '.join(command.aliases)}`." if command.aliases else ""
    lines = [f"## `torchdic {name}`", "", f"{command.help[0].upper()}{command.help[1:]}.{also}", ""]
    lines += ["```text", made.format_usage().removeprefix("usage: ").rstrip(), "```", ""]
    actions = made._actions  # argparse has no public list of a parser's arguments
    if actions:
        lines += ["| argument | what it is |", "|---|---|"]
        lines += [f"| {_called(action)} | {_told(made, action)} |" for action in actions]
    return "\n".join([*lines, "", "Example:", "", "```sh", f"torchdic {command.example}", "```", ""])


def _called(action: argparse.Action) -> str:
    value = "" if action.nargs == 0 else str(action.metavar or (action.dest.upper() if action.option_strings else ""))
    return ", ".join(f"`{f'{name} {value}'.strip()}`" for name in action.option_strings) or f"`{value or action.dest}`"


def _told(made: argparse.ArgumentParser, action: argparse.Action) -> str:
    told = made._get_formatter()._expand_help(action) if action.help else ""
    choices = f" ({', '.join(f'`{choice}`' for choice in action.choices)})" if action.choices else ""
    options_as_code = re.sub(r"(?<![\w`-])(--[\w-]+)", r"`\1`", told)
    return (options_as_code + choices).replace("|", "\\|")
