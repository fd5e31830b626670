"""Measures what is claimed to be fast or exact; ratios within one run, as machines differ and are noisy.

``python -m tests.bench [NAME ...]`` runs all of the bench_*.py beside this file, or those named.
"""

import importlib
import sys
from pathlib import Path

from rich.console import Console
from rich.table import Table


def main(names: list[str]) -> int:
    here = Path(__file__).parent
    known = sorted(path.stem.removeprefix("bench_") for path in here.glob("bench_*.py"))
    unknown = set(names) - set(known)
    if unknown:
        sys.stderr.write(f"bench: no {', '.join(sorted(unknown))}; there are {', '.join(known)}\n")
        return 2
    console = Console()
    for name in names or known:
        module = importlib.import_module(f"tests.bench.bench_{name}")
        table = Table(title=module.__doc__.splitlines()[0])
        for heading in module.HEADINGS:
            table.add_column(heading, justify="right")
        for row in module.rows():
            table.add_row(*(value if isinstance(value, str) else f"{value:.3g}" for value in row))
        console.print(table)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
