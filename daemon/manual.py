"""The programs' parsers and the configuration's model to their manual pages."""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from types import NoneType
from typing import Any, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from polecal import __version__
from polecal.daemon import field, service
from polecal.daemon.config import Config

_CODES = {
    0: "done; the device is healthy, the result accepted",
    1: "degraded: it works, but not all is well; or a time-out",
    2: "wrong usage, or something named that does not exist",
    3: "no daemon",
    4: "a device's fault",
    5: "the calibration was rejected",
    75: "busy: another session, or another program, has it",
    77: "not permitted",
    78: "the configuration cannot be used",
}
_PATHS = {
    "/etc/polecal/polecal.yaml": "the configuration, polecal.yaml(5)",
    "/run/polecal/control.sock": "the control socket",
    "/var/lib/polecal/sessions": "a folder a session: capture.mcap, passes, calibration.yaml, report.html",
}
_ENVIRONMENT = {
    "POLECAL_SOCKET": "the control socket, where --socket does not name another",
    "POLECAL_CONFIG": "the configuration that doctor goes by, where --config does not name another",
    "NO_COLOR": "if set, nothing is coloured",
    "TERM, LANG": "what the terminal can show: linux, vt100 and the like, and the locale C, get plain ASCII",
}
_SEE = ("polecal-field(1)", "polecald(8)", "polecal.yaml(5)")
_LEAST = """lasers:
  - port: /dev/polecal-lms-front
    mount: {x_m: 0.0, y_m: -0.35, z_m: -1.0, roll_deg: 0.0, pitch_deg: -8.0, yaw_deg: 0.0}
navigation: {port: /dev/polecal-span}
pole: {radius_m: 0.04, height_m: 2.4}"""
_WORDS = {"str": "text", "int": "whole number", "float": "number", "bool": "true or false", "Path": "path"}


def pages() -> dict[str, str]:
    """Write every page, by its file's name."""
    return {
        "polecal-field.1": _field(),
        "polecald.8": _polecald(),
        "polecal.yaml.5": _yaml(),
    }


def _field() -> str:
    parser = field.make_parser()
    out = [_head("POLECAL-FIELD", 1), _name("polecal-field", str(parser.description))]
    out += [".SH SYNOPSIS", _usage(parser, "VERB ...")]
    out += [".SH DESCRIPTION", _text("Talks to polecald(8), or works on a file, by one of its verbs.")]
    out += [".SH OPTIONS", _text("They stand before the verb or after it."), *_options(parser)]
    out.append(".SH VERBS")
    for name, verb in verbs(parser).items():
        out += [f".SS {_escaped(name)}", _usage(verb), ".PP", _text(str(verb.description))]
        common = {option for action in parser._actions for option in action.option_strings}
        out += _options(verb, without=common)
    out += [*_listed("EXIT STATUS", _CODES), *_listed("ENVIRONMENT", _ENVIRONMENT), *_listed("FILES", _PATHS)]
    out += [
        ".SH EXAMPLES",
        ".EX",
        "polecal-field doctor",
        "polecal-field start && polecal-field status --watch",
    ]
    out += ["polecal-field wait && polecal-field result --format urdf", ".EE"]
    out.append(_text("For completion in bash, put this into ~/.bashrc:"))
    out += [".PP", ".EX", 'eval "$(polecal\\-field completion bash)"', ".EE", _see("polecal-field(1)")]
    return _page(out)


def _polecald() -> str:
    parser = service.make_parser()
    out = [_head("POLECALD", 8), _name("polecald", str(parser.description)), ".SH SYNOPSIS", _usage(parser)]
    out += [
        ".SH DESCRIPTION",
        _text(
            "Talks to SICK LMS-2xx lasers and a NovAtel SPAN receiver over serial lines, records every byte, "
            "watches the vehicle pass a retro-reflective pole, and calibrates the lasers' pose on the body. "
            "Sessions are begun and looked at by polecal-field(1). Its log goes to standard error. "
            "SIGTERM and SIGINT end it: devices are left as they should be found, captures are closed."
        ),
    ]
    out += [".SH OPTIONS", *_options(parser)]
    out += [*_listed("EXIT STATUS", _CODES), *_listed("FILES", _PATHS), _see("polecald(8)")]
    return _page(out)


def _yaml() -> str:
    out = [_head("POLECAL.YAML", 5), _name("polecal.yaml", "the configuration of polecald(8).")]
    out += [
        ".SH DESCRIPTION",
        _text(
            "A YAML file of keys with values. A key that is not known is a fault, and so is a value that "
            "cannot be: `polecald --config FILE --check-config` lists them all. Keys without a default must "
            "be given. The least that will do:"
        ),
        *(".PP", ".EX", *(_escaped(line) for line in _LEAST.splitlines()), ".EE"),
        ".SH KEYS",
    ]
    for path, about, model in keys(Config):
        kind = _kind(about.annotation)
        default = "" if about.default is PydanticUndefined else f"; default {_plain(about.default)}"
        if model is not None:
            default = "" if about.is_required() else "; may be left out"
        out += [
            ".TP",
            rf"\fB{_escaped(path)}\fR",
            _text(f"{about.description} ({kind}{_bounds(about)}{default})"),
        ]
    return _page([*out, _see("polecal.yaml(5)")])


def keys(model: type[BaseModel], path: str = "") -> Iterator[tuple[str, FieldInfo, type[BaseModel] | None]]:
    """Give every key of a model and those below it, as (path, field, the model below it)."""
    for name, about in model.model_fields.items():
        below = _model_in(about.annotation)
        here = f"{path}{name}"
        yield here, about, below
        if below is not None:
            yield from keys(below, f"{here}[]." if get_origin(about.annotation) is tuple else f"{here}.")


def verbs(parser: argparse.ArgumentParser) -> dict[str, argparse.ArgumentParser]:
    """Give a parser's verbs."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            return dict(action.choices)
    return {}


def _options(parser: argparse.ArgumentParser, without: set[str] = frozenset()) -> list[str]:  # type: ignore[assignment]
    out = []
    for action in parser._actions:
        hidden = action.help == argparse.SUPPRESS or set(action.option_strings) & without
        if hidden or isinstance(action, argparse._SubParsersAction):
            continue
        value = "" if action.nargs == 0 else str(action.metavar or "|".join(action.choices or [action.dest]))
        names = ", ".join(rf"\fB{_escaped(name)}\fR" for name in action.option_strings)
        said = str(action.help or "")
        if action.choices and action.metavar:
            said += f" ({', '.join(map(str, action.choices))})"
        known = action.default not in (None, False, argparse.SUPPRESS) and "else" not in said
        if known and action.option_strings:
            said += f" (default {action.default})"
        out += [
            ".TP",
            f"{names} \\fI{_escaped(value)}\\fR".strip() if value else names,
            _text(_sentence(said)),
        ]
    return out


def _usage(parser: argparse.ArgumentParser, rest: str = "") -> str:
    told = " ".join(parser.format_usage().removeprefix("usage: ").split())
    if rest:
        told = re.sub(r"VERB \.\.\.$", rest, told)
    return rf"\fB{_escaped(parser.prog)}\fR" + _escaped(told.removeprefix(parser.prog))


def _head(title: str, section: int) -> str:
    return f'.TH {title} {section} "" "polecal {__version__}" "polecal"'


def _name(name: str, about: str) -> str:
    return f".SH NAME\n{_escaped(name)} \\- {_escaped(about[:1].lower() + about[1:].rstrip('.'))}"


def _listed(title: str, rows: dict[Any, str]) -> list[str]:
    out = [f".SH {title}"]
    for key, said in rows.items():
        out += [".TP", rf"\fB{_escaped(str(key))}\fR", _text(_sentence(said))]
    return out


def _see(own: str) -> str:
    return ".SH SEE ALSO\n" + _text(", ".join(name for name in _SEE if name != own))


def _page(parts: list[str]) -> str:
    return "\n".join(parts) + "\n"


def _sentence(said: str) -> str:
    return f"{said[:1].upper()}{said[1:]}." if said else "."


def _text(said: str) -> str:
    escaped = _escaped(" ".join(said.split()))
    return rf"\&{escaped}" if escaped[:1] in (".", "'") else escaped


def _escaped(said: str) -> str:
    return said.replace("\\", "\\e").replace("-", "\\-")


def _model_in(annotation: Any) -> type[BaseModel] | None:
    for each in (annotation, *get_args(annotation)):
        if isinstance(each, type) and issubclass(each, BaseModel):
            return each
    return None


def _kind(annotation: Any) -> str:
    """Say in words what a key's value is."""
    parts = [part for part in get_args(annotation) if part not in (NoneType, Ellipsis)]
    if _model_in(annotation) is not None:
        return "list of keys" if get_origin(annotation) is tuple else "keys"
    if get_origin(annotation) is tuple:
        return f"list of {_kind(parts[0])}"
    if parts and all(isinstance(part, str) for part in parts):
        return " or ".join(parts)
    if parts:
        return " or ".join(_kind(part) for part in parts if not isinstance(part, FieldInfo))
    return _WORDS.get(getattr(annotation, "__name__", ""), "value")


def _bounds(about: FieldInfo) -> str:
    signs = {"gt": "above", "ge": "at least", "lt": "below", "le": "at most"}
    told = [
        f"{word} {getattr(limit, sign):g}"
        for limit in about.metadata
        for sign, word in signs.items()
        if hasattr(limit, sign) and isinstance(getattr(limit, sign), int | float)
    ]
    return "".join(f", {each}" for each in told)


def _plain(value: Any) -> str:
    if isinstance(value, tuple):
        return ", ".join(map(str, value)) or "none"
    return "null" if value is None else str(value)


def main(argv: list[str] | None = None) -> int:
    """Write the pages into a folder, ``man1`` and so on below it; give the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("build/man"), metavar="DIR", help="a man path")
    parser.add_argument("--quiet", action="store_true", help="do not name the files")
    arguments = parser.parse_args(argv)
    for name, page in pages().items():
        path = arguments.out / f"man{name[-1]}" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(page, encoding="utf-8")
        if not arguments.quiet:
            sys.stdout.write(f"{path}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
