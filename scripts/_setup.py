"""Prepare .venv for the scripts beside this file: standard library only, quick when nothing has changed."""

import hashlib
import os
import shutil
import subprocess
import sys
import venv
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
VENV = ROOT / ".venv"
LOCK = ROOT / "requirements.lock"
COMPILERS = ("cc", "gcc", "clang")
KEPT = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
"""What is imported is kept compiled in .venv, whatever the shell says: else every start takes 3 s more."""


def stop(message):
    """End with one line."""
    sys.exit(f"{Path(sys.argv[0]).name}: {message}")


def environment_python():
    """The Python of .venv."""
    return VENV / ("Scripts/python.exe" if os.name == "nt" else "bin/python")


def extras():
    """What to install beyond the dependencies: the tests' and the docs' tools, and a C compiler where there is none."""
    found = os.environ.get("CC") or any(shutil.which(name) for name in COMPILERS)
    return ["test", "docs"] if found else ["test", "docs", "compiler"]


def key():
    """Changes whenever what should be installed changes."""
    digest = hashlib.sha256(repr((str(ROOT), sys.version_info[:2], extras())).encode())
    for path in (ROOT / "pyproject.toml", LOCK):
        digest.update(path.read_bytes())
    return digest.hexdigest()


def create():
    """Make .venv, with pip in it wherever this Python can put it there."""
    clear = VENV.exists() and not works()
    try:
        import ensurepip  # noqa: F401  (Debian leaves it out of its python3)
    except ImportError:
        if subprocess.run([sys.executable, "-m", "pip", "--version"], capture_output=True).returncode != 0:
            stop("this Python has neither ensurepip nor pip; on Debian and Ubuntu: apt install python3-venv")
        venv.EnvBuilder(clear=clear, symlinks=os.name != "nt").create(VENV)
    else:
        venv.EnvBuilder(clear=clear, symlinks=os.name != "nt", with_pip=True).create(VENV)


def works():
    """Whether the Python in .venv starts and has the version of this one."""
    version = f"{sys.version_info[0]}.{sys.version_info[1]}"
    ask = "import sys; print('%d.%d' % sys.version_info[:2])"
    try:
        answer = subprocess.run([environment_python(), "-c", ask], capture_output=True, text=True)
    except OSError:
        return False
    return answer.stdout.strip() == version


def pip():
    """The command that installs into .venv: its own pip, else this Python's."""
    own = subprocess.run([environment_python(), "-m", "pip", "--version"], capture_output=True)
    if own.returncode == 0:
        return [environment_python(), "-m", "pip"]
    return [sys.executable, "-m", "pip", "--python", environment_python()]


def prepare():
    """Bring .venv up to date, and return its Python."""
    if sys.version_info < (3, 11):  # noqa: UP036  (this file runs before anything has checked)
        stop(f"Python 3.11 or newer is needed; this is {sys.version.split()[0]}")
    stamp, wanted = VENV / "station-setup", key()
    if stamp.is_file() and stamp.read_text() == wanted and works():
        return environment_python()
    print(f"Installing into {VENV} (the first time takes a few minutes) ...", file=sys.stderr, flush=True)
    if not works():
        try:
            create()
        except (OSError, subprocess.CalledProcessError) as error:
            stop(f"{VENV}: could not be made: {error}")
    stamp.unlink(missing_ok=True)
    command = [*pip(), "install", "-qq", "--disable-pip-version-check", "--no-input", "--no-compile", "-c", LOCK,
               "-e", f"{ROOT}[{','.join(extras())}]"]
    quiet = {**os.environ, "PYTHONWARNINGS": "ignore"}      # setuptools' remarks on editable installs
    if subprocess.run(command, env=quiet).returncode != 0:
        stop("the installation failed; pip's reason stands above")
    stamp.write_text(wanted)
    return environment_python()


def run(*arguments):
    """Run a module of the prepared environment and end with its exit status."""
    process = subprocess.Popen([prepare(), "-m", *arguments], env=KEPT)
    while True:
        try:
            sys.exit(process.wait())
        except KeyboardInterrupt:       # the child got it too, and ends in its own way
            continue
