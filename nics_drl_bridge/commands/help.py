"""The help of each command: its options, as its docstring describes them, and examples."""

import re
from typing import Any

import typer
from typer.core import TyperCommand

from nics_drl_bridge.commands.console import check_options

# an entry of a section `Args`, which may go over several lines
ARGUMENT = r"^    (\w+): (.+(?:\n {5,}.+)*)"


class DocumentedCommand(TyperCommand):
    """Takes the help of its options, and its examples, from its docstring."""

    def __init__(self, help: str | None, params: list[Any], **options: Any) -> None:
        text, *parts = re.split(r"\n\n(Args|Examples):\n", help or "")
        sections = dict(zip(parts[::2], parts[1::2], strict=True))
        lines = re.findall(ARGUMENT, sections.get("Args", ""), re.MULTILINE)
        about = {name: " ".join(line.split()) for name, line in lines}
        for param in params:
            param.help = param.help or about.get(param.name)
        if "Examples" in sections:
            # click does not rewrap a paragraph whose first line is just this character.
            options["epilog"] = f"\b\nExamples:\n{sections['Examples']}"
        super().__init__(help=text, params=params, **options)


def complete(app: typer.Typer) -> None:
    """Adds `check_options`, and help, to each command of an app and its groups."""
    for command in app.registered_commands:
        if command.callback is not None:
            command.callback = check_options(command.callback)
        if command.cls is TyperCommand:  # an extension may have its own
            command.cls = DocumentedCommand
    for group in app.registered_groups:
        if group.typer_instance is not None:
            complete(group.typer_instance)
