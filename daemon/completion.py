"""The operator's parser to a script that makes a shell complete it."""

from __future__ import annotations

import argparse
from pathlib import Path

import shtab

from polecal import PolecalError
from polecal.daemon.control import Client

_ASK_S = 0.5  # somebody waits with a finger on the key
_LISTS = {"sessions": ("SESSIONS", "session"), "passes": ("PASSES", "name")}
_OF_METAVAR = {"SESSION": "sessions", "PASS": "passes"}


def script(parser: argparse.ArgumentParser, shell: str) -> str:
    """Write the script: files where a file is wanted, and names of sessions and passes from the daemon."""
    _mark(parser)
    return shtab.complete(parser, shell)


def names(socket: Path, of: str) -> list[str]:
    """List the sessions, or the present session's passes; nothing where there is no daemon to ask."""
    request, key = _LISTS[of]
    try:
        with Client(socket, _ASK_S) as client:
            rows = client.request({"class": request}).get(of) or []
    except PolecalError:
        return []
    return [str(row[key]) for row in rows if key in row]


def _mark(parser: argparse.ArgumentParser) -> None:
    """Tell shtab what each argument may be."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for verb in action.choices.values():
                _mark(verb)
        elif action.metavar in _OF_METAVAR:
            action.complete = shtab.cmd(f"polecal-field completion {_OF_METAVAR[action.metavar]}")  # type: ignore[attr-defined]
        elif action.metavar == "DIR":
            action.complete = shtab.DIRECTORY  # type: ignore[attr-defined]
        elif action.type is Path or action.metavar in ("FILE", "PATH"):
            action.complete = shtab.FILE  # type: ignore[attr-defined]
