"""The emulated devices are a second reading of the sheets, so they share nothing with the drivers."""

import ast
from pathlib import Path

import polecal.drivers.emulated

FOLDER = Path(polecal.drivers.emulated.__file__).parent


def test_no_module_imports_a_driver_or_the_port():
    imported = set()
    for path in FOLDER.glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom):
                imported.add(node.module)
            elif isinstance(node, ast.Import):
                imported.update(alias.name for alias in node.names)
    ours = {name for name in imported if name.startswith("polecal")}
    assert ours
    assert all(name.startswith("polecal.drivers.emulated") for name in ours)
