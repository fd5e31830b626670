"""polecal: the pose of a vehicle's laser on its body, found by driving past a pole."""

from __future__ import annotations

__version__ = "0.1.0"


class PolecalError(Exception):
    """What went wrong and where (the message), and what to do about it (the hint).

    The root of every error that polecal raises on purpose.
    """

    def __init__(self, message: str, hint: str = "") -> None:
        super().__init__(message)
        self.hint = hint
