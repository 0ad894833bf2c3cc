"""Pictures specific to a cause."""


def evidence(rig, extended_rig, runs, causes):
    return []
