"""Passes' sums to a file without a name, and back: hundreds of passes hold no more memory than dozens."""

from __future__ import annotations

import errno
import os
import tempfile
import weakref
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from polecal.daemon.recorder import RecorderError

_IN_MEMORY_BYTES = 4 * 2**20  # 50 passes: most sessions never have more, and none needs the disk for them


class Spill:
    """Keeps arrays of float64: the first of them in memory, more in a file that goes with the process.

    What there is no room for on the disk stays in memory, too: no pass is lost by it.
    """

    def __init__(self, folder: Path | None, *, in_memory_bytes: int = _IN_MEMORY_BYTES) -> None:
        """Keep what is more than ``in_memory_bytes`` in ``folder``; all in memory if that is None."""
        self._folder, self._room_bytes = folder, in_memory_bytes
        self._file: int | None = None
        self._end = 0

    def put(self, array: NDArray[np.float64]) -> NDArray[np.float64] | Callable[[], NDArray[np.float64]]:
        """Take an array (N,); give it, or what fetches it, which raises RecorderError where it cannot."""
        if self._folder is None or self._room_bytes >= array.nbytes:
            self._room_bytes -= array.nbytes
            return array
        try:
            if self._file is None:
                with tempfile.TemporaryFile(dir=self._folder, prefix=".sums") as file:
                    self._file = os.dup(file.fileno())
                weakref.finalize(self, os.close, self._file)
            if os.pwrite(self._file, array.tobytes(), self._end) < array.nbytes:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        except OSError:
            return array
        begin, self._end = self._end, self._end + array.nbytes
        return partial(self._get, self._file, begin, array.nbytes, _check(array))

    def _get(self, file: int, begin: int, size: int, check: int) -> NDArray[np.float64]:
        try:
            data = os.pread(file, size, begin)
            if len(data) < size or _check(np.frombuffer(data)) != check:
                raise OSError(errno.EIO, os.strerror(errno.EIO))
        except OSError as error:
            raise RecorderError(
                f"{self._folder}: the sums of a pass cannot be read back: {error.strerror}",
                "check the disk; `polecal-field replay` makes all passes anew from the capture",
            ) from error
        return np.frombuffer(data)


def _check(array: NDArray[np.float64]) -> int:
    """Give a sum of its bits, in 3 µs: a disk that fails later than at a write gives back what it likes."""
    return int(array.view(np.uint64).sum())
