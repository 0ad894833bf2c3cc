"""bench: what this machine needs for the work of a test, in one table; no time is judged here."""

from __future__ import annotations

import json

import pytest

from station.cli import bench


def test_bench_tells_each_jobs_time_beside_the_rigs_clock(station, tmp_path):
    told = tmp_path / "bench.json"
    ended = station("bench", "--seconds", 0.2, "--json", told)
    found = json.loads(told.read_text(encoding="utf-8"))
    assert ended.status == 0 and found["rig"] == "sflr" and found["test"] == bench.TEST
    assert [job["job"] for job in found["jobs"]] == ["simulate it", "run it in lockstep, logged", "read its log"]
    assert found["rows"] == round(bench.TEST["duration"] * 500.0) and found["rate"] == 500.0
    for job in found["jobs"]:
        assert 0.0 < job["seconds_per_sample"] < 1.0
        clock = job["times_real_time"] * job["seconds_per_sample"]
        assert clock == pytest.approx((found["rows"] - 1) / found["rows"] / found["rate"])
        assert job["job"] in ended.out
    spread = [found["answer"][name] for name in ("median", "p99", "p999", "max")]
    assert spread[0] > 0.0 and spread == sorted(spread) and 0.0 <= found["answered"] <= 1.0
    assert "5000 samples" in ended.out and "Answers in real time at 500 Hz, of the tick's 2 ms" in ended.out
