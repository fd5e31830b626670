"""Log events to lines: coloured on a terminal, with priorities for journald, else JSON."""

from __future__ import annotations

import json
import os
import sys
from typing import TextIO

import structlog
from structlog.typing import EventDict, Processor, WrappedLogger

LEVELS = {"debug": 10, "info": 20, "warning": 30, "error": 40}
_PRIORITY = {"critical": 2, "error": 3, "warning": 4, "info": 6, "debug": 7}  # sd-daemon(3)


def configure(stream: TextIO | None = None, level: str = "info") -> None:
    """Send what is logged from now on to a stream (stderr), from a level of `LEVELS` up."""
    stream = stream or sys.stderr
    processors: list[Processor] = [
        structlog.contextvars.merge_contextvars,
        structlog.processors.add_log_level,
    ]
    stamp = structlog.processors.TimeStamper
    if stream.isatty():
        plain = structlog.dev.plain_traceback
        processors += [stamp("%H:%M:%S", utc=False), structlog.dev.ConsoleRenderer(exception_formatter=plain)]
    elif _is_journal(stream):  # which stamps the lines itself
        processors += [structlog.processors.format_exc_info, _journal_line]
    else:
        as_json = structlog.processors.JSONRenderer(default=str)
        processors += [stamp("iso", utc=True), structlog.processors.format_exc_info, as_json]
    structlog.configure(
        processors=processors,
        wrapper_class=structlog.make_filtering_bound_logger(LEVELS[level]),
        logger_factory=structlog.WriteLoggerFactory(stream),
        cache_logger_on_first_use=False,
    )


def _is_journal(stream: TextIO) -> bool:
    """Say whether journald is at the stream's other end, systemd.exec(5): JOURNAL_STREAM."""
    try:
        about = os.fstat(stream.fileno())
    except (OSError, ValueError):
        return False
    return os.environ.get("JOURNAL_STREAM") == f"{about.st_dev}:{about.st_ino}"


def _journal_line(_: WrappedLogger, __: str, event: EventDict) -> str:
    """Write ``<priority>what happened key=value``; always one line, as each line is an entry of its own."""
    priority = _PRIORITY[event.pop("level")]
    words = [" ".join(str(event.pop("event")).split())]
    for key, value in event.items():
        text = str(value)
        bare = text and text.isprintable() and not set(text) & set(' "=')
        words.append(f"{key}={text if bare else json.dumps(text, ensure_ascii=False)}")
    return f"<{priority}>{' '.join(words)}"
