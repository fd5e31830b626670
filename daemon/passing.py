"""A pass that is being driven to what STATUS tells of it, before it is over."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any

from polecal.calib import Kind, Mount, Pass, Result, Setup
from polecal.calib.running import Running
from polecal.daemon.passes import OpenPass, even, joined


class Passing:
    """What the closed passes and the open one come to; worked out only when it is asked for.

    It changes nothing: a pass counts once it is closed.
    """

    def __init__(self, site: int) -> None:
        self._site = site
        self._of: tuple[Result, OpenPass] | None = None
        self._running: Running | None = None
        self._parts, self._pole_returns = 0, 0
        self._told: dict[str, Any] | None = None

    def told(
        self,
        passes: Sequence[Pass],
        setup: Setup,
        result: Result,
        open_passes: Collection[OpenPass],
        mount: Mount,
    ) -> dict[str, Any] | None:
        """Give the estimate, σ and cost with what is open, None where no pass is.

        ``passes`` are those that ``result`` is of; of ``open_passes``, of one reflector each, the one with
        the most returns is taken. ``mount`` is the best known, to tell even ground.
        """
        if not open_passes:
            return None
        longest = max(open_passes, key=lambda one: len(one.parts))
        if self._of is None or self._of[0] is not result or self._of[1] is not longest:
            self._of, self._running = (result, longest), Running(passes, setup, result, self._site)
            self._parts = self._pole_returns = 0
        new = [returns for _, returns in longest.parts[self._parts :]]
        if new and self._running is not None:
            returns = joined(new, 0)
            returns = returns[even(returns, mount)]
            now = self._running.add(returns)
            self._parts = len(longest.parts)
            self._pole_returns += int((returns.kind == Kind.POLE).sum())
            self._told = {
                "pole_returns": self._pole_returns,
                "estimate": now.mount.as_dict(),
                "sigma": self._running.sigma().as_dict(),
                "cost_m": now.cost_m,
            }
        return self._told
