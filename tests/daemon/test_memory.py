import platform
import subprocess
import sys

import pytest

TAKES_AND_FREES = """
import sys
from pathlib import Path
from polecal.daemon.memory import give_back

def held_mb():
    status = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in status if line.startswith("VmRSS")) / 1024

if sys.argv[1] == "given back":
    give_back()
before_mb, between = held_mb(), []
for _ in range(6):
    large = [bytearray(5_000_000) for _ in range(6)]
    between.append(bytearray(50_000))
    del large
print(held_mb() - before_mb)
"""


def kept_mb(how):
    command = [sys.executable, "-c", TAKES_AND_FREES, how]
    return float(subprocess.run(command, capture_output=True, text=True, check=True).stdout)


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="of glibc")
def test_what_was_large_and_is_free_is_not_held():
    assert kept_mb("given back") < 3
    assert kept_mb("as it is") > 10
