"""The page of the command line: every command and option, from the parsers themselves."""

from __future__ import annotations

import argparse
import importlib

from server.cli.main import COMMANDS
from tests.bench.documents.prose import cell

_HEAD = """# Command line

`stereorig COMMAND --help` prints the same. Exit status: 0 done, 1 failed, 2 wrong usage, 3 steps of
`measure` failed and others were measured, 130 interrupted. An error is one line with a stable code, the cause and the
remedy ([errors](errors.md)). Written by `make reference`.

"""


def _value(action: argparse.Action) -> str:
    if action.nargs == 0:
        return ""
    if action.choices is not None and not isinstance(action, argparse._SubParsersAction):
        return ", ".join(f"`{choice}`" for choice in action.choices)
    shown = action.metavar if isinstance(action.metavar, str) else (action.metavar or (action.dest.upper(),))[0]
    many = " ..." if action.nargs in ("+", "*") else ""
    return f"`{shown}{many}`"


def _row(action: argparse.Action) -> str:
    names = ", ".join(f"`{name}`" for name in action.option_strings) or f"`{action.metavar or action.dest}`"
    default = "required" if action.option_strings and action.required else ""
    text = cell((action.help or "").replace("%(default)s", str(action.default)).replace("%%", "%"))
    return (
        f"| {names} | {_value(action) if action.option_strings else ''} | {text}{f' ({default})' if default else ''} |"
    )


def _table(parser: argparse.ArgumentParser, name: str, level: int) -> list[str]:
    lines = [f"{'#' * level} {name}", ""]
    if parser.description:
        text = " ".join(parser.description.split())
        lines += [text[:1].upper() + text[1:] + ("" if text.endswith(".") else "."), ""]
    actions = [a for a in parser._actions if not isinstance(a, argparse._HelpAction | argparse._SubParsersAction)]
    if actions:
        lines += ["| argument | value | meaning |", "| --- | --- | --- |", *(_row(action) for action in actions), ""]
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for sub, inner in action.choices.items():
                lines += _table(inner, f"{name} {sub}", level + 1)
    return lines


def pages() -> dict[str, str]:
    """Return the page by its path below docs/reference."""
    lines = ["| command | purpose |", "| --- | --- |"]
    lines += [f"| [{name}](#{name}) | {cell(text)} |" for name, (_, text) in COMMANDS.items()]
    lines.append("")
    for name, (module, text) in COMMANDS.items():
        parser = argparse.ArgumentParser(prog=f"stereorig {name}", description=text)
        importlib.import_module(module).add_arguments(parser)
        lines += _table(parser, name, 2)
    return {"command_line.md": _HEAD + "\n".join(lines).rstrip() + "\n"}
