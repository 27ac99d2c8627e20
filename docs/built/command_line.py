"""The list of commands and options, from the parsers themselves."""

from __future__ import annotations

import argparse

from docs.built.tables import cell, table
from stereorig.core.lazy import load_module
from stereorig.server.cli.main import COMMANDS


def commands() -> str:
    """Return a table of the commands, then each with its arguments."""
    parts = [
        table(("command", "purpose"), [(f"[{name}](#{name})", cell(text)) for name, (_, text) in COMMANDS.items()])
    ]
    for name, (module, text) in COMMANDS.items():
        parser = argparse.ArgumentParser(prog=f"stereorig {name}", description=text)
        load_module(module).add_arguments(parser)
        parts += _command(parser, name, 2)
    return "\n\n".join(parts)


def _command(parser: argparse.ArgumentParser, name: str, level: int) -> list[str]:
    parts = [f"{'#' * level} {name}"]
    if parser.description:
        text = " ".join(parser.description.split())
        parts.append(text[:1].upper() + text[1:] + ("" if text.endswith(".") else "."))
    subcommands = [a for a in parser._actions if isinstance(a, argparse._SubParsersAction)]
    arguments = [a for a in parser._actions if a not in subcommands and not isinstance(a, argparse._HelpAction)]
    if arguments:
        parts.append(table(("argument", "value", "meaning"), map(_row, arguments)))
    for action in subcommands:
        for sub, inner in action.choices.items():
            parts += _command(inner, f"{name} {sub}", level + 1)
    return parts


def _row(action: argparse.Action) -> tuple[str, str, str]:
    names = ", ".join(f"`{name}`" for name in action.option_strings) or f"`{action.metavar or action.dest}`"
    text = cell((action.help or "").replace("%(default)s", str(action.default)).replace("%%", "%"))
    required = " (required)" if action.option_strings and action.required else ""
    return names, _value(action) if action.option_strings else "", text + required


def _value(action: argparse.Action) -> str:
    if action.nargs == 0:
        return ""
    if action.choices is not None:
        return ", ".join(f"`{choice}`" for choice in action.choices)
    shown = action.metavar if isinstance(action.metavar, str) else (action.metavar or (action.dest.upper(),))[0]
    return f"`{shown}{' ...' if action.nargs in ('+', '*') else ''}`"
