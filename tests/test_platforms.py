"""Every module is imported as on a system that lacks what Unix alone has."""

from __future__ import annotations

import pkgutil
import subprocess
import sys
from pathlib import Path

import pytest

import station

ROOT = Path(__file__).resolve().parents[1]
UNIX = ("fcntl", "termios", "pty", "tty", "resource", "grp", "pwd", "posix_ipc", "syslog")
MODULES = sorted(module.name for module in pkgutil.walk_packages(station.__path__, "station.")
                 if not module.name.startswith("station.firmware"))
BLOCKED = """
import importlib, os, select, signal, sys
class Blocked:
    def find_spec(self, name, path=None, target=None):
        if name in {unix!r}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)
for name in {unix!r}:
    sys.modules.pop(name, None)
sys.meta_path.insert(0, Blocked())
failed = []
{more}
for module in {modules!r}:
    try:
        importlib.import_module(module)
    except Exception as error:
        failed.append(f"{{module}}: {{type(error).__name__}}: {{error}}")
print("\\n".join(failed))
"""
LIBRARIES = ("import platformdirs.unix, cffi, numba, pydantic, rich, serial, typer, scipy.signal, matplotlib.figure, "
             "pyarrow, rerun, plotly")
GONE = """
{libraries}
for name in ("fork", "openpty", "sched_setscheduler", "sched_setaffinity", "getuid", "geteuid", "mkfifo", "killpg"):
    if hasattr(os, name):
        delattr(os, name)
for name in ("SIGKILL", "SIGHUP", "SIGALRM", "SIGUSR1"):
    if hasattr(signal, name):
        delattr(signal, name)
for name in ("epoll", "poll", "kqueue"):
    if hasattr(select, name):
        delattr(select, name)
"""


def _import_all(more: str, modules: list[str] = MODULES) -> str:
    code = BLOCKED.format(unix=UNIX, modules=modules, more=more)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_there_are_modules_of_every_layer():
    for name in ("cli", "loop", "device", "diagnose", "view", "runs", "campaign", "api"):
        assert any(module.startswith(f"station.{name}") for module in MODULES)


def test_the_block_holds(tmp_path):
    assert "No module named 'termios'" in _import_all("", ["termios"])


def test_every_module_is_imported_without_what_unix_alone_has():
    """pyserial chooses its own backend by os.name and is imported before; what stands in Station is tested."""
    libraries = f"for name in {UNIX!r}: sys.modules.pop(name, None)"
    before = f"sys.meta_path.pop(0)\n{LIBRARIES}\n{libraries}\nsys.meta_path.insert(0, Blocked())"
    assert _import_all(before) == ""


def test_every_module_is_imported_where_os_and_signal_have_what_windows_has():
    before = ("sys.meta_path.pop(0)\n" + GONE.format(libraries=LIBRARIES)
              + f"\nfor name in {UNIX!r}: sys.modules.pop(name, None)\nsys.meta_path.insert(0, Blocked())")
    assert _import_all(before) == ""


@pytest.mark.parametrize("folder", ["station"])
def test_text_files_are_opened_with_a_stated_encoding(folder):
    """Where it is not stated it is the platform's, which on Windows is not UTF-8."""
    found = []
    for path in sorted((ROOT / folder).rglob("*.py")):
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1):
            if (".read_text(" in line or ".write_text(" in line) and "encoding" not in line and "json" not in line:
                found.append(f"{path.relative_to(ROOT)}:{number}: {line.strip()}")
    assert found == []
