"""Running a campaign: what is there is not repeated, a failure is its case's, a lost worker costs only its task."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from pathlib import Path

import psutil
import pytest

from station.campaign import cluster, processes
from station.campaign.folder import CaseFolder, file_name
from station.campaign.program import program_hash
from station.campaign.run import run_campaign
from tests.campaign.fake import begun, case, task

DEAD = "c-dies"


@pytest.fixture(autouse=True)
def fresh_hash() -> None:
    """Workers read the sources as they start: so does each test, in a checkout that somebody edits."""
    program_hash.cache_clear()


@pytest.fixture
def marks(tmp_path: Path) -> Path:
    folder = tmp_path / "marks"
    folder.mkdir()
    return folder


def tasks(marks: Path, **special: str) -> list:
    """Eight cases, some of them special."""
    return [task(name, marks, n=i, do=special.get(name.replace("-", "_"), ""),
                 seconds=0.5 if name == DEAD else 0.05)
            for i, name in enumerate(["a", "b", DEAD, "d", "e", "f", "g", "h"])]


@pytest.mark.parametrize("plain", [True, False], ids=["processes", "dask"])
def test_a_killed_worker_costs_only_its_task(tmp_path, marks, plain):
    """Two workers, one of them killed (SIGKILL) in the middle of a case: all cases end, that one alone is repeated."""
    given = tasks(marks, c_dies="die")
    results = run_campaign(given, case, tmp_path / "out", workers=2, plain=plain)
    assert not results.failed
    assert [outcome.label for outcome in results.outcomes] == [one.label for one in given]
    assert begun(marks) == {one.label: 2 if one.label == DEAD else 1 for one in given}


@pytest.mark.parametrize("plain", [True, False], ids=["processes", "dask"])
def test_a_case_that_always_kills_its_worker_ends_as_a_failure(tmp_path, marks, plain, monkeypatch):
    for module in (cluster, processes):
        monkeypatch.setattr(module, "RETRIES", 1)
    given = tasks(marks, c_dies="always die", e="fail")
    results = run_campaign(given, case, tmp_path / "out", workers=2, plain=plain)
    assert results.failed == {DEAD: "its worker was lost twice", "e": "ValueError: this one"}
    assert len(results.outcomes) == 6
    assert begun(marks)[DEAD] == 2


def test_what_is_there_is_not_repeated_and_what_failed_is(tmp_path, marks):
    given = tasks(marks, e="fail")
    first = run_campaign(given[:6], case, tmp_path / "out", workers=1, plain=True)
    assert (len(first.outcomes), first.repeated) == (5, 0)
    again = run_campaign(given, case, tmp_path / "out", workers=1, plain=True)
    assert again.repeated == 5 and list(again.failed) == ["e"]
    assert begun(marks) == {one.label: 2 if one.label == "e" else 1 for one in given}
    assert again.outcomes[0].seconds == first.outcomes[0].seconds == 0.0


def test_other_code_or_another_task_is_done_again(tmp_path, marks):
    given = tasks(marks)[:2]
    run_campaign(given, case, tmp_path / "out", workers=1, plain=True)
    run_campaign(given, case, tmp_path / "out", workers=1, plain=True, code="other")
    assert begun(marks) == {"a": 2, "b": 2}
    changed = [task("a", marks, n=5), given[1]]
    results = run_campaign(changed, case, tmp_path / "out", workers=1, plain=True, code="other")
    assert begun(marks) == {"a": 3, "b": 2} and results.outcomes[0].seconds == 5.0


def test_an_interruption_keeps_what_is_done(tmp_path, marks):
    given, ended = tasks(marks), []

    def told(one, outcome):
        ended.append(one.label)
        if len(ended) == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_campaign(given, case, tmp_path / "out", workers=1, plain=True, told=told)
    assert {path.stem for path in (tmp_path / "out" / "cases").iterdir()} == set(ended)
    results = run_campaign(given, case, tmp_path / "out", workers=1, plain=True)
    assert results.repeated == 3 and len(results.outcomes) == 8


def test_a_file_cut_short_is_done_again(tmp_path, marks):
    kept = CaseFolder(tmp_path, "code")
    one = task("a", marks)
    kept.keep(one, {"outcome": {"label": "a", "group": "fake"}})
    assert kept.kept(one).label == "a"
    path = tmp_path / "cases" / "a.json"
    path.write_text(path.read_text()[:-20])
    assert kept.kept(one) is None
    path.write_text(json.dumps({"schema": "another"}))
    assert kept.kept(one) is None


def test_two_cases_of_one_name_are_refused(tmp_path, marks):
    with pytest.raises(ValueError, match="same label"):
        run_campaign([task("a", marks), task("a", marks)], case, tmp_path)


@pytest.mark.parametrize("label", ["../../x", "/etc/x", "a\\b", "..", "", "a\0b", "x" * 300, "C:x", "a b\n"])
def test_a_name_from_a_file_never_leaves_the_folder(tmp_path, marks, label):
    CaseFolder(tmp_path / "out", "code").keep(task(label, marks), {"failure": "x"})
    assert [path.parent for path in tmp_path.rglob("*.json")] == [tmp_path / "out" / "cases"]
    assert file_name(label) != file_name(label + "_") and len(file_name(label)) < 120


@pytest.mark.parametrize("given", ["host", "http://host:8786", "tcp://host", "tls://host:8786/x", "tcp://host:99999"])
def test_an_address_that_is_none_is_refused(given):
    with pytest.raises(cluster.UsageError, match="--scheduler"):
        cluster.Scheduler(given)


def test_tls_wants_its_files(tmp_path):
    with pytest.raises(cluster.UsageError, match="--tls-ca: missing"):
        cluster.Scheduler("tls://host:8786")
    with pytest.raises(cluster.UsageError, match="no such file"):
        cluster.Scheduler("tls://host:8786", *(tmp_path / name for name in ("ca", "cert", "key")))
    with pytest.raises(cluster.UsageError, match="of no use with tcp"):
        cluster.Scheduler("tcp://host:8786", tmp_path / "ca")


@pytest.mark.parametrize(("address", "warned"), [
    ("tcp://127.0.0.1:8786", False), ("tcp://localhost:8786", False), ("tcp://[::1]:8786", False),
    ("tcp://10.0.0.1:8786", True), ("tcp://host:8786", True)])
def test_plain_tcp_beyond_this_machine_is_warned_of(address, warned):
    warning = cluster.Scheduler(address).warning
    assert bool(warning) == warned and "\n" not in (warning or "")


def test_the_local_cluster_listens_on_this_machine_alone(monkeypatch):
    pytest.importorskip("distributed")
    with cluster.local_client(1) as client:
        assert client.submit(os.environ.get, "OPENBLAS_NUM_THREADS").result() == "1"
        family = [psutil.Process(), *psutil.Process().children(recursive=True)]
        listening = [c.laddr.ip for process in family for c in process.net_connections("inet")
                     if c.status == psutil.CONN_LISTEN]
        assert len(listening) >= 3 and set(listening) == {"127.0.0.1"}


@pytest.fixture
def certificate(tmp_path: Path) -> dict[str, Path]:
    """A certificate that signs itself, and its key."""
    if shutil.which("openssl") is None:
        pytest.skip("no openssl to make a certificate with")
    cert, key = tmp_path / "cert.pem", tmp_path / "key.pem"
    subprocess.run(["openssl", "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes",
                    "-keyout", key, "-out", cert, "-days", "2", "-subj", "/CN=station",
                    "-addext", "subjectAltName=IP:127.0.0.1"], check=True, capture_output=True)
    return {"ca": cert, "cert": cert, "key": key}


def test_a_scheduler_over_tls_does_the_cases_and_refuses_who_has_no_key(tmp_path, marks, certificate, monkeypatch):
    distributed = pytest.importorskip("distributed")
    security = distributed.Security(tls_ca_file=str(certificate["ca"]), require_encryption=True, **{
        f"tls_{who}_{what}": str(certificate[what]) for who in ("scheduler", "worker", "client")
        for what in ("cert", "key")})
    with distributed.LocalCluster(n_workers=1, threads_per_worker=1, host="127.0.0.1", protocol="tls://",
                                  security=security, dashboard_address="127.0.0.1:0", silence_logs=50) as there:
        given = tasks(marks)[:2]
        results = run_campaign(given, case, tmp_path / "out",
                               scheduler=cluster.Scheduler(there.scheduler_address, **certificate))
        assert len(results.outcomes) == 2
        monkeypatch.setattr(cluster, "PATIENCE", 0.5)
        with pytest.raises(cluster.WorkError, match="no scheduler answers"):
            run_campaign([task("z", marks)], case, tmp_path / "out", scheduler=cluster.Scheduler(
                there.scheduler_address.replace("tls://", "tcp://")))


def test_without_dask_a_scheduler_is_one_line(monkeypatch):
    monkeypatch.setattr(cluster, "find_spec", lambda name: None)
    with pytest.raises(cluster.UsageError, match=r"pip install 'station\[cluster\]'"):
        cluster.need()


def test_a_scheduler_that_is_not_there_is_one_line(monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr(cluster, "PATIENCE", 0.5)
    with pytest.raises(cluster.WorkError, match="no scheduler answers") as raised, \
            cluster.remote_client(cluster.Scheduler("tcp://127.0.0.1:9")):
        pass
    assert "\n" not in str(raised.value)
