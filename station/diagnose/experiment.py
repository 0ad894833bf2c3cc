"""The next experiment."""

from station.diagnose.result import NextExperiment


def next_experiment(search, odds, verdict):
    if verdict not in ("ambiguous",):
        return None
    return NextExperiment(test=None, why="")
