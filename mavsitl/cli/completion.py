"""`mavsitl completion`: the shell completes commands, options, and the names that they take."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Iterator
from typing import Any, NoReturn

from mavsitl.cli.common import EXIT_OK, add_json, command, print_json

SHELLS = ("bash", "zsh", "fish")

COMPLETION_HELP = """\
Print what makes a shell complete mavsitl's commands and options, and the names of scenarios, airframes, chaos modes,
parameters, failure units and types. It asks the installed mavsitl at each completion, so it knows what that knows.
"""

COMPLETION_EXAMPLES = """\
examples:
  mavsitl completion bash

To have it in every new shell:
  bash   echo 'eval "$(mavsitl completion bash)"' >> ~/.bashrc
  zsh    echo 'autoload -Uz compinit && compinit; eval "$(mavsitl completion zsh)"' >> ~/.zshrc
  fish   mavsitl completion fish > ~/.config/fish/completions/mavsitl.fish
"""

Completer = Callable[..., Iterable[str]]
"""(prefix, **what argcomplete has besides): the names; argcomplete keeps those that begin with the prefix."""


def add(commands: Any) -> None:
    parser = command(
        commands, "completion", "let the shell complete what is typed", COMPLETION_HELP, COMPLETION_EXAMPLES
    )
    parser.add_argument("shell", choices=SHELLS, metavar="SHELL", help=", ".join(SHELLS))
    add_json(parser, "the script")
    parser.set_defaults(run=_completion)


def _completion(options: argparse.Namespace) -> int:
    from argcomplete.shell_integration import shellcode

    script = shellcode(["mavsitl"], shell=options.shell)
    if options.json:
        print_json({"shell": options.shell, "script": script})
    else:
        print(script)
    return EXIT_OK


def complete(parser: argparse.ArgumentParser) -> NoReturn:
    """Answer a shell that asks (it has set _ARGCOMPLETE), and end."""
    import argcomplete

    for each in _parsers(parser):
        for action in each._actions:
            if completer := COMPLETERS.get(action.dest):
                action.completer = completer  # type: ignore[attr-defined]
    argcomplete.autocomplete(parser, always_complete_options="long")
    raise AssertionError("argcomplete ends the process")


def _parsers(parser: argparse.ArgumentParser) -> Iterator[argparse.ArgumentParser]:
    """It and all below it."""
    yield parser
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for each in action.choices.values():
                yield from _parsers(each)


def _scenarios(prefix: str, **_: Any) -> Iterable[str]:
    from mavsitl import scenario

    return [*scenario.names(), *_toml(prefix)]


def _airframes(prefix: str, **_: Any) -> Iterable[str]:
    from mavsitl import scenario

    return [*scenario.airframe_names(), *_toml(prefix)]


def _toml(prefix: str) -> Iterable[str]:
    from argcomplete.completers import FilesCompleter

    names: Iterable[str] = FilesCompleter(allowednames=(".toml",))(prefix)
    return names


def _chaos_modes(prefix: str, **_: Any) -> Iterable[str]:
    from mavsitl.chaos.table import PORTS, TABLE

    mode, at, _port = prefix.partition("@")
    return [f"{mode}@{port}" for port in PORTS] if at else list(TABLE)


def _failure_units(**_: Any) -> Iterable[str]:
    from mavsitl import ask

    return ask.failure_units()


def _failure_types(**_: Any) -> Iterable[str]:
    from mavsitl import ask

    return ask.failure_kinds()


def _parameters(parsed_args: argparse.Namespace, **_: Any) -> Iterable[str]:
    from mavsitl import wings

    behind = "=" if getattr(parsed_args, "action", "") == "set" else ""
    return [name + behind for name in wings.parameter_names()]


COMPLETERS: dict[str, Completer] = {
    "scenario": _scenarios,
    "scenarios": _scenarios,
    "airframe": _airframes,
    "chaos": _chaos_modes,
    "unit": _failure_units,
    "type": _failure_types,
    "names": _parameters,
}
"""By the name under which a command keeps the argument, for all commands alike."""
