"""Effects that do not come with Station: files and installed packages bring them, a rig file never does."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest

from station.errors import UsageError
from station.model import effects
from station.model.effects import FILES, base, catalogue, effect_class, load_effects
from station.model.effects.base import named
from station.model.simulate import build
from station.rig import Rig, builtin_rigs, load_rig

ROOT = Path(__file__).resolve().parents[2]
PAGE, EXAMPLE = ROOT / "docs" / "own_effect.md", ROOT / "scripts" / "own_effect.py"
EFFECT = """
from typing import ClassVar
from station.model.effects.base import Effect, Stage, parameter

def torque(x, v, w, p, s, h):
    return {law}

class Own(Effect):
    name = "{name}"
    sites: ClassVar = ("motor",)
    stage, law = Stage.TORQUE, torque
    {body}

    @classmethod
    def guesses(cls, rig, at):
        return [{{"coefficient": 0.1}}]
"""
PARAMETER = 'coefficient: float = parameter("N m s/rad", 0.0, neutral=0.0)'


@pytest.fixture(autouse=True)
def left_as_it_was(monkeypatch):
    """What a test brings leaves the catalogue again."""
    monkeypatch.delenv(FILES, raising=False)
    before, modules = set(catalogue().values()), set(sys.modules)
    yield
    for cls in set(named()) - before:
        cls.name = ""
    for module in set(sys.modules) - modules:
        if module.startswith(("station_effects_", "brought_")):
            del sys.modules[module]


def written(folder: Path, name: str = "own_drag", law: str = "-p[0] * v", body: str = PARAMETER,
            file: str = "own.py") -> Path:
    path = folder / file
    path.write_text(EFFECT.format(name=name, law=law, body=body), encoding="utf-8")
    return path


def test_a_file_brings_its_effect_into_rig_files(tmp_path):
    text = builtin_rigs()["sflr"] + '\n[[effects]]\neffect = "own_drag"\ncoefficient = 0.03\n'
    with pytest.raises(UsageError, match="--effects FILE.py"):
        Rig.from_toml(text)
    load_effects(written(tmp_path))
    load_effects(tmp_path / "own.py")   # once only
    rig = Rig.from_toml(text)
    assert rig.effects[0].name == "own_drag" and build(rig).plan.slots.shape == (1, 5)


def test_the_environment_variable_names_files(tmp_path, monkeypatch):
    paths = [written(tmp_path, f"own_{i}", file=f"own_{i}.py") for i in range(2)]
    monkeypatch.setenv(FILES, ":".join(map(str, paths)).replace(":", effects.os.pathsep))
    assert {"own_0", "own_1", "coulomb_friction"} <= set(catalogue())


def test_the_option_brings_a_file_and_says_so_to_the_processes_that_follow(tmp_path, capfd, monkeypatch):
    from station.cli import main

    monkeypatch.setenv(FILES, "")   # set back at the end, whatever the command adds
    path = written(tmp_path)
    rig = tmp_path / "rig.toml"
    rig.write_text(builtin_rigs()["sflr"] + '\n[[effects]]\neffect = "own_drag"\ncoefficient = 0.03\n')
    bode = ["bode", "--rig", str(rig), "--out", str(tmp_path / "bode.svg")]
    with pytest.raises(SystemExit) as ended:
        main(bode)
    assert ended.value.code == 2 and "own_drag" in capfd.readouterr().err
    with pytest.raises(SystemExit) as ended:
        main(["--effects", str(path), *bode])
    assert ended.value.code == 0, capfd.readouterr().err
    assert effects.os.environ[FILES] == str(path)


@pytest.mark.parametrize(("content", "said"), [
    ("import nothing_of_that_name", "line 1: ModuleNotFoundError"),
    ("x = 1\nraise SystemExit(3)", "line 2: SystemExit"),
    ("def broken(:\n", "line 1: SyntaxError"),
    ("x = 1", "defines no effect"),
    (EFFECT.format(name="coulomb_friction", law="0.0", body=PARAMETER), "is taken by station.model.effects.coulomb"),
    (EFFECT.format(name="Own Drag", law="0.0", body=PARAMETER), "small letters"),
    (EFFECT.format(name="own_drag", law="0.0", body="coefficient: float = 0.0"), "declared by parameter"),
    (EFFECT.format(name="own_drag", law="0.0", body='coefficient: float = parameter("1", 0.0)'), "neutral value"),
    (EFFECT.format(name="own_drag", law="0.0", body='rate: float = parameter("Hz", 0.0, neutral=0.0)'), "is made of"),
    (EFFECT.format(name="own_drag", law="0.0", body=PARAMETER + '\n    picture = "nice"'), "picture is one of"),
    (EFFECT.format(name="own_drag", law="0.0", body=PARAMETER
                   + '\n    simpler = {"coulomb_friction": {"torque": "none"}}'),
     "simpler: coulomb_friction is made of parameters of this effect, not of none"),
    (EFFECT.format(name="own_drag", law="0.0", body=PARAMETER + "\n    states = 1"), "has no states"),
    (EFFECT.format(name="own_drag", law="0.0", body=PARAMETER + '\n    absolute = "rest"'), "names no parameter"),
    (EFFECT.format(name="own_drag", law="0.0", body=PARAMETER + '\n    experiment: ClassVar = {"kind": "kick"}'),
     "experiment: test.kind: 'kick' is none of"),
    (EFFECT.format(name="own_drag", law="0.0", body=PARAMETER
                   + '\n    experiment: ClassVar = {"kind": "step", "controller": "pid"}'), "experiment.controller"),
    (EFFECT.format(name="own_drag", law="0.0", body=PARAMETER).replace('"motor",', '"drive",'), "sites are of"),
    (EFFECT.format(name="own_drag", law="0.0", body=PARAMETER).replace("w, p, s, h", "w"), "law is a function of"),
    (EFFECT.format(name="own_drag", law="0.0", body=PARAMETER).replace("def guesses", "def sizes"), "no guesses"),
])
def test_a_file_that_does_not_do_is_refused_in_one_line(tmp_path, content, said):
    path = tmp_path / "own.py"
    path.write_text(content, encoding="utf-8")
    with pytest.raises(UsageError, match=said) as refused:
        load_effects(path)
    assert str(refused.value).startswith(f"effects: {path}: ") and "\n" not in str(refused.value)
    assert "own_drag" not in catalogue()


def test_a_file_that_is_not_there_or_no_python_is_refused(tmp_path):
    with pytest.raises(UsageError, match=r"none\.py: no such file"):
        load_effects(tmp_path / "none.py")
    with pytest.raises(UsageError, match="not a Python file"):
        load_effects(written(tmp_path, file="own.toml"))


def test_a_law_that_does_not_compile_is_told_in_one_line(tmp_path):
    load_effects(written(tmp_path, law="open('x')"))
    rig = load_rig("sflr").with_effects([effect_class("own_drag")(at="motor", coefficient=0.1)])
    with pytest.raises(UsageError, match=r"the law torque \(.*own\.py, line 5\) does not compile: ") as refused:
        build(rig)
    assert "\n" not in str(refused.value)


def test_installed_packages_bring_effects_and_a_broken_one_spoils_no_other(tmp_path, monkeypatch, caplog):
    written(tmp_path, "brought", file="brought_well.py")
    (tmp_path / "brought_badly.py").write_text("1 / 0", encoding="utf-8")
    for package, module in (("abad", "brought_badly"), ("good", "brought_well")):
        folder = tmp_path / f"{package}-1.0.dist-info"
        folder.mkdir()
        (folder / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n", encoding="utf-8")
        (folder / "entry_points.txt").write_text(f"[station.effects]\n{package} = {module}\n", encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    effects._import_installed.cache_clear()
    assert "brought" in catalogue() and "brought" in catalogue()
    (line,) = caplog.messages
    assert line.startswith("station: effects of abad (entry point abad = brought_badly) not loaded: ZeroDivisionError")
    assert "\n" not in line


@pytest.mark.parametrize("name", ["brought_by_rig", "brought_by_rig:Own", "brought_by_rig.py", "../brought_by_rig"])
def test_a_rig_file_imports_nothing(tmp_path, monkeypatch, name):
    written(tmp_path, "brought", file="brought_by_rig.py")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UsageError, match="is not an effect"):
        Rig.from_toml(builtin_rigs()["sflr"] + f'\n[[effects]]\neffect = "{name}"\ncoefficient = 0.03\n')
    assert "brought" not in catalogue() and "brought_by_rig" not in sys.modules


def test_the_page_on_own_effects_says_what_the_code_says():
    """Its pieces of code are the example's, its tables the docstrings of the base class and of its module."""
    text = PAGE.read_text(encoding="utf-8")
    example = EXAMPLE.read_text(encoding="utf-8")
    pieces = re.findall(r"```python\n(.*?)```", text, flags=re.DOTALL)
    assert len(pieces) == 4 and all(piece in example for piece in pieces)
    plain = " ".join(re.sub(r"[`|\\]", " ", text).split())
    module = ast.parse(Path(base.__file__).read_text(encoding="utf-8"))
    effect = next(node for node in module.body if isinstance(node, ast.ClassDef) and node.name == "Effect")
    told = [node.value.value for node in effect.body[1:] if isinstance(node, ast.Expr)]
    assert len(told) == 15
    rows = [line for line in ast.get_docstring(module).splitlines() if re.match("[A-Z_]{3,} {2,}", line)]
    assert len(rows) == 9
    for words in [*told, *(cell for row in rows for cell in re.split(" {2,}", row))]:
        assert " ".join(re.sub("[`|]", " ", words).split()) in plain, words


SERIES = """
import runpy, sys
from station.model.effects import load_effects
from station.model.effects.base import named
from station.model.compiled import address
if sys.argv[2] == "loaded":
    load_effects(sys.argv[1])
    law = next(cls.law for cls in named() if cls.name == "own_of_two_names")
else:
    law = runpy.run_path(sys.argv[1], run_name="__main__")["Own"].law
print(address(law) != 0)
"""


def test_a_law_kept_on_disk_serves_the_same_file_under_another_name(tmp_path):
    """A file that is loaded as effects and run as a program shares one compiled law on disk."""
    path = written(tmp_path, name="own_of_two_names")
    for how in ("loaded", "run", "loaded"):
        ended = subprocess.run([sys.executable, "-c", SERIES, str(path), how], capture_output=True, text=True,
                               cwd=ROOT, timeout=120)
        assert (ended.returncode, ended.stdout.strip()) == (0, "True"), ended.stderr
