"""Start Rerun's viewer: bound to 127.0.0.1, its usage statistics off in a configuration folder of Station's own."""

from __future__ import annotations

import importlib.util
import json
import os
import socket
import subprocess
import sys
import webbrowser
from collections.abc import Sequence
from pathlib import Path

import platformdirs

from station.errors import WorkError
from station.view.web import LOOPBACK, serve_page


def view(files: Sequence[str | os.PathLike[str]], web: bool = False) -> None:
    """Open recordings (.rrd) and wait until the viewer is closed, or Ctrl-C is pressed (``web``: in the browser)."""
    names = [os.fspath(file) for file in files]
    if web:
        _open_web(names)
        return
    status = start(names).wait()
    if status != 0:
        raise WorkError(f"the viewer ended with status {status}; where there is no screen, --web or --save may help")


def start(arguments: Sequence[str], port: int | None = None) -> subprocess.Popen[bytes]:
    """Start the viewer's program, listening on 127.0.0.1 alone (``port``, else a free one)."""
    command = [_program(), "--bind", LOOPBACK, "--port", str(port or free_port()), *arguments]
    try:
        return subprocess.Popen(command, env=private_environment())
    except OSError as error:
        raise WorkError(f"{command[0]}: the viewer cannot start: {error.strerror or error}") from None


def free_port() -> int:
    """A port of 127.0.0.1 that nobody listens on now."""
    with socket.socket() as probe:
        probe.bind((LOOPBACK, 0))
        return int(probe.getsockname()[1])


def private_environment() -> dict[str, str]:
    """Environment in which Rerun keeps its settings in Station's folder, with usage statistics switched off there.

    On Windows Rerun finds its folder without the environment; there its own setting is switched off.
    WorkError where Rerun does not confirm that they are off.
    """
    folder = Path(platformdirs.user_config_dir("station", appauthor=False)) / "rerun"
    environment = dict(os.environ)
    if sys.platform == "darwin":
        environment["HOME"] = str(folder)
    else:
        environment |= {"XDG_CONFIG_HOME": str(folder / "config"), "XDG_DATA_HOME": str(folder / "data")}
    folder.mkdir(parents=True, exist_ok=True)
    if _statistics(environment):
        _ask(["analytics", "disable"], environment)
        if _statistics(environment):
            raise WorkError(f"{folder}: Rerun's usage statistics could not be switched off; the viewer was not started")
    return environment


def _open_web(names: Sequence[str]) -> None:
    data, page = free_port(), free_port()
    process = start(["--serve-web", "--web-viewer-port", str(page), *names], data)
    try:
        with serve_page(page, data) as address:
            print(f"The viewer is at {address} until Ctrl-C.", flush=True)
            webbrowser.open(address)
            process.wait()
    except KeyboardInterrupt:
        return
    finally:
        process.terminate()
        process.wait(timeout=10)


def _statistics(environment: dict[str, str]) -> bool:
    """Whether Rerun would send usage statistics; True where it does not say."""
    answer = _ask(["analytics", "config"], environment)
    try:
        return json.JSONDecoder().raw_decode(answer[answer.index("{"):])[0]["analytics_enabled"] is not False
    except (ValueError, KeyError):
        return True


def _program() -> str:
    """Rerun's program itself: the Python module of that name starts it as a child that outlives it."""
    found = importlib.util.find_spec("rerun_cli")
    if found is None or found.origin is None:
        raise WorkError("rerun: the viewer is not installed (pip install rerun-sdk)")
    folder = Path(found.origin).parent
    bundled = folder / "Rerun.app" / "Contents" / "MacOS" / "Rerun"
    if sys.platform == "darwin" and bundled.exists():
        return str(bundled)
    return str(folder / ("rerun.exe" if sys.platform == "win32" else "rerun"))


def _ask(arguments: Sequence[str], environment: dict[str, str]) -> str:
    try:
        done = subprocess.run([_program(), *arguments], env=environment, capture_output=True, text=True, timeout=60,
                              check=True)
    except (OSError, subprocess.SubprocessError) as error:
        raise WorkError(f"Rerun's program does not answer: {error}") from None
    return done.stdout
