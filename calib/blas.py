"""One thread for small matrix products: faster here, and the same sums whatever the machine's cores."""

from __future__ import annotations

from typing import TypeVar

import numpy as np  # noqa: F401 - its BLAS must be there to be found
from threadpoolctl import ThreadpoolController

_F = TypeVar("_F")

_controller = ThreadpoolController()


def one_thread(function: _F) -> _F:
    """Run a function with BLAS on one thread: replay on another machine gives the same last digit."""
    wrapped: _F = _controller.wrap(limits=1, user_api="blas")(function)
    return wrapped
