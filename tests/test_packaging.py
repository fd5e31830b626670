"""The wheel holds what the tree does; a sub-package that the build overlooks would be missing silently."""

import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

ROOT = Path(__file__).parents[1]


def test_wheel_holds_every_module_of_the_tree(tmp_path):
    source = tmp_path / "source"
    left_out = shutil.ignore_patterns(".*", "tests", "build", "*.egg-info", "__pycache__", "demo-out")
    shutil.copytree(ROOT, source, symlinks=True, ignore=left_out)
    build = f"from setuptools.build_meta import build_wheel; build_wheel({str(tmp_path)!r})"
    subprocess.run([sys.executable, "-c", build], cwd=source, check=True, capture_output=True)
    (wheel,) = tmp_path.glob("*.whl")
    names = set(zipfile.ZipFile(wheel).namelist())
    modules = {"polecal/__init__.py", "polecal/py.typed"}
    for folder in ("calib", "daemon", "drivers"):
        for kind in ("*.py", "*.j2", "*.html"):
            modules |= {f"polecal/{path.relative_to(ROOT)}" for path in (ROOT / folder).rglob(kind)}
    assert modules <= names
    assert not {name for name in names if name.split("/")[0] in ("calib", "daemon", "drivers", "tests")}


def test_status_command_starts_without_numpy():
    code = "import sys, polecal.daemon.field; sys.exit('numpy' in sys.modules or 'scipy' in sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True, env=os.environ)


def test_daemon_holds_nothing_that_only_reports_or_exports_need():
    spared = "{'scipy', 'matplotlib', 'jinja2', 'google'}"
    code = f"import sys, polecal.daemon.service; sys.exit(' '.join({spared} & set(sys.modules)) or 0)"
    subprocess.run([sys.executable, "-c", code], check=True, env=os.environ)
